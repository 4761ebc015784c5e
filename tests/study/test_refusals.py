"""What a study is refused for: tables of mistakes, each with the place and the values to name.

The places of the faults in tests/golden/bad_studies.toml are not repeated here.
"""

from support.plain_studies import (
    COMPASS,
    RECORDED,
    SIMULATED,
    build_study,
    merge_tables,
)
from support.refusals import assert_named, refusal_line, refusal_lines, refused

from sinsjax import messages

# Of a simulation of 900 s at 100 Hz


@refused("""
# Unknown and misplaced names
sensor = {}                                  -> [sensor]: [sensors]
alignment.reset_cuont = 1                    -> [alignment] reset_cuont: reset_count [resets]
alignment.method = "compas" & compass.level_time_s = 9    -> [alignment] method: 'compas' compass
# Values of single keys
study.duration_s = 1000010                   -> [study] duration_s: 1000010 100000000
study.window_s = [900, 600]                  -> [study] window_s: 900 600
study.record_interval_s = 901 & study.window_s = [0, 900]
    -> [study] record_interval_s: 901 900
axes.feedback_interval_s = [1, 1.005]        -> [axes] feedback_interval_s: 1.005 1.01
# Two forms of one quantity
sensors.gyro_arw_deg_per_sqrt_h = 1 & axes.gyro_noise_deg_per_h = [1]
    -> [axes] gyro_noise_deg_per_h: gyro_arw_deg_per_sqrt_h [sensors]
earth.earth = "wgs84" & axes.radius_m = [6.3e6, 6.4e6]    -> [axes] radius_m: earth
# Axes and cases
axes.method = ["kalman5", "x"]               -> [axes] method[1]: 'kalman5' 'compass' 'x'
axes.phi_u0_deg = [1] & axes.level.phi_u0_deg = [1]                -> [axes.level] phi_u0_deg: axis
cases = [{reset_kind = "full"}] & axes.zip.reset_kind = ["full"]      -> [cases] reset_kind: axis
# Resets
resets.reset_count = 1 & resets.reset_cycle_s = 50 & axes.reset_times_s = [[1], [2]]
    -> [axes] reset_times_s: reset_count [resets]
resets.reset_cycle_s = 50 & axes.reset_count = [0, 19]    -> [axes] reset_count: 950 900
resets.reset_count = 2 & resets.reset_cycle_s = 0.006     -> [resets] reset_cycle_s: 0.006 0.01
resets = {reset_count = 3, reset_first_s = 101, reset_cycle_s = 400}
    -> [resets] reset_cycle_s: 901 900
axes = {reset_at_feedback = [false, true], feedback_interval_s = [1.0, 800.0]}
    & resets = {reset_count = 2, reset_cycle_s = 445.0}
    -> [axes] reset_at_feedback: 1600 900
coarse.coarse_duration_s = 2.0 & alignment.feedback_interval_s = 1.5
    & resets = {reset_at_feedback = true, reset_times_s = [3.0]}
    -> [resets] reset_at_feedback: 2 1.5
resets = {reset_trigger = "innovation", trigger_threshold = 9.0}
    & axes.trigger_until_s = [3.0, 9000.0]
    -> [axes] trigger_until_s: 9000 900
# The last part of a record interval is not run.
study = {duration_s = 900.5, window_s = [600, 900]} & resets.reset_times_s = [900.2]
    -> [resets] reset_times_s: 900.2 900.5 900
study = {duration_s = 900.5, window_s = [899, 900.5]}     -> [study] window_s: 899 900.5 900
# Turns and files of attitude
motion = {turn_times_s = [1.0, 2.0], turn_rate_deg_per_s = 90.0}
    -> [motion] turn_times_s: 1 4 2
motion = {turn_times_s = [1.0], turn_rate_deg_per_s = 90.0, turn_ramp_s = 0.5, turn_repeat_s = 2.0}
    -> [motion] turn_times_s: 1 3.5 3
motion = {turn_times_s = [1.0], turn_rate_deg_per_s = 900.0}
    -> [motion] turn_rate_deg_per_s: 900 572.9 100
motion = {attitude_file = "a.csv"}           -> [motion] yaw_center_deg: attitude_file
axes.attitude_file = ["a.csv", "b.csv"]      -> [axes] attitude_file: swept
""")
def test_simulated_study_is_refused(refusal):
    refusal.check(refusal_line(build_study, **refusal.tables))


@refused("""
sensors.gyro_bias_deg_per_h = [0, 1e9, 0]    -> [sensors] gyro_bias_deg_per_h[1]: 1000000000
alignment.method = "compass" & compass.level_gains = [1.0, 9e11, 0.0]
    -> [compass] level_gains[1]: 900000000000
drawn.accel_bias_ug.normal = [0, 1e9]        -> [drawn] accel_bias_ug: outside
tune = {variables.p0_yaw_deg = {low = 1.0, high = 1e6}, searches = ["grid"]}
    -> [tune.variables] with every range at its high end: p0_yaw_deg 1000000
tune = {variables.p0_yaw_deg = {candidates = [1e6, 1.0]}, searches = ["grid"]}
    -> [tune.variables] with these values, p0_yaw_deg = 1000000.0: p0_yaw_deg 1000000
""")
def test_unusual_value_is_refused_unless_unchecked(refusal):
    refusal.check(refusal_line(build_study, **refusal.tables))
    build_study(merge_tables(SIMULATED, study={"unchecked": True}), **refusal.tables)


@refused("""
filter.mass_kg = 3                           -> [filter] mass_kg: removed 1.0 q_scale
resets.reset_kind = "half"                   -> [resets] reset_kind: 'half' removed 1.0 'scale'
tune = {variables.p0_yaw_deg = {low = 10, high = 90}, searches = ["grid", "random"]}
    -> [tune] searches[1]: 'random' removed 1.0 'sobol'
""")
def test_gone_key_or_value_is_refused_with_its_replacement(refusal, monkeypatch):
    monkeypatch.setitem(messages.GONE_KEYS, "filter.mass_kg", "use q_scale")
    monkeypatch.setitem(messages.GONE_VALUES, ("resets.reset_kind", "half"), "use 'scale'")
    refusal.check(refusal_line(build_study, **refusal.tables))


def test_all_missing_required_keys_are_listed():
    required = ["[study] rate_hz", "[earth] latitude_deg", "[motion] yaw_center_deg"]
    lines = refusal_lines(build_study, {"study": {"duration_s": 900}})
    assert [line.partition(": required")[0] for line in lines] == required
    places = [
        line.partition(":")[0] for line in refusal_lines(build_study, SIMULATED, earth=3, motion=3)
    ]
    assert places == ["[earth]", "[motion]"]
    for stop, key in (({"half_width": 1}, "statistic"), ({"statistic": "x"}, "half_width")):
        assert_named(
            refusal_lines(build_study, stop_when=stop)[0], f"[stop_when] {key}", "required"
        )


def test_too_many_runs_are_refused():
    axes = {key: [i / 100 for i in range(1000)] for key in ("phi_e0_deg", "phi_n0_deg")}
    line = refusal_line(build_study, study={"draws": 1001}, axes=axes)
    assert_named(line, "[study] draws", "1001", "1000000", "1000000000")
    build_study(study={"draws": 1000}, axes=axes)
    starts = [float(i) for i in range(1001)]
    line = refusal_line(build_study, RECORDED, record={"start_s": starts}, axes=axes)
    assert_named(line, "[record] start_s", "1001", "1000000", "1000000000")


# Passes and loops


@refused("""
axes = {stored_s = [80, 100], passes = [3, 10]}   -> [axes] passes: 10 100 1000
compass = {sigma_factors = [2, 1], sigma_times_s = [400]} & axes.passes = [1, 2]
    & passes.stored_s = 80 -> [compass] sigma_times_s: 400 160
compass.azimuth_damping = 0.6 & axes.azimuth_gains = [[1.0, 2.0, 3.0, 4.0]]
    -> [compass] azimuth_damping: azimuth_gains
compass = {level_gains = [1.0, 2.0, 3.0], level_sigma_per_s = 1.0}
    & cases = [{case = "a", level_gains = [3.0, 2.0, 1.0]}, {case = "b"}]
    -> [compass] level_gains: level_sigma_per_s [compass]
axes = {level_gains = [[1.0, 2.0, 3.0]], level_damping = [0.6, 0.7]}
    -> [axes] level_damping: level_gains
axes = {sigma_factors = [[1.0], [2.0, 1.0]], sigma_times_s = [[], [100.0]]}
    -> [axes] sigma_times_s: 0 1
""")
def test_invalid_passes_and_compass_loops_are_refused(refusal):
    base = merge_tables(COMPASS, study={"window_s": [0, 80]})
    refusal.check(refusal_line(build_study, base, **refusal.tables))


# Recorded studies


@refused("""
axes.accel_bias_ug = [1]                     -> [axes] accel_bias_ug: [sensors]
coarse.coarse_duration_s = 0.01              -> [coarse] coarse_duration_s: 0.01 2 0.02
record = {from_s = 30, start_s = [20, 40]}   -> [record] start_s: 20 30
record.gyro_unit = "rad"                     -> [record] gyro_unit: 'psins'
record = {format = "csv", accel_unit = "g", accel_columns = ["x", "y", "z"], gyro_unit = "rad"}
    -> [record] gyro_columns: required 'csv'
record.axes_order = "yxz"                    -> [record] axes_order: 'yxz' left-handed
""")
def test_invalid_recorded_studies_are_refused(refusal):
    refusal.check(refusal_line(build_study, RECORDED, **refusal.tables))

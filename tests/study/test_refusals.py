"""What a study is refused for: tables of mistakes, each with the place and the values to name."""

import copy

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.plain_studies import (
    COMPASS,
    RECORDED,
    SIMULATED,
    TABULAR,
    build_study,
    merge_tables,
    refusal_line,
    refusal_lines,
)
from support.refusals import assert_named, refused

STOP = {"statistic": "success_rate", "half_width": 0.02}


# Unknown names


@refused("""
sensor = {}                                  -> [sensor]: [sensors]
zzz = {}                                     -> [zzz]
duration_s = 1.0                             -> duration_s: [study]
sensors = 3                                  -> [sensors]
axes = [1]                                   -> [axes]
alignment.seed = 1                           -> [alignment] seed: [study]
alignment.reset_cuont = 1                    -> [alignment] reset_cuont: reset_count [resets]
filter.zzz = 1                               -> [filter] zzz
axes.phi_u_deg = [1]                         -> [axes] phi_u_deg: phi_u0_deg
axes.case = ["a"]                            -> [axes] case
axes.half_width = [1]                        -> [axes] half_width: [stop_when]
axes.duration_s = [1, 2]                     -> [axes] duration_s: [study]
axes.start_s = [0, 30]                       -> [axes] start_s: [record]
draw = {}                                    -> [draw]: [drawn]
alignment.method = "compas"                  -> [alignment] method: 'compas' compass
alignment.method = "compas" & compass.level_time_s = 9
    -> [alignment] method: compass
""")
def test_unknown_and_misplaced_names_are_refused(refusal):
    refusal.check(refusal_line(**refusal.tables))


@pytest.mark.parametrize(
    ("tables", "place"),
    [
        ({"filter": {"p0_yaw_deg": None}}, "[filter] p0_yaw_deg"),
        ({"axes": {"phi_u0_deg": [0, None]}}, "[axes] phi_u0_deg[1]"),
        ({"axes": {"level": {"phi_u0_deg": None}}}, "[axes.level] phi_u0_deg"),
        ({"cases": [{"phi_u0_deg": None}]}, "[cases] phi_u0_deg[0]"),
    ],
)
def test_none_is_refused_as_a_value(tables, place):
    assert_named(refusal_line(**tables), place)


# Values of single keys


@refused("""
study.estimate = "covariance"                -> [study] estimate: 'covariance'
study.duration_s = 1000010                   -> [study] duration_s: 1000010 100000000
study.rate_hz = 0.0                          -> [study] rate_hz: 0
study.name = 3                               -> [study] name: 3
study.draws = 0                              -> [study] draws: 1 0
study.curves = 1                             -> [study] curves: 1
study.settle_bands_arcmin = 10               -> [study] settle_bands_arcmin: 10
study.settle_bands_arcmin = [10, 10.0]       -> [study] settle_bands_arcmin: repeats
# 10 arcmin is always a column.
study.settle_bands_arcmin = [10.0000001]     -> [study] settle_bands_arcmin: bands
study.judged_from = "reference"              -> [study] judged_from: 'truth' 'floor'
study.judged_from = "limit"                  -> [study] judged_from: 'truth' 'floor' 'limit'
study.dwell_s = 1e9                          -> [study] dwell_s: shorter
study.report_times_s = 100                   -> [study] report_times_s: 100
study.report_times_s = []                    -> [study] report_times_s: empty
study.report_times_s = [200, 100]            -> [study] report_times_s: increase
study.window_s = [1, 2, 3]                   -> [study] window_s: 2 3
study.window_s = [900, 600]                  -> [study] window_s: 900 600
study.window_s = [600, 901]                  -> [study] window_s: 900 901
study.record_interval_s = 0.015              -> [study] record_interval_s: 0.015 0.01 0.02
study.record_interval_s = 901 & study.window_s = [0, 900]
    -> [study] record_interval_s: 901 900
earth.latitude_deg = 90                      -> [earth] latitude_deg: 90
motion.roll_amplitude_deg = -1               -> [motion] roll_amplitude_deg: 0
motion.roll_amplitude_deg = 1                -> [motion] roll_period_s: roll_amplitude_deg
axes.roll_amplitude_deg = [0, 1]             -> [motion] roll_period_s: roll_amplitude_deg
sensors.accel_bias_ug = [1, 2, "3"]          -> [sensors] accel_bias_ug[2]: '3'
alignment.phi_u0_deg = 181                   -> [alignment] phi_u0_deg: 180
alignment.feedback_interval_s = 0.001        -> [alignment] feedback_interval_s: 0.001 0.01
axes.feedback_interval_s = [1, 1.005]        -> [axes] feedback_interval_s: 1.005 1.01
filter.p0_yaw_deg = 0                        -> [filter] p0_yaw_deg: 0
""")
def test_invalid_values_of_single_keys_are_refused(refusal):
    refusal.check(refusal_line(**refusal.tables))


def test_missing_required_keys_are_listed():
    for key in ("duration_s", "rate_hz"):
        data = copy.deepcopy(SIMULATED)
        del data["study"][key]
        assert_named(refusal_line(data), f"[study] {key}", "required")
    required = ["[study] rate_hz", "[earth] latitude_deg", "[motion] yaw_center_deg"]
    lines = refusal_lines({"study": {"duration_s": 900}})
    assert [line.partition(": required")[0] for line in lines] == required
    places = [line.partition(":")[0] for line in refusal_lines(SIMULATED, earth=3, motion=3)]
    assert places == ["[earth]", "[motion]"]


# Axes and cases


@refused("""
axes.phi_u0_deg = 30                         -> [axes] phi_u0_deg: 30
axes.phi_u0_deg = []                         -> [axes] phi_u0_deg: empty
axes.phi_u0_deg = [0, 1, 2, "3"]             -> [axes] phi_u0_deg[3]: '3'
axes.phi_u0_deg = [30, 1, 30.0]              -> [axes] phi_u0_deg[2]: [0]
axes.method = ["kalman5", "x"]               -> [axes] method[1]: 'kalman5' 'compass' 'x'
axes.accel_bias_ug = [1, [1, 2, "3"]]        -> [axes] accel_bias_ug[1][2]: '3'
axes.phi_u0_deg = {uniform = [0, 1]}         -> [axes.phi_u0_deg] uniform
axes.level = {}                              -> [axes.level]: empty
axes.level = [1]                             -> [axes] level
axes.level.rate_hz = [1]                     -> [axes.level] rate_hz: [study]
axes.level = {phi_u0_deg = [1, 2], phi_e0_deg = [1]}
    -> [axes.level] phi_e0_deg: 1 phi_u0_deg 2
axes.level = {phi_u0_deg = [1, 1, 1], phi_e0_deg = [1, 2, 1.0]}
    -> [axes.level] phi_u0_deg, phi_e0_deg[2]: [0]
axes.phi_u0_deg = [1] & axes.level.phi_u0_deg = [1]
    -> [axes.level] phi_u0_deg: axis
axes.level.phi_u0_deg = [1] & axes.heading.phi_u0_deg = [1]
    -> [axes.heading] phi_u0_deg: axis
""")
def test_invalid_axis_values_are_refused(refusal):
    refusal.check(refusal_line(**refusal.tables))


@refused("""
cases = 3                                    -> [cases]
cases = {phi_u0_deg = 1}                     -> [cases]
cases = []                                   -> [cases]: empty
cases = [{}]                                 -> [cases]: empty
cases = [{phi_u0_deg = 1}, {phi_u0_deg = "x"}]     -> [cases] phi_u0_deg[1]: 'x'
cases = [{phi_u0_deg = 1}, {phi_u0_deg = 2, case = "b"}]  -> [cases] case[0]: every
cases = [{case = 1, phi_u0_deg = 1}]         -> [cases] case[0]: 1
cases = [{case = "a", phi_u0_deg = 1}, {case = "a", phi_u0_deg = 2}]   -> [cases] case[1]: [0]
cases = [{case = "a", phi_u0_deg = 1}, {case = "b", phi_u0_deg = 1.0}]
    -> [cases] phi_u0_deg[1]: [0]
cases = [{reset_kind = "full"}]              -> [cases] reset_kind: axis
""")
def test_invalid_case_values_are_refused(refusal):
    refusal.check(refusal_line(**refusal.tables, axes={"reset_kind": ["full"]}))
    refusal.check(refusal_line(**refusal.tables, axes={"zip": {"reset_kind": ["full"]}}))


# Rules between keys


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("gyro_noise_deg_per_h", "gyro_arw_deg_per_sqrt_h"),
        ("accel_noise_ug", "accel_vrw_ug_per_sqrt_hz"),
    ],
)
def test_noise_given_in_two_units_is_refused(one, other):
    line = refusal_line(sensors={one: 1, other: 1})
    assert_named(line, f"[sensors] {one}", other, "[sensors]")
    line = refusal_line(sensors={other: 1}, axes={one: [1]})
    assert_named(line, f"[axes] {one}", other, "[sensors]")
    study = build_study(sensors={other: 1})
    assert study.sensors is not None and getattr(study.sensors, one) is None


@refused("""
resets.reset_count = -1                      -> [resets] reset_count: 0
resets.reset_times_s = [50, 50]              -> [resets] reset_times_s: increase
resets.reset_times_s = [1] & resets.reset_count = 0
    -> [resets] reset_times_s: reset_count [resets]
resets.reset_count = 1 & resets.reset_cycle_s = 50 & axes.reset_times_s = [[1], [2]]
    -> [axes] reset_times_s: reset_count [resets]
resets.reset_times_s = [1] & axes.reset_count = [0, 1]
    -> [resets] reset_times_s: reset_count [axes]
resets.reset_count = 1                       -> [resets] reset_cycle_s: reset_count 1
resets.reset_count = 3 & resets.reset_cycle_s = 301
    -> [resets] reset_cycle_s: 3 301 903 900
resets.reset_cycle_s = 50 & axes.reset_count = [0, 19]
    -> [axes] reset_count: 19 50 950 900
resets.reset_count = 2 & resets.reset_cycle_s = 0.006
    -> [resets] reset_cycle_s: 0.006 0.01
resets.reset_times_s = [50, 901]             -> [resets] reset_times_s: 901 900
resets.reset_times_s = [0.004]               -> [resets] reset_times_s: 0.004 start 0.01
axes.reset_times_s = [[], [50.0, 50.004]]    -> [axes] reset_times_s: 50.004 50 0.01
resets.reset_first_s = 25 & axes.reset_count = [0, 1, 2]
    -> [resets] reset_cycle_s: reset_count 2
resets.reset_count = 1 & axes.reset_first_s = [25, 901]
    -> [axes] reset_first_s: 901 900
resets.reset_count = 3 & resets.reset_first_s = 101 & resets.reset_cycle_s = 400
    -> [resets] reset_cycle_s: 3 101 400 901 900
resets.reset_count = 2 & resets.reset_first_s = 0.015 & resets.reset_cycle_s = 0.01
    -> [resets] reset_first_s: 0.015 0.01 0.025
""")
def test_invalid_resets_are_refused(refusal):
    refusal.check(refusal_line(**refusal.tables))


@refused("""
stop_when.statistic = "settle_3_s_mean"      -> [stop_when] statistic: settle_60_s_mean
stop_when.half_width = 0                     -> [stop_when] half_width: 0
stop_when.until = 3                          -> [stop_when] until
""")
def test_invalid_stop_rules_are_refused(refusal):
    stop = {"study": {"settle_bands_arcmin": [60]}, "stop_when": STOP}
    refusal.check(refusal_lines(merge_tables(SIMULATED, **stop), **refusal.tables)[0])


def test_stop_rule_needs_statistic_and_half_width_and_no_record():
    for stop, key in (({"half_width": 1}, "statistic"), ({"statistic": "x"}, "half_width")):
        assert_named(refusal_lines(stop_when=stop)[0], f"[stop_when] {key}", "required")
    assert_named(refusal_line(RECORDED, stop_when=STOP), "[stop_when]", "[record]")


@pytest.mark.parametrize(
    ("one", "others"),
    [
        ("level_gains", ("level_sigma_per_s", "level_adjustment_s")),
        ("level_passes", ("level_time_s",)),
        ("azimuth_gains", ("azimuth_sigma_per_s", "azimuth_adjustment_s")),
        ("sigma_passes", ("sigma_times_s",)),
    ],
)
def test_loop_settings_given_in_two_ways_are_refused(one, others):
    values = {"level_gains": [1.0, 2.0, 3.0], "azimuth_gains": [1.0, 2.0, 3.0, 4.0]}
    values |= {"level_passes": 1, "sigma_passes": [1], "sigma_times_s": [80.0]}
    given = {key: values.get(key, 1.0) for key in (one, *others)}
    extra = {"passes": {"stored_s": 80.0}}
    for other in others:
        pair = {key: given[key] for key in (one, other)}
        line = refusal_line(COMPASS, compass=pair, **extra)
        assert_named(line, f"[compass] {one}", other, "[compass]")
    more = {"sigma_factors": [2.0, 1.0]} if one == "sigma_passes" else {}
    alone = build_study(COMPASS, compass={one: given[one]} | more, **extra).compass
    assert alone is not None and all(getattr(alone, other) is None for other in others)


@refused("""
passes.stored_s = 901                        -> [passes] stored_s: 901 900
passes.stored_s = 80.5                       -> [passes] stored_s: 80.5 80 81
passes.stored_s = 0.4                        -> [passes] stored_s: 0.4 1
passes = {stored_s = 80, passes = 12}        -> [passes] passes: 12 80 960 900
passes = {stored_s = 80, passes = 4, ending = "forward"}
    -> [passes] passes: 4 backward ending 'forward'
passes.passes = 2                            -> [passes] passes: 2 stored_s
passes = {stored_s = 80, turn = "flip"}      -> [passes] turn: 'reflect' 'keep' 'flip'
axes = {stored_s = [80, 100], passes = [3, 10]}   -> [axes] passes: 10 100 1000
compass.sigma_factors = [2, 1]               -> [compass] sigma_times_s: 1 2 0
compass = {sigma_factors = [2, 1], sigma_times_s = [1, 2]}   -> [compass] sigma_times_s: 1 2
compass.sigma_times_s = [3]                  -> [compass] sigma_times_s: 0 1
compass = {sigma_factors = [3, 2, 1], sigma_times_s = [3, 2]}
    -> [compass] sigma_times_s: increase
compass = {sigma_factors = [2, 1], sigma_passes = [2]}       -> [compass] sigma_passes: stored_s
compass.level_passes = 1                     -> [compass] level_passes: stored_s
compass.azimuth_gains = [1, 2, 3, 4, 5]      -> [compass] azimuth_gains: 4 5
compass.level_damping = 1.0                  -> [compass] level_damping: 1.0
axes = {sigma_factors = [[1.0], [2.0, 1.0]], sigma_times_s = [[], [100.0]]}
    -> [axes] sigma_times_s: 0 1
""")
def test_invalid_passes_and_compass_loops_are_refused(refusal):
    base = merge_tables(COMPASS, study={"window_s": [0, 80]})
    refusal.check(refusal_line(base, **refusal.tables))


def test_passes_and_loops_are_checked_per_variant():
    build_study(cases=[{"stored_s": 80, "passes": 10}, {"stored_s": 100, "passes": 3}])
    pairs = zip([[1.0], [2.0, 1.0]], [[], [100.0]], strict=True)
    build_study(COMPASS, cases=[{"sigma_factors": f, "sigma_times_s": t} for f, t in pairs])
    counted = [{"sigma_factors": [2.0, 1.0], "sigma_passes": [2]}]
    build_study(COMPASS, cases=counted, passes={"stored_s": 80})


@refused("""
resets.reset_times_s = [900.2]               -> [resets] reset_times_s: 900.2 900.5 900
resets = {reset_count = 1, reset_cycle_s = 900.2}
    -> [resets] reset_cycle_s: 1 900.2 900.5 900
study.window_s = [899, 900.5]                -> [study] window_s: 899 900.5 900
""")
def test_events_in_last_partial_record_interval_are_refused(refusal):
    partial = merge_tables(SIMULATED, study={"duration_s": 900.5, "window_s": [600, 900]})
    refusal.check(refusal_line(partial, **refusal.tables))


@given(
    every=st.integers(1, 50),
    rate=st.sampled_from([3.0, 7.0, 100.0, 333.3]),
    ends=st.tuples(st.integers(0, 400), st.integers(1, 400)).filter(lambda ab: ab[0] < ab[1]),
)
def test_window_must_contain_two_record_times(every, rate, ends):
    start, end = (n / rate for n in ends)
    study = {"rate_hz": rate, "duration_s": 400 / rate, "record_interval_s": every / rate}
    times = [k * every / rate for k in range(1, 400 // every + 1)]
    tables = {"study": study | {"window_s": [start, end]}}
    tables["alignment"] = {"feedback_interval_s": 1 / rate}
    if sum(start < time <= end for time in times) < 2:
        assert_named(refusal_line(**tables), "[study] window_s", "2")
    else:
        build_study(**tables)


def test_oversized_studies_are_refused():
    build_study(study={"duration_s": 1000000})
    axes = {key: [i / 100 for i in range(1000)] for key in ("phi_e0_deg", "phi_n0_deg")}
    line = refusal_line(study={"draws": 1001}, axes=axes)
    assert_named(line, "[study] draws", "1001", "1000000", "1000000000")
    build_study(study={"draws": 1000}, axes=axes)
    starts = [float(i) for i in range(1001)]
    line = refusal_line(RECORDED, record={"start_s": starts}, axes=axes)
    assert_named(line, "[record] start_s", "1001", "1000000", "1000000000")


@given(samples=st.integers(1, 100_000), rate=st.floats(1, 1e4))
def test_whole_numbers_of_samples_are_accepted(samples, rate):
    study = {"rate_hz": rate, "duration_s": 1e3, "record_interval_s": 1 / rate, "unchecked": True}
    build_study(study=study, alignment={"feedback_interval_s": samples / rate})


@given(samples=st.floats(0.01, 1e5).filter(lambda x: 0.01 < x % 1 < 0.99), rate=st.floats(1, 1e4))
def test_suggested_nearest_intervals_are_accepted(samples, rate):
    study = {"rate_hz": rate, "duration_s": 1e3, "record_interval_s": 1 / rate, "unchecked": True}
    line = refusal_line(study=study, alignment={"feedback_interval_s": samples / rate})
    for near in line.rsplit("nearest: ")[1].rstrip(")").split(" or "):
        build_study(study=study, alignment={"feedback_interval_s": float(near)})


@pytest.mark.parametrize("key", ["gravity_m_per_s2", "radius_m", "earth_rate_deg_per_h"])
def test_earth_constants_are_refused_with_wgs84(key):
    for place, tables in (
        ("[earth]", {"earth": {"earth": "wgs84", key: 1}}),
        ("[axes]", {"earth": {"earth": "wgs84"}, "axes": {key: [1, 2]}}),
        ("[earth]", {"earth": {key: 1}, "cases": [{"earth": "wgs84"}]}),
    ):
        assert_named(refusal_line(**tables), f"{place} {key}", "'constants'", "'wgs84'")
    assert getattr(build_study(earth={"earth": "wgs84"}).earth, key) is None
    study = {"unchecked": True}
    both = build_study(study=study, earth={key: 1}, axes={"earth": ["wgs84", "constants"]})
    assert both.values(key) == [1.0, 1.0]


# Recorded studies


@refused("""
motion = {}                                  -> [motion]: [record]
sensors = {}                                 -> [sensors]: [record]
study.draws = 1                              -> [study] draws: start
axes.accel_bias_ug = [1]                     -> [axes] accel_bias_ug: [sensors]
axes.coarse_duration_s = [0.01]              -> [axes] coarse_duration_s: 0.01
axes.to_s = [1]                              -> [axes] to_s: [record]
coarse.coarse_method = "none"                -> [coarse] coarse_method: 'none' 'inertial'
coarse.coarse_duration_s = 0.01              -> [coarse] coarse_duration_s: 0.01 2 0.02
record.start_s = [0, -1]                     -> [record] start_s[1]: 0
record.start_s = [0, 30, 0.0]                -> [record] start_s: repeats
record.start_s = []                          -> [record] start_s: empty
record = {from_s = 30, start_s = [20, 40]}   -> [record] start_s: 20 30
record = {from_s = 30, to_s = 30}            -> [record] to_s: 30
record.time_unit = "ms"                      -> [record] time_unit: time_column
record.max_gap_s = 1                         -> [record] max_gap_s: 'psins'
record.axes_order = "xyy"                    -> [record] axes_order: 'xyy' permutation
record.axes_order = "yxz"                    -> [record] axes_order: 'yxz' left-handed
record.format = "mat"                        -> [record] format: 'psins' 'csv' 'parquet' 'arrays'
""")
def test_invalid_recorded_studies_are_refused(refusal):
    refusal.check(refusal_line(RECORDED, **refusal.tables))
    build_study(RECORDED, record={"start_s": [0, 0.01]}, coarse={"coarse_duration_s": 0.02})
    assert build_study(RECORDED, record={"from_s": 30}).record.start_s == (30.0,)


def test_record_keys_depend_on_format():
    for key in (*TABULAR, "time_column"):
        if key != "format":
            line = refusal_line(RECORDED, record={key: TABULAR.get(key, "t")})
            assert_named(line, f"[record] {key}", "'psins'")
    for format_ in ("csv", "parquet"):
        for key in TABULAR:
            if key not in ("format", "quantity"):
                table = {k: v for k, v in TABULAR.items() if k != key} | {"format": format_}
                line = refusal_line(RECORDED, record=table)
                assert_named(line, f"[record] {key}", "required", f"'{format_}'")
    data = merge_tables(RECORDED, record={"start_s": 0})
    del data["record"]["format"]
    assert_named(refusal_line(data), "[record] format", "required")


@refused("""
record.gyro_unit = "rad"                     -> [record] gyro_unit: 'rad' rad_per_s deg_per_s
record.quantity = "increments"               -> [record] gyro_unit: 'deg_per_h' rad deg arcsec
record.accel_unit = "g_s"                    -> [record] accel_unit: 'g_s' m_per_s2 g mg ug
record.gyro_columns = ["a", "b"]             -> [record] gyro_columns[2]: required
record.accel_columns = ["ax", "ay", "gx"]    -> [record] accel_columns: 'gx'
record.time_column = "gx"                    -> [record] gyro_columns: 'gx' time_column
""")
def test_invalid_tabular_record_keys_are_refused(refusal):
    refusal.check(refusal_line(merge_tables(RECORDED, record=TABULAR), **refusal.tables))

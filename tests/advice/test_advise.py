"""Advice: its numbers against draws and finite changes, what it writes and refuses, its doubts."""

import json
import re
import tomllib
from functools import cache

import numpy as np
import pytest
import tomli_w
from support.commands import command_line
from support.refusals import assert_refusal, refusal_lines, refused

import sinsjax
from sinsjax.advice.advise import (
    choose_method,
    describe_advice,
    heading_budget,
    rms_and_q95_of_noisy_direction,
    scale_source,
    sheet_problem,
)
from sinsjax.advice.sheet import MOTIONS, read_sheet, shipped_sheets
from sinsjax.errors import InputError

FOG = {
    "earth": {"latitude_deg": 48.0},
    "sensors": {
        **{"gyro_arw_deg_per_sqrt_h": 0.005, "gyro_instability_deg_per_h": 0.02},
        **{"accel_vrw_ug_per_sqrt_hz": 30.0, "accel_instability_ug": 20.0},
    },
    "drawn": {
        "gyro_bias_deg_per_h": {"normal": [0.0, 0.05]},
        "accel_bias_ug": {"normal": [0.0, 200.0]},
    },
}
STEADY = {"sensors.gyro_instability_deg_per_h": {}, "sensors.accel_instability_ug": {}}
"""Changes to sensors without bias instability, whose advice takes half the time."""
MANY = {
    **{"sensors.gyro_rrw_deg_per_h_per_sqrt_h": 0.1, "sensors.accel_rrw_ug_per_sqrt_h": 50.0},
    "sensors.gyro_quantisation_arcsec": 10.0,
    "sensors.accel_quantisation_um_per_s": 3000.0,
    "drawn.gyro_scale_ppm": {"normal": [0.0, 3000.0]},
    "drawn.gyro_misalignment_arcsec": {"normal": [0.0, 2000.0]},
    "drawn.accel_misalignment_arcsec": {"normal": [0.0, 300.0]},
    **{"motion.surge_m_per_s": 0.05, "motion.surge_time_s": 5.0, "motion.vibration_ug_rms": 5000.0},
    **{"motion.vibration_hz": 30.0, "motion.vibration_damping": 0.05},
}
"""Changes to a surging and vibrating base, with all errors of sensors."""


def read(changes=None, **options):
    return read_sheet(FOG, changes=changes, **options)


def budget_of(given, times_s, unmodelled=()):
    return heading_budget(sheet_problem(given), times_s, unmodelled)


def advise(changes=None, **options):
    return advise_once(json.dumps({"changes": changes} | options))


@cache
def advise_once(options):
    return sinsjax.advise(FOG, **json.loads(options))


@pytest.mark.nightly
@pytest.mark.parametrize("motion", ["rocking", "surging"])
@pytest.mark.optimised(False)
def test_study_that_is_written_confirms_the_rms(motion):
    advice = advise(motion=motion, time_s=200.0)
    study = sinsjax.study_from_dict(tomllib.loads(advice.study()))
    summary = sinsjax.run(study.replace({"study.rate_hz": 10.0, "study.draws": 128})).summary
    for time_s, column in ((120, "phi_u_at_120_arcmin"), (200, "phi_u_arcmin")):
        (expected,) = (h.rms_arcmin for h in advice.headings if h.time_s == time_s)
        errors = np.asarray(summary[column], float)
        assert expected == pytest.approx(np.sqrt(np.mean(errors**2)), rel=0.2)


def test_lever_arm_of_a_rocking_base_is_believed_by_the_fit():
    rocking = {"motion": MOTIONS["rocking"] | {"lever_arm_m": [2.0, 0.0, 0.0]}}
    arm = choose_method(read_sheet(FOG | rocking)).sections["gravity_fit"]["fit_lever_arm_m"]
    assert arm == pytest.approx(2 / np.sqrt(3), rel=1e-3)
    assert "fit_lever_arm_m" not in choose_method(read()).sections["gravity_fit"]


def test_numbers_as_json_are_those_of_the_advice():
    advice = advise(STEADY | {"advise.wanted_deg": 0.5})
    numbers = json.loads(json.dumps(advice.to_dict()))
    rms = numbers["heading_rms_arcmin"]
    assert rms == advice.heading.rms_arcmin
    assert [one["time_s"] for one in numbers["headings"]] == [60, 120, 300, 600, 1800]
    assert sum(numbers["budget_percent"].values()) == pytest.approx(100)
    assert numbers["dominant"] == "gyro turn-on bias"
    half = advise(STEADY | {"drawn.gyro_bias_deg_per_h": {"normal": [0.0, 0.025]}}).heading
    assert numbers["heading_rms_with_half_of_dominant_arcmin"] == pytest.approx(half.rms_arcmin)
    assert numbers["heading_rms_sec_latitude_arcmin"] == pytest.approx(rms * np.cos(np.radians(48)))
    assert numbers["settles_s"] is None
    band, time_s = advise().settles
    assert band == 1.0 and time_s is not None
    for one in advise().headings:
        assert one.time_s > 300 or (one.within_95_arcmin <= 60) == (one.time_s >= time_s)


@pytest.mark.parametrize("motion", [{}, MOTIONS["rocking"] | {"lever_arm_m": [3.0, 0.0, 2.0]}])
def test_turned_sheet_is_advised_as_it_turns(motion):
    parked = sinsjax.advise(FOG | {"motion": motion})
    (half,) = (one for one in parked.turns.options if one.name == "half turn")
    turned = sinsjax.advise(FOG | {"motion": motion | half.motion})
    assert turned.turns is None and turned.headings[-1].time_s == 300
    assert turned.heading.rms_arcmin == pytest.approx(half.sigma_arcmin, rel=1e-4)
    assert "the sheet turns the base" in "\n".join(describe_advice(turned))


def test_yaw_sway_shows_drift_of_accelerometers():
    drifting = STEADY | {"sensors.accel_instability_ug": 300.0}
    swaying = {"motion.yaw_amplitude_deg": 5.0, "motion.yaw_period_s": 10.0}
    found, parked = (advise(drifting | motion).heading.rms_arcmin for motion in (swaying, {}))
    assert 1.2 * advise(STEADY).heading.rms_arcmin < found < 0.6 * parked


GOES_WRONG = {
    "that is turned may find it": {"drawn.gyro_bias_deg_per_h": {"normal": [0.0, 10.0]}},
    "beyond linear theory": {"drawn.gyro_bias_deg_per_h": {"normal": [0.0, 2.0]}},
    "a surge of 0.1 m/s": {"motion.roll_amplitude_deg": 0.6, "motion.roll_period_s": 8.0},
}


@pytest.mark.nightly(fast=("beyond linear theory", "a surge of 0.1 m/s"))
@pytest.mark.parametrize("words", GOES_WRONG)
def test_what_can_go_wrong_is_a_warning(words):
    assert advise(STEADY).warnings == ()
    assert any(words in line for line in advise(STEADY | GOES_WRONG[words]).warnings)


def test_warning_of_surge_names_the_change_that_gives_its_number_and_another_method():
    turned = STEADY | GOES_WRONG["a surge of 0.1 m/s"] | {"motion.turn_times_s": [140.0]}
    (line,) = advise(turned).warnings
    number, key, value = re.search(r"make it (.+) \(--set (\S+)=(\S+)\)", line).groups()
    surged = advise(turned | {key: float(value)})
    assert f"{number} rms from true north" in "\n".join(describe_advice(surged))
    assert "try gravity_fit" in surged.warnings[-1]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sensors.gyro_arw_deg_per_sqrt_h": 0.5}, "usually 0.02 to 1 times"),
        ({"drawn.gyro_bias_deg_per_h": {"normal": [0.0, 0.005]}}, "0.005 deg/s are 18 deg/h"),
        ({"drawn.gyro_bias_deg_per_h": {}}, "no turn-on bias (gyro_bias_deg_per_h in"),
        ({"drawn.accel_bias_ug": {}}, "no turn-on bias (accel_bias_ug in"),
    ],
)
def test_values_that_do_not_fit_are_doubts(changes, words):
    assert any(words in line for line in read(changes).doubts)


def test_motion_of_sheet_that_is_replaced_is_a_doubt():
    given = read_sheet(FOG | {"motion": MOTIONS["rocking"]}, motion="still")
    assert ["still motion replaces [motion] of the sheet"] == [*given.doubts]
    assert read(motion="rocking").doubts == ()


@refused("""
sensors.gyro_noise_deg_per_h = 1.0       -> [sensors] gyro_arw_deg_per_sqrt_h: required
sensors.gyro_arw_deg_per_sqrt_h = 50.0   -> [sensors] gyro_arw_deg_per_sqrt_h: 50 0 3
sensors.gyro_arw = 0.01                  -> [sensors] gyro_arw: gyro_arw_deg_per_sqrt_h
drawn.gyro_bias_deg_per_s.normal = [0, 1] -> [drawn] gyro_bias_deg_per_s: gyro_bias_deg_per_h 3600
drawn.accel_bias_ug.uniform = [0, 1]     -> [drawn] accel_bias_ug: normal
drawn.gyro_bias_deg_per_h.normal = [0.5, 1] -> [drawn] gyro_bias_deg_per_h: 0.0
drawn.accel_vrw_ug_per_sqrt_hz.uniform = [10, 20] -> [drawn] accel_vrw_ug_per_sqrt_hz: fixed
advise.time_s = 3.0                      -> [advise] time_s: 10 3
advise.tim_s = 3.0                       -> [advise] tim_s: time_s
study.rate_hz = 102.4                    -> [study] rate_hz: 102.4
motion.vibration_deg_per_h_rms = 18_000.0 & motion.lever_arm_m = 2.0
    -> [motion] vibration_deg_per_h_rms: lever_arm_m
axes.latitude_deg = [1.0]                -> [axes]: sheet
alignment.method = "inertial"            -> [alignment]: sheet
earth = {}                               -> [earth] latitude_deg: required
""")
def test_bad_sheet_is_refused_in_a_line(refusal):
    tables = refusal.tables.items()
    changes = {f"{name}.{key}": value for name, table in tables for key, value in table.items()}
    first, *_ = refusal_lines(advise, changes or refusal.tables)
    refusal.check(first.removeprefix("sheet: "))


def test_keys_of_other_makers_are_named_all_at_once():
    given = {
        "gyro_bias_instability_deg_per_s": "gyro_instability_deg_per_h 3600",
        "gyro_bias_instability_rad_per_s": "gyro_instability_deg_per_h 206265",
        "gyro_noise_density_deg_per_s_per_sqrt_hz": "gyro_arw_deg_per_sqrt_h 60",
        "gyro_rad_per_s_per_sqrt_hz": "gyro_arw_deg_per_sqrt_h 3437.75",
        "accel_turn_on_bias_mg": "accel_bias_ug 1000",
        "accel_vrw_m_per_s_per_sqrt_h": "accel_vrw_ug_per_sqrt_hz 1699.53",
    }
    lines = refusal_lines(advise, {f"sensors.{key}": 0.1 for key in given})
    for line, (key, words) in zip(lines, given.items(), strict=True):
        assert_refusal(line, f"sheet: [sensors] {key}: {words}")


@pytest.mark.parametrize("name", ["sensors", "drawn", "study", "advise"])
def test_section_that_is_no_table_is_refused(name):
    for table in (3, "x", [1, 2]):
        with pytest.raises(InputError, match=rf"^sheet: \[{name}\]: "):
            sinsjax.advise(FOG | {name: table})


@pytest.mark.parametrize("options", [{"imu": "kvh"}, {"imu": "kvh1775", "motion": "swim"}])
def test_unknown_name_lists_the_known_ones(options):
    with pytest.raises(InputError, match="is none of .*(kvh1775|rocking)"):
        sinsjax.advise(**options, latitude_deg=48.0)
    with pytest.raises(InputError, match="one of the two"):
        sinsjax.advise(FOG, imu="kvh1775")


@pytest.mark.parametrize("name", shipped_sheets())
def test_shipped_sheet_names_its_source_and_has_no_doubt(name):
    text = shipped_sheets()[name].read_text()
    assert "# Source: " in text and "read 20" in text
    assert read_sheet(None, imu=name, latitude_deg=45.0).doubts == ()


def test_command_prints_one_screen_and_writes_a_study(tmp_path, monkeypatch, capsys):
    command = command_line(monkeypatch, capsys)
    sheet, study = tmp_path / "my.toml", tmp_path / "check.toml"
    sheet.write_text(tomli_w.dumps(FOG))
    code, out, _ = command("advise", sheet, "--time", 200, "--motion", "rocking", "--study", study)
    assert code == 0 and len(out.splitlines()) <= 45
    assert sinsjax.load_study(study).values("method") == ["gravity_fit"]
    code, out, error = command("advise", sheet, "--study", tmp_path / "no_folder" / "check.toml")
    assert (code, out) == (2, "") and error.count("\n") == 1 and "no_folder" in error
    before = study.read_bytes()
    code, _, error = command("advise", sheet, "--study", study)
    assert code == 2 and str(study) in error and study.read_bytes() == before
    _, out, _ = command("advise", sheet, "--json", "--time", 200)
    rms = sinsjax.advise(sheet, time_s=200.0).heading.rms_arcmin
    assert json.loads(out)["heading_rms_arcmin"] == rms
    _, out, _ = command("advise", "--imu", "list")
    assert all(name in out for name in shipped_sheets())


@pytest.mark.nightly(fast=("few",))
@pytest.mark.parametrize("case", ["few", "many"])
def test_shares_are_the_slopes_of_the_bound_and_add_up(case):
    given = read(MANY if case == "many" else {})
    budget = budget_of(given, [60.0, 200.0])
    if case == "many":
        assert {"surge", "gyro_walk", "accel_quantisation", "gyro_scale"} <= {*budget.sources}
    for time_s, row in zip(budget.times_s, budget.variance, strict=True):
        shares = budget.shares(time_s)
        assert sum(shares.values()) == pytest.approx(1)
        assert [*shares.values()] == sorted(shares.values(), reverse=True)
        assert np.all(row > 0)
    for k, source in enumerate(budget.sources):
        more, less = (
            budget_of(scale_source(given, source, factor), [60.0, 200.0]).sigma ** 2
            for factor in (1.02, 0.98)
        )
        slope = (more - less) / (2 * np.log(1.02 / 0.98))
        np.testing.assert_allclose(budget.variance[:, k], slope, rtol=0.02, atol=1e-6 * more.max())


@pytest.mark.parametrize("source", ["gyro_instability", "gyro_bias"])
def test_source_without_a_model_leaves_the_weights_of_the_others(source):
    given = read({"motion.turn_times_s": [90.0], "motion.turn_angles_deg": [180.0]})
    known, unknown = budget_of(given, [200.0]), budget_of(given, [200.0], (source,))
    without = budget_of(scale_source(given, source, 0.0), [200.0])
    for name, share in zip(without.sources, without.variance[0], strict=True):
        k = unknown.sources.index(name)
        assert unknown.variance[0, k] == pytest.approx(share, rel=1e-9)
    assert without.sigma[0] < known.sigma[0] < unknown.sigma[0]


@pytest.mark.parametrize("sigma", [0.01, 0.2, 0.6, 3.0])
def test_wrapped_heading_is_that_of_a_vector_with_noise(sigma):
    rng = np.random.default_rng(1)
    x, y = 1 + sigma * rng.standard_normal(400_000), sigma * rng.standard_normal(400_000)
    angle = np.abs(np.arctan2(y, x))
    expected = np.sqrt(np.mean(angle**2)), np.quantile(angle, 0.95)
    assert rms_and_q95_of_noisy_direction(sigma) == pytest.approx(expected, rel=0.01)

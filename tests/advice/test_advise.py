"""Advice: its numbers against draws, what it writes and refuses, and its doubts."""

import json
import tomllib
from functools import cache
from typing import Any

import numpy as np
import pytest
from support.commands import command_line
from support.refusals import assert_refusal

import sinsjax
from sinsjax.advice.advise import (
    Budget,
    choose_method,
    describe_advice,
    heading_budget,
    sheet_problem,
)
from sinsjax.advice.sheet import MOTIONS, Sheet, read_sheet, shipped_sheets
from sinsjax.errors import InputError

FOG: dict[str, Any] = {
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
SURGE = {"motion.surge_m_per_s": 0.1, "motion.surge_time_s": 5.0}


def read(changes: dict[str, Any] | None = None, **options: Any) -> Sheet:
    return read_sheet(FOG, changes=changes, **options)


def budget_of(sheet: Sheet, *times_s: float) -> Budget:
    return heading_budget(sheet_problem(sheet), times_s)


def advise(changes: dict[str, Any] | None = None, **options: Any) -> sinsjax.Advice:
    return advise_once(json.dumps({"changes": changes} | options))


@cache
def advise_once(options: str) -> sinsjax.Advice:
    return sinsjax.advise(FOG, **json.loads(options))


@pytest.mark.nightly
@pytest.mark.parametrize("motion", ["rocking", "surging"])
@pytest.mark.optimised(False)
def test_study_that_is_written_confirms_the_rms(motion):
    advice = advise(motion=motion, time_s=200.0)
    study = sinsjax.study_from_dict(tomllib.loads(advice.study())).replace(
        {"study.rate_hz": 10.0, "study.draws": 128}
    )
    assert study.n_draws == 128
    summary = sinsjax.run(study).summary
    for time_s, column in ((120, "phi_u_at_120_arcmin"), (200, "phi_u_arcmin")):
        (expected,) = (h.rms_arcmin for h in advice.headings if h.time_s == time_s)
        errors = np.asarray(summary[column], float)
        assert expected == pytest.approx(np.sqrt(np.mean(errors**2)), rel=0.2)


def test_settings_are_those_of_the_sheet_and_its_motion():
    still, surge = choose_method(read()), choose_method(read(motion="surging"))
    assert still.sections == {
        "alignment": {"method": "gravity_fit"},
        "gravity_fit": {
            **{"fit_gyro_bias_deg_per_h": 0.05, "fit_gyro_arw_deg_per_sqrt_h": 0.005},
            **{"fit_accel_bias_ug": 200.0, "fit_accel_vrw_ug_per_sqrt_hz": 30.0},
        },
    }
    assert surge.sections["surge"] == {"r_surge_m_per_s": 0.1, "r_surge_time_s": 5.0}
    assert surge.sections["filter"] == {
        **{"q_reading": "psd", "q_gyro_arw_deg_per_sqrt_h": 0.005},
        **{"q_accel_ug_per_sqrt_hz": 30.0},
    }
    swaying = {"motion": MOTIONS["rocking"] | {"lever_arm_m": [2.0, 0.0, 0.0]}}
    arm = choose_method(read_sheet(FOG | swaying)).sections["gravity_fit"]["fit_lever_arm_m"]
    assert arm == pytest.approx(2 / np.sqrt(3), rel=1e-3)
    assert advise().choice.sections == still.sections


def test_numbers_as_json_are_those_of_the_advice():
    advice = advise(STEADY | {"advise.wanted_deg": 0.5})
    numbers = json.loads(json.dumps(advice.to_dict()))
    assert numbers["heading_rms_arcmin"] == advice.heading.rms_arcmin
    assert [one["time_s"] for one in numbers["headings"]] == [60, 120, 300, 600, 1800]
    assert sum(numbers["budget_percent"].values()) == pytest.approx(100)
    assert numbers["dominant"] == "gyro turn-on bias"
    half = advise(STEADY | {"drawn.gyro_bias_deg_per_h": {"normal": [0.0, 0.025]}})
    assert numbers["heading_rms_with_half_of_dominant_arcmin"] == pytest.approx(
        half.heading.rms_arcmin
    )
    cosine = np.cos(np.radians(48))
    sec = numbers["heading_rms_sec_latitude_arcmin"]
    assert sec == pytest.approx(numbers["heading_rms_arcmin"] * cosine)
    assert numbers["settles_s"] is None


@pytest.mark.nightly(fast=("60.0",))
@pytest.mark.parametrize("time_s", [10.0, 60.0, 1800.0])
def test_any_time_can_be_asked_for(time_s):
    found = advise(STEADY | SURGE, time_s=time_s)
    assert found.heading.time_s == time_s and found.choice.method == "kalman_surge"
    assert found.halved_rms_arcmin < found.heading.rms_arcmin
    floor = np.degrees(0.05 / (15.04 * np.cos(np.radians(48)))) * 60
    assert found.headings[-1].rms_arcmin > floor


def test_sheet_without_drawn_biases_is_noise_alone():
    sheet = read_sheet({key: FOG[key] for key in ("earth", "sensors")})
    assert {*budget_of(sheet, 60.0).sources} <= {
        f"{a}_{b}" for a in ("gyro", "accel") for b in ("noise", "instability")
    }
    assert len(sheet.doubts) == 1


def test_turned_sheet_is_advised_as_it_turns():
    motion = {"turn_times_s": [140.5], "turn_angles_deg": [180.0], "turn_rate_deg_per_s": 10.0}
    turned = sinsjax.advise(FOG | {"motion": motion | {"turn_ramp_s": 1.0}})
    assert turned.turns is None and turned.headings[-1].time_s == 300
    (half,) = (one for one in advise().turns.options if one.name == "half turn")
    assert turned.heading.rms_arcmin == pytest.approx(half.sigma_arcmin, rel=0.02)
    assert "the sheet turns the base" in "\n".join(describe_advice(turned))


def test_band_is_reached_when_95_percent_are_within_it():
    advice = advise()
    band, time_s = advice.settles
    assert band == 1.0 and time_s is not None
    for one in advice.headings:
        if one.time_s <= 300:
            assert (one.within_95_arcmin <= 60) == (one.time_s >= time_s)


@pytest.mark.nightly(fast=("drift", "half degree"))
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"drawn.gyro_bias_deg_per_h": {"normal": [0.0, 10.0]}}, "that is turned may find it"),
        ({"drawn.gyro_bias_deg_per_h": {"normal": [0.0, 2.0]}}, "beyond linear theory"),
        (
            {"motion.roll_amplitude_deg": 0.6, "motion.roll_period_s": 8.0},
            "a surge of 0.1 m/s rms would make it",
        ),
    ],
    ids=["no north", "drift", "half degree"],
)
def test_what_can_go_wrong_is_a_warning(changes, words):
    assert advise(STEADY).warnings == ()
    assert any(words in line for line in advise(STEADY | changes).warnings)


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


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"sensors.gyro_noise_deg_per_h": 1.0}, "[sensors] gyro_arw_deg_per_sqrt_h: required"),
        ({"sensors.gyro_arw_deg_per_sqrt_h": 50.0}, "[sensors] gyro_arw_deg_per_sqrt_h: 50 0 3"),
        (
            {"drawn.gyro_bias_deg_per_s": {"normal": [0.0, 1.0]}},
            "[drawn] gyro_bias_deg_per_s: gyro_bias_deg_per_h 3600",
        ),
        ({"sensors.gyro_arw": 0.01}, "[sensors] gyro_arw: gyro_arw_deg_per_sqrt_h"),
        ({"drawn.accel_bias_ug": {"uniform": [0.0, 1.0]}}, "[drawn] accel_bias_ug: normal"),
        ({"drawn.gyro_bias_deg_per_h": {"normal": [0.5, 1.0]}}, "[drawn] gyro_bias_deg_per_h: 0.0"),
        (
            {"drawn.accel_vrw_ug_per_sqrt_hz": {"uniform": [10.0, 20.0]}},
            "[drawn] accel_vrw_ug_per_sqrt_hz: fixed",
        ),
        ({"advise.time_s": 3.0}, "[advise] time_s: 10 3"),
        ({"advise.tim_s": 3.0}, "[advise] tim_s: time_s"),
        ({"study.rate_hz": 102.4}, "[study] rate_hz: 102.4"),
        (
            {"motion.vibration_deg_per_h_rms": 18_000.0, "motion.lever_arm_m": 2.0},
            "[motion] vibration_deg_per_h_rms: lever_arm_m",
        ),
        ({"axes.latitude_deg": [1.0]}, "[axes]: sheet"),
        ({"alignment.method": "inertial"}, "[alignment]: sheet"),
        ({"earth": {}}, "[earth] latitude_deg: required"),
    ],
)
def test_bad_sheet_is_refused_in_a_line(changes, told):
    with pytest.raises(InputError) as refused:
        advise(changes)
    assert_refusal(refused.value.lines[0], f"sheet: {told}")


def test_keys_of_other_makers_are_named_all_at_once():
    given = {
        "gyro_bias_instability_deg_per_s": "gyro_instability_deg_per_h 3600",
        "gyro_bias_instability_rad_per_s": "gyro_instability_deg_per_h 206265",
        "gyro_noise_density_deg_per_s_per_sqrt_hz": "gyro_arw_deg_per_sqrt_h 60",
        "gyro_rad_per_s_per_sqrt_hz": "gyro_arw_deg_per_sqrt_h 3437.75",
        "accel_turn_on_bias_mg": "accel_bias_ug 1000",
        "accel_vrw_m_per_s_per_sqrt_h": "accel_vrw_ug_per_sqrt_hz 1699.53",
    }
    with pytest.raises(InputError) as refused:
        advise({f"sensors.{key}": 0.1 for key in given})
    assert len(refused.value.lines) == len(given)
    for line, (key, words) in zip(refused.value.lines, given.items(), strict=True):
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
    sheet.write_text(
        "[earth]\nlatitude_deg = 48\n[sensors]\ngyro_arw_deg_per_sqrt_h = 0.005\n"
        "accel_vrw_ug_per_sqrt_hz = 30\n[drawn]\ngyro_bias_deg_per_h = {normal = [0, 0.05]}\n"
        "accel_bias_ug = {normal = [0, 200]}\n"
    )
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

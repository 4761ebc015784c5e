"""`sinsjax init record --from`: logs of a base that is turned become studies that use the turns."""

import re
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.turning_logs import DEG, DEG_PER_H, PARKED, TURNS, G, turned_record

import sinsjax as package
from sinsjax.records.layout import NAMED_AXES, from_body_axes
from sinsjax.study.from_record import make_study_text

pytestmark = [pytest.mark.optimised(False), pytest.mark.usefixtures("drawn_on_request")]

RATE = 25.0
UNITS = {
    "rad/s and m/s^2": ("gyro_@ [rad/s]", 1.0, "accel_@ [m/s^2]", 1.0, "rad_per_s"),
    "deg/s and g": ("gyro_@ [deg/s]", DEG, "accel_@ [g]", G, "deg_per_s"),
    "deg/h and ug": ("w@ [deg/h]", DEG_PER_H, "f@ [ug]", 1e-6 * G, "deg_per_h"),
    "increments": ("dtheta_@ [deg]", DEG * RATE, "dv_@ [m/s]", RATE, "deg"),
    "no units, SI": ("gyro_@", 1.0, "accel_@", 1.0, "rad_per_s"),
    "no units, deg/s": ("gyro_@", DEG, "accel_@", G, "deg_per_s"),
}
"""Names and units of gyros and accelerometers, and the unit to find."""

simulated = cache(turned_record)


def write_log(path: Path, motion: str, units: str = "rad/s and m/s^2", gyro: Any = 1.0) -> Path:
    """Write a log in axes front, left, up; its gyros multiplied by a number, or one per axis."""
    some = simulated(motion)
    gyro_name, gyro_unit, accel_name, accel_unit, _ = UNITS[units]
    order = NAMED_AXES["flu"]
    rates = from_body_axes(some.gyro, order) * gyro / gyro_unit
    forces = from_body_axes(some.accel, order) / accel_unit
    names = [name.replace("@", axis) for name in (gyro_name, accel_name) for axis in "xyz"]
    time_s = np.arange(1, len(rates) + 1) / RATE
    table = np.column_stack([time_s, rates, forces])
    np.savetxt(path, table, "%.15g", ",", header=",".join(["time_s", *names]), comments="")
    return path


def marks(text: str) -> list[str]:
    """Return the doubts and questions of a study."""
    found = re.findall(r"^# (?:DOUBT|QUESTION): .*(?:\n#   .*)*", text, re.MULTILINE)
    return [" ".join(mark.replace("\n#  ", "").split()) for mark in found]


@pytest.mark.nightly(fast=("increments-four positions", "no units, deg/s-one-way carousel"))
@pytest.mark.parametrize("motion", TURNS)
@pytest.mark.parametrize("units", UNITS)
def test_turning_log_has_no_doubt_but_its_hemisphere(motion, units, tmp_path):
    text = make_study_text(write_log(tmp_path / "log.csv", motion, units), Path("its.toml"))
    (mark,) = marks(text)
    assert mark.startswith("# DOUBT: ")
    study = tomllib.loads(text)
    assert study["earth"]["latitude_deg"] == pytest.approx(48.0, abs=1.5)
    assert study["record"]["gyro_unit"] == UNITS[units][-1]


def test_turning_log_is_aligned_by_gravity_fit_with_the_noise_of_its_samples(tmp_path):
    path = write_log(tmp_path / "log.csv", "one turn by 180")
    study = tomllib.loads(make_study_text(path, Path("its.toml")))
    assert study["alignment"] == {"method": "gravity_fit"}
    section = study["gravity_fit"]
    assert section["fit_gyro_arw_deg_per_sqrt_h"] == pytest.approx(0.02, rel=0.05)
    assert section["fit_accel_vrw_ug_per_sqrt_hz"] == pytest.approx(50.0, rel=0.05)
    assert section["fit_gyro_bias_deg_per_h"] == 10 and section["fit_accel_bias_ug"] == 5000


def test_log_of_parked_base_does_not_mention_turns(tmp_path):
    text = make_study_text(write_log(tmp_path / "log.csv", "parked"), Path("its.toml"))
    assert not marks(text) and "turns" not in text


def test_all_of_a_long_turning_log_is_aligned(tmp_path):
    """A turn after 16 min would be cut off, as the rest of the log of a parked base is."""
    for turns, fine_s in ((((960.0,), (180.0,), 10.0), 1909.0), (PARKED, 900.0)):
        some = turned_record(turns, length_s=1920.0, rate_hz=5.0)
        table = np.column_stack([np.arange(1, len(some.gyro) + 1) / 5.0, some.gyro, some.accel])
        names = "time_s,rfu_gx,rfu_gy,rfu_gz,ax,ay,az"
        path = tmp_path / "log.csv"
        np.savetxt(path, table, "%.12g", ",", header=names, comments="")
        text = make_study_text(path, Path("its.toml"))
        assert tomllib.loads(text)["study"]["duration_s"] == fine_s


@pytest.mark.nightly
def test_fit_that_contradicts_its_sensors_is_a_caution(sinsjax):
    path, config = Path("log.csv"), Path("its.toml")
    config.write_text(make_study_text(write_log(path, "four positions"), config))
    write_log(path, "four positions", gyro=np.array([1.0, 1.0, -1.0]))
    trust = ("--set", "record.trust=true")  # refused, unless the user insists
    code, printed, _ = sinsjax("align", "log.csv", "its.toml", "-o", "out", *trust)
    assert code == 0 and "residuals" in " ".join(printed.split())
    (row,) = package.read_summary("out").to_pylist()
    assert row["fit_misfit"] > 3

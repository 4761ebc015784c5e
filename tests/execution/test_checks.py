"""Doubts about a record are reported before its alignment, or the record is refused."""

import json
import math
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.stored_results import report_text
from support.studies import small_study, with_paper_values

from sinsjax.arena.export import simulated_record
from sinsjax.errors import InputError, StudyWarning
from sinsjax.execution import prepare, run
from sinsjax.execution.prepare import band_warnings
from sinsjax.records import Record, Reference
from sinsjax.records.checks import StationaryValues, check_stationary
from sinsjax.records.layout import Finding
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import study_from_dict
from sinsjax.study.study import Study
from sinsjax.units import DEG, DEG_PER_H, micro_g

pytestmark = pytest.mark.optimised(False)

SPAN = (0, 20_000)
STILL = {f"{angle}_amplitude_deg": 0.0 for angle in ("pitch", "roll", "yaw")}
LARGE = {f"{angle}_amplitude_deg": 20.0 for angle in ("pitch", "roll", "yaw")}
BASES = {"still": STILL, "swinging": {}, "swinging by 20 deg": LARGE}
UP = np.array([0, 0, 15.041067 * math.sin(32 * DEG)]) * DEG_PER_H / 100
"""Vertical Earth rate of a sample at 32 N, rad."""


@cache
def record(base: str = "swinging") -> Record:
    """Return a record of 200 s at 32 N with 0.1 deg/h and 500 ug."""
    settings = {"duration_s": 200.0, "window_s": [0, 200]}
    return simulated_record(small_study(study=settings, motion=BASES[base]))


def found(
    some: Record,
    *,
    gyro: float | None = 10.0,
    accel: float = 5000.0,
    latitude: float = 32.0,
) -> list[Finding]:
    expected = StationaryValues(15.041067 * DEG_PER_H, latitude * DEG, 9.8, gyro, accel * micro_g())
    return check_stationary(some, SPAN, expected)


def gyros(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Record], Record]:
    return lambda some: some._replace(dtheta=change(some.dtheta))


def accels(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Record], Record]:
    return lambda some: some._replace(dv=change(some.dv))


def biased(*deg_per_h: float) -> Callable[[Record], Record]:
    return gyros(lambda dtheta: dtheta + np.array(deg_per_h) * DEG_PER_H / 100)


@pytest.mark.parametrize("base", BASES)
def test_plausible_record_has_no_findings(base: str) -> None:
    assert not found(record(base)) and not found(record(base), gyro=1.0)


def test_wrong_accelerometer_unit_is_refused_and_named() -> None:
    some = record()
    for factor, words in (
        (1 / 9.80665, "accelerometers' unit"),
        (9.80665, "9.81 times gravity"),
        (-1.0, "points down"),
    ):
        (first, *_) = found(some._replace(dv=some.dv * factor))
        assert first.is_certain and words in first.text
    turned = [v[:, [1, 0, 2]] * [1, 1, -1] for v in (some.dtheta, some.dv)]
    (first, *_) = found(some._replace(dtheta=turned[0], dv=turned[1]))
    assert first.is_certain and "'yx-z' for front-right-down" in first.text


@pytest.mark.parametrize(
    ("base", "change", "options", "words", "hides_north"),
    [
        ("still", gyros(lambda v: v / DEG), {}, "57.6 times Earth rate", True),
        ("still", gyros(lambda v: v * DEG), {}, "has Earth rate been", True),
        ("still", gyros(lambda v: v - UP), {"gyro": 3.0}, "a gyro bias of 7.86 deg/h", False),
        ("still", gyros(lambda v: v - 2 * UP), {}, "vertical part has the wrong sign", True),
        # 860 deg/h would be Earth rate in other units, but not along the vertical.
        ("still", biased(700.0, 0, 0), {}, "hides Earth rate", True),
        ("still", lambda some: some, {"latitude": 14.0}, "not 14:", False),
        ("still", biased(0, 4, 4), {"gyro": 1.0}, "a gyro bias of 5.7", False),
        ("still", accels(lambda v: v * 0.99), {}, "0.991 times gravity", False),
        ("still", gyros(lambda v: v / 2), {"gyro": None}, "0.505 times Earth rate", False),
    ],
)
def test_doubtful_record_is_named_with_its_likely_cause(
    base: str,
    change: Callable[[Record], Record],
    options: dict[str, Any],
    words: str | None,
    hides_north: bool,
) -> None:
    """The unit is stated: whether it or the gyros are wrong, level angles are right."""
    findings = found(change(record(base)), **options)
    assert len(findings) == (words is not None)
    for one in findings:
        assert words is not None and words in one.text and not one.is_certain
        assert one.hides_north == hides_north


# As part of a study


def recorded(**changes: Any) -> Study:
    data: dict[str, Any] = {
        "study": {"duration_s": 30.0, "record_interval_s": 5.0, "window_s": [0, 30]},
        "earth": {"latitude_deg": 32.0},
        "record": {"format": "psins"},
        "coarse": {"coarse_duration_s": 60.0},
    }
    for name, section in changes.items():
        data[name] = data.get(name, {}) | section
    return study_from_dict(with_paper_values(data))


@pytest.mark.nightly
def test_nis_scales_inversely_with_r_and_is_null_without_filter() -> None:
    """With P and Q next to nothing, S is R: a hundred times the variance, a hundredth of NIS."""
    small = {f"p0_{key}": 1e-6 for key in ("velocity_m_per_s", "level_deg", "yaw_deg")}
    small |= {"q_accel_ug": 0.0, "q_gyro_deg_per_h": 0.0}
    axes = {"method": ["kalman5", "compass"], "r_velocity_m_per_s": [0.1, 1.0]}
    made = run.run(recorded(filter=small, axes=axes), StoredRecord(record(), None))
    found = made.summary["innovation_nis"].to_pylist()
    assert found[0] / found[1] == pytest.approx(100, rel=1e-3) and found[2:] == [None, None]


def test_hard_findings_are_refused_unless_record_is_trusted(tmp_path: Path) -> None:
    some = record()
    stored = StoredRecord(some._replace(dv=-some.dv, source="drive.imu"), None)
    with pytest.raises(InputError) as caught:
        run.run_into(recorded(), tmp_path / "out", stored)
    line = str(caught.value)
    assert line.startswith("drive.imu: 0 to 90 s: the specific force points down")
    assert "trust = true" in line and "\n" not in line and not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="points down"):
        run.run(recorded(), stored)
    trusting = recorded(record={"trust": True})
    assert "points down" in prepare.prepare_job(trusting, record=stored).warnings[0]


def test_doubts_are_listed_in_manifest_and_report(tmp_path: Path) -> None:
    some = record("still")
    stored = StoredRecord(
        some._replace(dv=some.dv * 0.99, source="drive.imu", remarks=("3 missing",)), None
    )
    with pytest.warns(StudyWarning):
        run.run_into(recorded(), tmp_path / "out", stored)
    filled, light = json.loads((tmp_path / "out" / "manifest.json").read_text())["warnings"]
    assert filled.startswith("drive.imu: 3 missing")
    assert light.startswith("drive.imu: 0 to 90 s: the mean specific force is 9.7")
    words = " ".join(report_text(tmp_path / "out").split())
    assert f"Warning {filled}" in words and f"Warning {light}" in words


def test_data_after_to_s_are_not_used() -> None:
    stored = StoredRecord(record(), None)
    study = recorded(record={"from_s": 100.0, "to_s": 190.0})
    assert not prepare.prepare_job(study, record=stored).warnings
    study = recorded(record={"from_s": 101.0, "to_s": 190.0})
    with pytest.raises(InputError, match=r"needs data up to 191 s, but \[record\] to_s is 190"):
        prepare.prepare_job(study, record=stored)


def test_fractional_rate_and_late_clock_use_record_times() -> None:
    """Times are those of the record: 200 samples a record are 1.001 s."""
    rate = 199.8
    some = record("still")._replace(rate_hz=rate, t0_s=1763000000.25)
    study = recorded(
        study={"duration_s": 5.0, "record_interval_s": 1.0, "window_s": [0, 5]},
        record={"start_s": [0.0, 2.0], "trust": True},
        coarse={"coarse_duration_s": 10.0},
        alignment={"feedback_interval_s": 0.1},
    )
    with pytest.warns(StudyWarning):
        made = run.run(study, StoredRecord(some, None), curves=True)
    times = made.curves["time_s"].to_pylist()[:4]
    np.testing.assert_allclose(times, 200 / rate * np.arange(1, 5), rtol=1e-9)
    starts = made.summary["start_s"].to_pylist()
    np.testing.assert_allclose(starts, [0, 400 / rate], rtol=1e-9)
    late = Reference(1000 + np.arange(21.0), np.zeros((21, 3)), "r.csv")
    with pytest.raises(InputError, match=r"covers 1763001000.25 to 1763001020.25 s, .* clocks dif"):
        run.run(study, StoredRecord(some, late))


# Bands of simulations


TACTICAL = {
    "study": {"duration_s": 600.0, "window_s": [400, 600], "settle_bands_arcmin": [60, 10]},
    "sensors": {"gyro_noise_deg_per_h": None, "gyro_arw_deg_per_sqrt_h": 0.02},
}


@pytest.mark.parametrize(
    ("changes", "band"),
    [
        ({}, "10'"),
        ({"study.settle_bands_arcmin": [60], "study.success_band_arcmin": 12}, "12'"),
        ({"axes.gyro_arw_deg_per_sqrt_h": [0.02, 0.1]}, "10'"),
        ({"axes.gyro_arw_deg_per_sqrt_h": [0.02, 0.001]}, None),  # one of the variants reaches it
        ({"drawn.gyro_arw_deg_per_sqrt_h.uniform": [0.02, 0.1]}, None),
        ({"filter.p0_yaw_deg": 0.1}, None),  # the start knows the heading
    ],
)
def test_band_below_the_noise_of_the_sensors_is_warned_of(
    changes: dict[str, Any], band: str | None
) -> None:
    lines = list(band_warnings(small_study(**TACTICAL).replace(changes)))
    assert len(lines) == (band is not None)
    for line in lines:
        assert line.startswith(f"{band} cannot be reached reliably") and "in 600 s (29'," in line

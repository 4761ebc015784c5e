"""Records of a base that turns are accepted; wrong units and signs of their gyros are named."""

from functools import cache

import numpy as np
import pytest
from support.turning_logs import DEG, DEG_PER_H, EARTH_RATE, TURNS, G, Turned, turned_record

from sinsjax.execution.prepare import prepare_job
from sinsjax.records.checks import StationaryValues, check_stationary
from sinsjax.records.layout import Finding, Record, RecordLayout
from sinsjax.records.motion import Turns, compute_means
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import study_from_dict

LATITUDE = 48 * DEG
HORIZONTAL_DEG_PER_H = EARTH_RATE * np.cos(LATITUDE) / DEG_PER_H
LAYOUT = RecordLayout("csv", gyro_unit="rad_per_s", accel_unit="m_per_s2")

simulated = cache(turned_record)


def as_record(some: Turned, factor: tuple[float, ...] = (1.0, 1.0, 1.0)) -> Record:
    return Record(
        some.gyro * np.array(factor) / some.rate_hz, some.accel / some.rate_hz, some.rate_hz
    )


def measured(some: Turned) -> Turns:
    turns = compute_means(as_record(some), (0, len(some.gyro)), G).turns
    assert turns is not None
    return turns


def found(some: Turned, factor: tuple[float, ...] = (1.0, 1.0, 1.0)) -> list[Finding]:
    record = as_record(some, factor)
    expected = StationaryValues(EARTH_RATE, LATITUDE, G, gyro_bias_deg_per_h=10.0)
    return check_stationary(record, (0, len(record.dv)), LAYOUT, expected)


@pytest.mark.nightly(fast=("one turn by 180",))
@pytest.mark.parametrize("motion", TURNS)
def test_drift_of_turning_base_is_horizontal_earth_rate(motion):
    """1 deg/h and 500 ug, of which 0.88 are level; the ARW of 300 s is 0.1 deg/h."""
    turns = measured(simulated(motion))
    assert turns.drift / DEG_PER_H == pytest.approx(HORIZONTAL_DEG_PER_H, abs=0.3)
    assert turns.drift_uncertainty < 0.15 * DEG_PER_H
    assert turns.gyro_bias < 1.1 * DEG_PER_H and turns.accel_bias < 600e-6
    turned_deg = {"one turn by 180": 180, "one turn by 90": 90, "four positions": 270}
    if motion in turned_deg:
        assert turns.angle / DEG == pytest.approx(turned_deg[motion], abs=2)


@pytest.mark.nightly(fast=("four positions",))
@pytest.mark.parametrize("motion", ["one turn by 180", "four positions", "reversing carousel"])
def test_biases_of_turning_base_are_found(motion):
    turns = measured(turned_record(motion, gyro_bias_deg_per_h=50.0, accel_bias_ug=2000.0))
    assert turns.gyro_bias / DEG_PER_H == pytest.approx(50 * np.hypot(0.6, 0.64), rel=0.02)
    assert turns.accel_bias == pytest.approx(2000e-6 * np.hypot(0.6, 0.64), rel=0.08)
    assert turns.drift / DEG_PER_H == pytest.approx(HORIZONTAL_DEG_PER_H, abs=0.3)


@pytest.mark.nightly(fast=("0.01-one turn by 180", "8.0-reversing carousel"))
@pytest.mark.parametrize("motion", TURNS)
@pytest.mark.parametrize("bias_deg_per_h", [0.01, 1.0, 8.0])
def test_turning_base_is_accepted_without_a_word(motion, bias_deg_per_h):
    assert not found(turned_record(motion, gyro_bias_deg_per_h=bias_deg_per_h))


@pytest.mark.nightly(fast=("unit-one-way carousel", "unit-one turn by 180", "up-four positions"))
@pytest.mark.parametrize("motion", TURNS)
@pytest.mark.parametrize(
    "factor",
    [(DEG,) * 3, (1 / 3600,) * 3, (-1, 1, 1), (1, -1, 1), (1, 1, -1)],
    ids=["unit", "smaller unit", "right", "front", "up"],
)
def test_wrong_unit_or_sign_of_gyros_on_turning_base_leaves_level(motion, factor):
    """Pitch and roll stay while the base turns about the vertical: those of the mean force."""
    (one,) = found(simulated(motion), factor=factor)
    assert one.hides_north and not one.is_certain


@pytest.mark.parametrize("motion", TURNS)
def test_wrong_sign_of_all_gyros_on_turning_base_is_reported(motion):
    """Two positions that are 180 deg apart are the same with either sign: a fit's misfit tells."""
    findings = found(simulated(motion), factor=(-1, -1, -1))
    if motion == "one turn by 180":
        assert not findings
    elif motion == "one turn by 90":  # a bias of sqrt(2) times the horizontal Earth rate would do
        assert "a gyro bias of 13" in findings[0].text
    else:
        assert findings[0].hides_north and "axes" in findings[0].text


def test_gyros_of_tilting_base_that_show_no_north_are_refused():
    """A turn about a tilted axis changes pitch and roll, which means of the force blur."""
    some = simulated("four positions")
    accel = some.accel + np.outer(np.arange(len(some.accel)) > 4000, [0.5, 0.0, 0.0])
    (one,) = found(some._replace(accel=accel), factor=(1 / 3600,) * 3)
    assert one.is_certain and "the vertical moves by" in one.text


@pytest.mark.parametrize("motion", ["one turn by 180", "one turn by 90"])
def test_two_position_record_keeps_its_method_and_is_not_levelled(motion):
    """The mean rate of two positions lacks Earth rate, which the turn between them shows."""
    record = as_record(turned_record(motion, gyro_bias_deg_per_h=8.0))
    tables = {
        "study": {"duration_s": 280.0, "record_interval_s": 2.0, "window_s": [0, 280]},
        "earth": {"earth": "wgs84", "latitude_deg": 48.0},
        "record": {"format": "arrays"},
        "coarse": {"coarse_duration_s": 20.0},
        "alignment": {"method": "gravity_fit"},
        "gravity_fit": {
            "fit_gyro_bias_deg_per_h": 10.0,
            "fit_gyro_arw_deg_per_sqrt_h": 0.02,
            "fit_accel_bias_ug": 500.0,
            "fit_accel_vrw_ug_per_sqrt_hz": 50.0,
        },
    }
    job = prepare_job(study_from_dict(tables), record=StoredRecord(record, None))
    assert job.study.methods == ("gravity_fit",) and not job.warnings


def test_gyro_bias_beyond_its_limit_is_reported_on_turning_base():
    (one,) = found(turned_record("four positions", gyro_bias_deg_per_h=50.0))
    assert not one.is_certain and not one.hides_north
    assert "the base turns by 273 deg, and a gyro bias of 43" in one.text


def test_turns_that_accelerations_hide_are_reported_as_before():
    some = simulated("four positions")
    rng = np.random.default_rng(2)
    slow = np.repeat(0.3 * rng.normal(size=(30, 3)), len(some.accel) // 30, axis=0)
    (one,) = found(some._replace(accel=some.accel + slow * [1, 1, 0]))
    assert "cannot be determined" in one.text


def test_jerks_of_a_turn_by_hand_are_accepted():
    """Of 1 m/s^2 while it turns, 145 to 164 s."""
    some = simulated("one turn by 180")
    jerks = np.zeros_like(some.accel)
    begin = round(145 * some.rate_hz)
    size = np.random.default_rng(3).normal(size=(37, 3)).repeat(13, axis=0)
    jerks[begin : begin + len(size)] = size
    assert not found(some._replace(accel=some.accel + jerks))


@pytest.mark.nightly(fast=("-1.0-3",))
@pytest.mark.parametrize(("factor", "draws"), [(-1.0, 3), (1.0, 10), (-1.0, 10), (1 / DEG, 10)])
def test_biases_of_parked_gyros_are_not_taken_for_turns(factor, draws):
    """A bias about the vertical looks like a turntable to the gyros alone."""
    parked = turned_record("parked", gyro_bias_deg_per_h=0.0, rate_hz=10.0)
    rng = np.random.default_rng(5)
    for _ in range(draws):
        bias = 10 ** rng.uniform(2, 4) * np.array([0.1, 0.1, 1]) * rng.normal(size=3) * DEG_PER_H
        noise = 0.05 * DEG * rng.normal(size=parked.gyro.shape)
        findings = found(parked._replace(gyro=parked.gyro + bias + noise), factor=(factor,) * 3)
        assert findings and not any(one.is_certain for one in findings)

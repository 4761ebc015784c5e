"""Records of a base that turns are accepted; wrong units and signs of their gyros are named."""

from functools import cache

import numpy as np
import pytest
from support.turning_logs import DEG, DEG_PER_H, EARTH_RATE, TURNS, G, Turned, turned_record

from sinsjax.records.layout import Record, RecordLayout
from sinsjax.records.plausibility import Finding, StationaryValues, check_stationary
from sinsjax.records.turns import Turns, measure_turns

LATITUDE = 48 * DEG
HORIZONTAL_DEG_PER_H = EARTH_RATE * np.cos(LATITUDE) / DEG_PER_H
LAYOUT = RecordLayout("csv", gyro_columns=("a", "b", "c"), accel_columns=("d", "e", "f"))
EVERY = (1.0, 1.0, 1.0)

simulated = cache(turned_record)


def measured(motion: str, factor: tuple[float, ...] = EVERY) -> Turns | None:
    some = simulated(motion)
    dt = 1 / some.rate_hz
    return measure_turns(some.gyro * np.array(factor) * dt, some.accel * dt, dt)


def found(
    some: Turned, unit: str = "rad_per_s", factor: tuple[float, ...] = EVERY
) -> list[Finding]:
    expected = StationaryValues(EARTH_RATE, LATITUDE, G, 10 * DEG_PER_H, 5e-3 * G)
    rate = some.rate_hz
    record = Record(some.gyro * np.array(factor) / rate, some.accel / rate, rate)
    layout = LAYOUT._replace(gyro_unit=unit, accel_unit="m_per_s2")
    return check_stationary(record, (0, len(record.dv)), layout, expected)


@pytest.mark.nightly(fast=("one turn by 180",))
@pytest.mark.parametrize("motion", TURNS)
def test_drift_of_turning_base_is_horizontal_earth_rate(motion):
    """1 deg/h and 500 ug, of which 0.88 are level; the ARW of 300 s is 0.1 deg/h."""
    turns = measured(motion)
    assert turns is not None
    assert turns.drift / DEG_PER_H == pytest.approx(HORIZONTAL_DEG_PER_H, abs=0.3)
    assert turns.drift_uncertainty < 0.15 * DEG_PER_H
    assert turns.gyro_bias < 1.1 * DEG_PER_H and turns.accel_bias < 600e-6
    turned_deg = {"one turn by 180": 180, "one turn by 90": 90, "four positions": 270}
    if motion in turned_deg:
        assert turns.angle / DEG == pytest.approx(turned_deg[motion], abs=2)


@pytest.mark.nightly(fast=("four positions",))
@pytest.mark.parametrize("motion", ["one turn by 180", "four positions", "reversing carousel"])
def test_biases_of_turning_base_are_found(motion):
    some = turned_record(motion, gyro_bias_deg_per_h=50.0, accel_bias_ug=2000.0)
    dt = 1 / some.rate_hz
    turns = measure_turns(some.gyro * dt, some.accel * dt, dt)
    assert turns is not None
    assert turns.gyro_bias / DEG_PER_H == pytest.approx(50 * np.hypot(0.6, 0.64), rel=0.02)
    assert turns.accel_bias == pytest.approx(2000e-6 * np.hypot(0.6, 0.64), rel=0.08)
    assert turns.drift / DEG_PER_H == pytest.approx(HORIZONTAL_DEG_PER_H, abs=0.3)


@pytest.mark.nightly(fast=("0.01-one turn by 180", "8.0-reversing carousel"))
@pytest.mark.parametrize("motion", TURNS)
@pytest.mark.parametrize("bias_deg_per_h", [0.01, 1.0, 8.0])
def test_turning_base_is_accepted_without_a_word(motion, bias_deg_per_h):
    assert not found(turned_record(motion, gyro_bias_deg_per_h=bias_deg_per_h))


@pytest.mark.nightly(
    fast=(
        "rad_per_s-deg/s-57.29577951308232-four positions",
        "deg_per_s-rad/s-0.017453292519943295-one-way carousel",
        "deg_per_s-deg/h-3600.0-one turn by 180",
        "deg_per_h-deg/s-0.0002777777777777778-reversing carousel",
    )
)
@pytest.mark.parametrize("motion", TURNS)
@pytest.mark.parametrize(
    ("unit", "true_unit", "factor"),
    [
        ("rad_per_s", "deg/s", 1 / DEG),
        ("deg_per_s", "rad/s", DEG),
        ("deg_per_s", "deg/h", 3600.0),
        ("deg_per_h", "deg/s", 1 / 3600),
    ],
)
def test_wrong_gyro_unit_on_turning_base_is_refused_and_named(motion, unit, true_unit, factor):
    (one,) = found(simulated(motion), unit, (factor,) * 3)
    assert one.is_certain and not one.hides_north
    assert one.text.endswith(f" {true_unit}?")


@pytest.mark.nightly(
    fast=(
        "right-factor0-four positions",
        "front-factor1-one-way carousel",
        "up-factor2-one turn by 180",
    )
)
@pytest.mark.parametrize("motion", TURNS)
@pytest.mark.parametrize(
    ("axis", "factor"), [("right", (-1, 1, 1)), ("front", (1, -1, 1)), ("up", (1, 1, -1))]
)
def test_wrong_sign_of_one_gyro_on_turning_base_is_refused_and_named(motion, axis, factor):
    (one,) = found(simulated(motion), factor=factor)
    assert one.is_certain and f"the {axis} axis" in one.text


@pytest.mark.nightly(fast=("one turn by 180", "one turn by 90", "four positions"))
@pytest.mark.parametrize("motion", TURNS)
def test_wrong_sign_of_all_gyros_on_turning_base_is_reported(motion):
    """Two positions that are 180 deg apart are the same with either sign: a fit's misfit tells."""
    findings = found(simulated(motion), factor=(-1, -1, -1))
    if motion == "one turn by 180":
        assert not findings
        return
    (one,) = findings
    if motion == "one turn by 90":  # a bias of sqrt(2) times the horizontal Earth rate would do
        assert not one.is_certain and "a gyro bias of 13" in one.text
    else:
        assert one.is_certain and "the sign of the gyros" in one.text


def test_gyro_bias_beyond_its_limit_is_reported_on_turning_base():
    (one,) = found(turned_record("four positions", gyro_bias_deg_per_h=50.0))
    assert not one.is_certain and not one.hides_north
    assert "the base turns by 273 deg, and a gyro bias of 43" in one.text


def test_turns_that_accelerations_hide_are_reported_as_before():
    some = simulated("four positions")
    rng = np.random.default_rng(2)
    slow = np.repeat(0.3 * rng.normal(size=(30, 3)), len(some.accel) // 30, axis=0)
    (one,) = found(some._replace(accel=some.accel + slow * [1, 1, 0]))
    assert "turn about the vertical" in one.text


def test_jerks_of_a_turn_by_hand_are_accepted():
    """Of 1 m/s^2 while it turns, 145 to 164 s."""
    some = simulated("one turn by 180")
    jerks = np.zeros_like(some.accel)
    begin, end = (round(time_s * some.rate_hz) for time_s in (145, 164))
    jerks[begin:end] = (
        np.random.default_rng(3).normal(size=(38, 3)).repeat(13, axis=0)[: end - begin]
    )
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
        assert findings and not any("the base turns, but" in one.text for one in findings)


@pytest.mark.parametrize("rate", [1e300, np.nan, 2 * np.pi])
def test_absurd_rates_of_turning_gyros_raise_nothing(rate):
    """Values of a trusted record, and windows of whole turns without noise."""
    dtheta, dv = np.zeros((3000, 3)), np.tile([0.0, 0.0, G / 10], (3000, 1))
    dtheta[:, 2] = rate / 10
    with np.errstate(all="ignore"):
        turns = measure_turns(dtheta, dv, 0.1)
    assert turns is None or turns.drift < 1e-9

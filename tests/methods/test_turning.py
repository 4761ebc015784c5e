"""kalman10 with turning = "reopen": its filter, its keys, and warnings about turns."""

import numpy as np
import pytest
from oracles.in_engine import navigation, paper_filter, params, site
from oracles.naive import DEG, PAPER
from scipy.spatial.transform import Rotation
from support.studies import STILL, refusal_line, small_study

from sinsjax.engine import build
from sinsjax.execution.checks import study_warnings
from sinsjax.methods.base import Options
from sinsjax.methods.filters.turning import is_turning, reopen
from sinsjax.methods.registry import METHODS
from sinsjax.types import Quat, Sample, Vec3

RATE = 100
TURN = {"turn_times_s": [2.0], "turn_angles_deg": 30.0, "turn_rate_deg_per_s": 30.0}
REOPEN = {"turning": "reopen"}


def turned_study(**tables):
    return small_study(**{"motion": STILL | TURN, "alignment": {"method": "kalman10"}} | tables)


def test_reopening_keeps_heading_and_gyro_biases_alone():
    p = np.arange(100.0).reshape(10, 10)
    p0, kept = tuple(1000.0 + np.arange(10)), [4, 7, 8, 9]
    opened = reopen(tuple(p[np.triu_indices(10)]), p0, kept)
    expected = np.diag(p0)
    for i in kept:
        for j in kept:
            expected[i, j] = p[min(i, j), max(i, j)]
    np.testing.assert_array_equal(opened, expected[np.triu_indices(10)])


def test_sways_in_pitch_and_roll_are_no_turns():
    tilted = Rotation.from_euler("xy", [20.0, -10.0], degrees=True)
    nav = navigation(tilted.as_matrix(), (0.0, 0.0), 0.5)

    def turns(rate_in_n):
        rotvec = tilted.inv().apply(np.asarray(rate_in_n) * DEG / RATE)
        turn = Quat(*np.roll(Rotation.from_rotvec(rotvec).as_quat(), 1))
        return bool(is_turning(nav, Sample(turn, Vec3(0.0, 0.0, 0.0)), 1.0 * DEG, 1 / RATE))

    assert not turns([20.0, -20.0, 0.9])
    assert turns([0.0, 0.0, 2.0]) and turns([5.0, 0.0, -2.0])


@pytest.mark.nightly
def test_study_without_the_option_has_neither_option_nor_number():
    (part,), (same,), (other,) = (
        build.parts(turned_study(**tables))
        for tables in ({}, {"filter": {"turning": "update"}}, {"filter": REOPEN})
    )
    assert part.group.static.options.turning == "update"
    assert same.group.static == part.group.static != other.group.static
    assert part.group.variants.method.turning_rate is None
    np.testing.assert_array_equal(other.group.variants.method.turning_rate, [1.0 * DEG])


@pytest.mark.nightly
def test_kalman5_in_the_same_sweep_ignores_the_option():
    axes = {"method": ["kalman5", "kalman10"]}
    parts = build.parts(turned_study(alignment={}, filter=REOPEN, axes=axes))
    rates = {p.group.static.method: p.group.variants.method.turning_rate for p in parts}
    assert rates["kalman5"] is None and rates["kalman10"] is not None
    state = METHODS["kalman5"](Options(1 / RATE, turning="reopen")).init(
        params(paper_filter(5)), navigation(np.eye(3), (0.0, 0.0), 0.5)
    )
    assert state.turning is None


def test_velocity_restarts_from_zero_after_a_turn():
    filt, here = params(paper_filter(10, turning_rate=1.0 * DEG)), site(PAPER, 0.5)
    reopens = METHODS["kalman10"](Options(1 / RATE, turning="reopen"))
    state = reopens.init(filt, navigation(np.eye(3), (0.3, -0.2), 0.5))
    dv = Vec3(0.0, 0.0, PAPER.gravity / RATE)
    for n, rate in enumerate([0, 5, 5, 0, 0]):
        half = 0.5 * rate * DEG / RATE
        sample = Sample(Quat(np.cos(half), 0.0, 0.0, np.sin(half)), dv)
        velocity, state = state.nav.ve, reopens.step(filt, here, state, sample, float(n))
        assert (state.nav.ve == 0.0) == (n == 3)
        assert n == 3 or abs(state.nav.ve - velocity) < 1e-3


@pytest.mark.parametrize(
    ("method", "resets"),
    [("kalman5", {}), ("kalman10", {"reset_trigger": "nis", "trigger_threshold": 9.0})],
)
def test_option_is_refused_in_one_line(method, resets):
    motion, alignment = STILL | TURN, {"method": method}
    line = refusal_line(motion=motion, alignment=alignment, filter=REOPEN, resets=resets)
    assert line.startswith("[filter] turning: ")


RESET = "[resets]: the reset at 3 s "
SLOW = "[filter] turning_rate_deg_per_s: 30 deg/s "
MOSTLY = "[filter] turning: "
SWAY = "[filter] turning_rate_deg_per_s: 1 deg/s "


@pytest.mark.parametrize(
    ("tables", "line"),
    [
        ({"resets": {"reset_times_s": [1.0, 3.0]}}, RESET),
        ({"resets": {"reset_count": 2, "reset_cycle_s": 1.5}}, RESET),
        ({"resets": {"reset_times_s": [1.0, 2.0]}}, None),
        ({"resets": {"reset_times_s": [3.0], "reset_kind": "scale"}}, None),
        ({"resets": {"reset_times_s": [3.0]}, "motion": STILL}, None),
        ({"filter": REOPEN}, None),
        ({"filter": REOPEN | {"turning_rate_deg_per_s": 30.0}}, SLOW),
        ({"filter": REOPEN, "motion": TURN}, SWAY),
        ({"filter": REOPEN, "motion": STILL | TURN | {"turn_angles_deg": 1e6}}, MOSTLY),
        ({"motion": TURN}, None),
    ],
)
def test_settings_that_defeat_turns_are_warned_of_in_one_line(tables, line):
    warned = study_warnings(turned_study(**tables))
    assert len(warned) == (line is not None)
    assert all(text.startswith(line) for text in warned)

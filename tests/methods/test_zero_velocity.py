import numpy as np
import pytest
from oracles.in_engine import (
    PAPER1,
    covariances,
    measured,
    navigation,
    paper_filter,
    params,
    runner,
    site,
)
from oracles.naive import DEG, PAPER, WGS84, Unwatched, closed_loop, exp, of_quaternion
from scipy.spatial.transform import Rotation

pytestmark = pytest.mark.optimised(False)

RATE, SAMPLES = 100, 2000
PHI0, V0 = np.array([5.0, 5.0, 30.0]) * DEG, np.array([0.3, -0.2])


class Summing(Unwatched):
    """Normalised innovations squared, sample by sample."""

    def __init__(self):
        self.squares = []

    def look(self, seen, x, p):
        self.squares.append(seen.r @ np.linalg.solve(seen.s, seen.r))
        return False


def compare(name, planet, latitude_deg, filt):
    """Both runs, sample by sample, to 1e-9."""
    latitude = latitude_deg * DEG
    rows, start = measured(planet, latitude, SAMPLES), exp(-PHI0) @ PAPER1.matrix(0.0)
    watcher = Summing()
    about = {"latitude": latitude, "c": start, "v": V0, "filt": filt, "watcher": watcher}
    naive = closed_loop(rows, 1 / RATE, planet, **about)
    run = runner(name, filt.force, filt.position)
    here, nav = site(planet, latitude), navigation(start, V0, latitude)
    state, attitude, covariance = run(params(filt), here, nav, rows)

    close = {"rtol": 0, "atol": 1e-9}
    c = of_quaternion(np.stack(state.nav.q, axis=1))
    np.testing.assert_allclose(c, naive.c, **close)
    np.testing.assert_allclose(np.stack([state.nav.ve, state.nav.vn], axis=1), naive.v, **close)
    np.testing.assert_allclose(state.nav.latitude, naive.latitude, rtol=0, atol=1e-15)
    np.testing.assert_allclose(state.nav.longitude, naive.longitude, rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.stack(state.belief.x, axis=1), naive.x, **close)
    # Biases are small: to 1e-9 of what they are believed to be at the start.
    bias = np.stack(state.bias, axis=1) if state.bias else np.zeros((SAMPLES, 0))
    unit = np.sqrt(filt.p0[5:])
    np.testing.assert_allclose(bias / unit, naive.bias / unit, **close)
    sigma = np.sqrt(np.diagonal(naive.p, axis1=1, axis2=2))
    p, unit = covariances(state.belief.p), sigma[:, :, None] * sigma[:, None, :]
    np.testing.assert_allclose(p / unit, naive.p / unit, **close)
    # What a user is given: the attitude with all that is estimated taken out, and its covariance.
    corrected = Rotation.from_rotvec(naive.x[:, 2:5]).as_matrix() @ naive.c
    np.testing.assert_allclose(of_quaternion(np.stack(attitude, axis=1)), corrected, **close)
    upper = np.array([p[:, i, j] for i in (2, 3, 4) for j in range(i, 5)])
    np.testing.assert_array_equal(np.array(covariance), upper)
    summed, count = state.innovations
    np.testing.assert_allclose(summed, np.cumsum(watcher.squares), rtol=1e-8)
    np.testing.assert_array_equal(count, 1 + np.arange(SAMPLES))
    return naive


SCHEDULES = {
    "feedback every sample": {},
    "feedback every 7 samples, full resets": {"every": 7, "resets": (1, 500, 1333)},
    "partial feedback, yaw resets": {"every": 10, "gain": 0.3, "resets": (250, 777), "kind": "yaw"},
    "a reset where feedback is due, P times 10": {
        "every": 100,
        "gain": 0.05,
        "resets": (500, 1999),
        "kind": "scale",
    },
    "P shrunk": {"every": 33, "resets": (200,), "kind": "scale", "factor": 0.01},
    "resets alone feed back, in any order": {"every": 10**9, "resets": (1600, 3, 800)},
    "other numbers": {
        "q": np.array([1e-3, 2e-3, 3e-5, 4e-5, 5e-5]),
        "r": 1e-6,
        "every": 50,
        "resets": (60,),
    },
    "resets restart feedback": {
        "every": 70,
        "gain": 0.5,
        "resets": (99, 140, 1333),
        "restarts": True,
    },
    "yaw resets wait for feedback, two for the same": {
        "every": 300,
        "resets": (301, 599, 1200),
        "kind": "yaw",
        "at_feedback": True,
    },
    "resets wait, and restart nothing": {
        "every": 64,
        "resets": (65, 500),
        "at_feedback": True,
        "restarts": True,
    },
}


@pytest.mark.nightly(fast=("partial feedback, yaw resets",))
@pytest.mark.parametrize("schedule", SCHEDULES)
def test_kalman5_closed_loop_matches_naive_filter(schedule):
    compare("kalman5", PAPER, 32.0, paper_filter(5, **SCHEDULES[schedule]))


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("name", "force", "position", "schedule"),
    [
        ("kalman5", "gravity", "integrated", "feedback every 7 samples, full resets"),
        ("kalman10", "measured", "integrated", "feedback every 7 samples, full resets"),
        ("kalman10", "measured", "integrated", "partial feedback, yaw resets"),
        ("kalman10", "measured", "integrated", "a reset where feedback is due, P times 10"),
    ],
)
def test_filters_with_integrated_position_match_naive_filter(name, force, position, schedule):
    n = {"kalman5": 5, "kalman10": 10}[name]
    filt = paper_filter(n, force=force, position=position, **SCHEDULES[schedule])
    naive = compare(name, WGS84, -41.0, filt)
    moved = abs(naive.latitude[-1] - naive.latitude[0]) > 1e-9
    assert moved == (position == "integrated")

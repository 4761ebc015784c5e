"""Filters with another error model than [P1]'s, in closed loop, against naive ones.

A new filter has its naive model in `oracles.naive_filters` and a case here.
"""

from typing import NamedTuple

import numpy as np
import pytest
from oracles.in_engine import (
    DEG_PER_H,
    PAPER1,
    UG,
    covariances,
    filter_params,
    follow,
    measured,
    shown,
    site,
)
from oracles.naive import DEG, PAPER, Filter, exp, of_quaternion
from oracles.naive_filters import (
    EXTENDED,
    INVARIANT,
    SINCOS,
    UNSCENTED,
    Model,
    closed_loop,
    surging,
)

from sinsjax.methods.method import Options
from sinsjax.methods.surge import SurgeParams

pytestmark = pytest.mark.optimised(False)

RATE, LATITUDE, V0 = 100, 32 * DEG, np.array([0.3, -0.2])
SURGE_S = 2.0


class Case(NamedTuple):
    """A naive filter, its numbers, a start, and the accuracy of the comparison.

    Attributes:
        model: the naive error model.
        p0: initial variances.
        q: variances that a sample adds.
        r: variance of a measured velocity.
        phi_deg: misalignment of the start.
        samples: length of the run.
        off: largest difference of attitude (rad), velocity (m/s) and x.
        p: relative and absolute tolerance of P.
        extra: params beside those of the shared filter.
    """

    model: Model
    p0: np.ndarray
    q: np.ndarray
    r: float
    phi_deg: tuple[float, float, float]
    samples: int
    off: tuple[float, float, float]
    p: tuple[float, float]
    extra: object = None


def variances(*sigmas):
    return np.array(sigmas) ** 2


FIVE = variances(0.1, 0.1, 15 * DEG, 15 * DEG, 80 * DEG)
SIX = variances(0.1, 0.1, 15 * DEG, 15 * DEG, 0.5**0.5, 0.5**0.5)
Q6 = variances(*[500 * UG / RATE] * 2, *[0.1 * DEG_PER_H / RATE] * 4)
AZIMUTH = {"phi_deg": (5.0, -6.0, 30.0), "samples": 1000, "off": (1e-8, 1e-7, 1e-7)}
AZIMUTH |= {"p0": FIVE, "q": Q6[:5], "r": 0.1**2, "p": (1e-6, 1e-9)}
# Strong enough for a heading to be found within seconds where none is known.
LARGE = {"phi_deg": (10.0, -15.0, 120.0), "samples": 1500, "r": 1e-3**2}
CASES = {
    "kalman_sincos": Case(SINCOS, SIX, Q6, **LARGE, off=(1e-9,) * 3, p=(1e-8, 1e-12)),
    "kalman_surge": Case(
        surging(SURGE_S),
        np.r_[SIX, variances(*[0.1 * SURGE_S] * 2, 0.1, 0.1)],
        np.r_[Q6, 0.0, 0.0, [2 * 0.1**2 / SURGE_S / RATE] * 2],
        **LARGE,
        off=(1e-8, 1e-7, 1e-8),
        p=(1e-7, 1e-11),
        extra=SurgeParams(np.float64(1 / SURGE_S)),
    ),
    "ekf_azimuth": Case(EXTENDED, **AZIMUTH, extra=np.float64(0.5)),
    "unscented": Case(UNSCENTED, **AZIMUTH, extra=np.float64(0.5)),
    "invariant": Case(INVARIANT, **AZIMUTH),
}
SCHEDULES = {
    "feedback every sample": {},
    "feedback every second, resets": {"every": 100, "resets": (333, 700)},
    "partial feedback, heading reset": {"every": 10, "gain": 0.3, "resets": (250,), "kind": "yaw"},
    "P times 10": {"every": 50, "resets": (500,), "kind": "scale"},
    "resets restart feedback": {"every": 100, "resets": (333, 700), "restarts": True},
    "resets wait for feedback": {"every": 60, "resets": (301, 720), "at_feedback": True},
}


PASSES = {"every": 130, "resets": (250, 750)}
SCHEDULES |= {
    "three passes": PASSES | {"turn": "carried"},
    "three rewound passes": PASSES | {"turn": "rewind"},
}
FAST = (
    "kalman_sincos-feedback every sample",
    "invariant-resets restart feedback",
    "kalman_surge-three passes",
)


@pytest.mark.nightly(fast=FAST)
@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize("name", CASES)
def test_closed_loop_matches_naive_filter(name, schedule):
    """Over one pass, or over three from a smaller misalignment, with feedback over the turns."""
    case, changes, dt = CASES[name], SCHEDULES[schedule], 1 / RATE
    count, stored, r, phi = case.samples, case.samples, case.r, np.array(case.phi_deg) * DEG
    if "turn" in changes:
        count, stored, r, phi = 900, 300, 0.1**2, np.array([1.0, -2.0, 15.0]) * DEG
    filt, rows = Filter(case.p0, case.q, r, **changes), measured(PAPER, LATITUDE, stored)
    about = {"latitude": LATITUDE, "c": exp(-phi) @ PAPER1.matrix(0.0), "v": V0, "filt": filt}
    naive = closed_loop(case.model, rows, dt, PAPER, stored=stored, count=count, **about)

    params, options = filter_params(filt), Options(dt)
    params = params if case.extra is None else params._replace(extra=case.extra)
    here, start = site(PAPER, LATITUDE), (PAPER1.matrix(0.0), phi, V0)
    passes = {"records": count, "stored": stored, "rewinds": filt.turn == "rewind"}
    state = follow(name, params, rows, here, start, options=options, **passes)
    attitude, covariance = shown(name, options, state)
    c, corrected = (of_quaternion(np.stack(q, axis=1)) for q in (state.nav.q, attitude))
    found = c, np.stack([state.nav.ve, state.nav.vn], axis=1), np.stack(state.belief.x, axis=1)
    expected = naive.c, naive.v[:, :2], naive.x
    for got, want, off in zip(found, expected, case.off, strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=off)
    if name == "invariant":
        np.testing.assert_allclose(state.extra, naive.v[:, 2], rtol=0, atol=1e-7)
    rtol, atol = case.p
    np.testing.assert_allclose(covariances(state.belief.p), naive.p, rtol=rtol, atol=atol)
    np.testing.assert_allclose(corrected, naive.corrected, rtol=0, atol=1e-8)
    if name == "kalman_sincos" and stored == count:
        assert_first_order(naive, np.array(covariance))


def assert_first_order(naive, covariance):
    """The covariance of the attitude is P taken through the attitude's own derivative."""
    for k in (680, len(naive.x) - 1):
        assert covariance[-1, k] < 0.1  # the heading is known
        x, c = naive.x[k], naive.c[k]
        slope = np.zeros((3, 6))
        for j in range(2, 6):
            step = np.zeros(6)
            step[j] = 1e-6
            there, back = (SINCOS.corrected(x + d, c) for d in (step, -step))
            turn = there @ back.T
            slope[:, j] = [turn[2, 1], turn[0, 2], turn[1, 0]]
        p = slope / 2e-6 @ naive.p[k] @ slope.T / 2e-6
        upper = p[np.triu_indices(3)]
        # What is left of the tilt turns its slope; feedback leaves little.
        np.testing.assert_allclose(covariance[:, k], upper, rtol=0.02, atol=0.02 * upper.max())

"""Filters in closed loop against naive ones: schedules, passes over a record, triggers.

A new filter has its naive model in `oracles.naive_filters` and a case here.
"""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.in_engine import (
    DEG_PER_H,
    PAPER1,
    UG,
    covariances,
    filter_params,
    follow,
    measured,
    paper_filter,
    shown,
    site,
)
from oracles.naive import DEG, FIVE, PAPER, TEN, WGS84, Filter, Model, closed_loop, exp
from oracles.naive import of_quaternion as matrices
from oracles.naive_filters import EXTENDED, INVARIANT, SINCOS, UNSCENTED, surging
from oracles.naive_triggers import Numbers, Watcher

from sinsjax.methods.filters.triggers import TRIGGERS, TriggerParams
from sinsjax.methods.method import Options
from sinsjax.methods.registry import METHODS

pytestmark = pytest.mark.optimised(False)

DT, V0, SURGE_S = 0.01, np.array([0.3, -0.2]), 2.0


class Case(NamedTuple):
    """A naive filter, its numbers, a start, and the accuracy of the comparison.

    Attributes:
        model: the naive error model.
        numbers: with the variances of the filter.
        phi_deg: misalignment of the start.
        off: largest difference of attitude (rad) and velocity (m/s).
        close: of estimates and covariances, in sigma.
        extra: params beside those of the shared filter.
    """

    model: Model
    numbers: Filter
    phi_deg: tuple[float, float, float]
    off: float
    close: float
    extra: object = None


SIX = np.array([0.1, 0.1, 15 * DEG, 15 * DEG, 0.5**0.5, 0.5**0.5]) ** 2
Q6 = np.array([*[500 * UG * DT] * 2, *[0.1 * DEG_PER_H * DT] * 4]) ** 2
AZIMUTH = Filter(paper_filter(5).p0, Q6[:5], 0.1**2), (5.0, -6.0, 30.0), 1e-7, 1e-6
# Strong enough for a heading to be found within seconds where none is known.
STRONG, LARGE = 1e-3**2, (10.0, -15.0, 120.0)
SURGING = Filter(
    np.r_[SIX, np.array([0.1 * SURGE_S] * 2 + [0.1] * 2) ** 2],
    np.r_[Q6, 0.0, 0.0, [2 * 0.1**2 / SURGE_S * DT] * 2],
    STRONG,
)
CASES = {
    "kalman5": Case(FIVE, paper_filter(5), (5.0, 5.0, 30.0), 1e-9, 1e-9),
    "kalman10": Case(TEN, paper_filter(10, position="integrated"), (5.0, 5.0, 30.0), 1e-9, 1e-9),
    "kalman_sincos": Case(SINCOS, Filter(SIX, Q6, STRONG), LARGE, 1e-8, 1e-6),
    "kalman_surge": Case(surging(SURGE_S), SURGING, LARGE, 1e-7, 1e-5, np.float64(1 / SURGE_S)),
    "ekf_azimuth": Case(EXTENDED, *AZIMUTH),
    "unscented": Case(UNSCENTED, *AZIMUTH),
    "invariant": Case(INVARIANT, *AZIMUTH),
}
QUIET = Numbers(np.inf)


class Run:
    """A filter over a record of [P1]'s swing: a naive run of it, and one by the engine."""

    def __init__(self, name, *, count, stored=None, phi_deg=None, trigger="none", **changes):
        self.name, self.case, self.trigger = name, CASES[name], trigger
        self.filt = self.case.numbers._replace(**changes)
        self.phi = np.array(phi_deg or self.case.phi_deg) * DEG
        self.count, self.stored = count, stored or count
        moves = self.filt.position == "integrated"
        self.planet, self.latitude = (WGS84, -41.0 * DEG) if moves else (PAPER, 32.0 * DEG)
        self.rows = measured(self.planet, self.latitude, count)

    def naive(self, numbers=QUIET):
        """History, and the watcher; None without a trigger."""
        filt, watcher = self.filt, None
        if self.trigger != "none":
            noise = {"q": filt.q, "r": filt.r, "p0": filt.p0, "dt": DT}
            watcher = Watcher(self.trigger, numbers, **noise)
        start = exp(-self.phi) @ PAPER1.matrix(0.0), V0, self.latitude
        passes = {"stored": self.stored, "count": self.count, "watcher": watcher}
        model = self.case.model
        return closed_loop(model, self.rows, DT, self.planet, filt, start, **passes), watcher

    def engine(self, numbers=QUIET):
        """After every sample: state, attitude with estimates taken out, covariance, results."""
        filt, params = self.filt, filter_params(self.filt)
        params = params._replace(extra=self.case.extra)
        if self.trigger != "none":
            params = params._replace(trigger=TriggerParams(*map(np.float64, numbers)))
        options = Options(DT, filt.force, filt.position, self.trigger, innovations=True)
        here, start = site(self.planet, self.latitude), (PAPER1.matrix(0.0), self.phi, V0)
        passes = {"records": self.count, "stored": self.stored}
        state = follow(self.name, params, self.rows, here, start, options=options, **passes)
        results = METHODS[self.name].build(options).results(here, state)
        return state, *shown(self.name, options, state), results

    def compare(self, numbers=QUIET):
        """Fail unless both are the same at every sample; return history and covariance."""
        (naive, watcher), (state, attitude, covariance, results) = (
            run(numbers) for run in (self.naive, self.engine)
        )
        sigma = np.sqrt(np.diagonal(naive.p, axis1=1, axis2=2))
        unit = sigma[:, :, None] * sigma[:, None, :]
        # Biases are small: to what they are believed to be at the start.
        bias = np.stack(state.bias, axis=1) if state.bias else np.zeros((self.count, 0))
        bias_unit = np.sqrt(self.filt.p0[len(self.filt.p0) - bias.shape[1] :])
        off, close = self.case.off, self.case.close
        for found, expected, tolerance in (
            (matrices(np.stack(state.nav.q, axis=1)), naive.c, off),
            (np.stack([state.nav.ve, state.nav.vn], axis=1), naive.v[:, :2], off),
            (matrices(np.stack(attitude, axis=1)), naive.corrected, off),
            (np.stack([state.nav.latitude, state.nav.longitude]), naive[2:4], 1e-15),
            (np.stack(state.belief.x, axis=1) / sigma, naive.x / sigma, close),
            (bias / bias_unit, naive.bias / bias_unit, close),
            (covariances(state.belief.p) / unit, naive.p / unit, close),
        ):
            np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)
        if self.name == "invariant":
            np.testing.assert_allclose(state.extra, naive.v[:, 2], rtol=0, atol=off)
        summed, count = results.innovations
        np.testing.assert_allclose(summed, np.cumsum(naive.nis), rtol=10 * close)
        np.testing.assert_array_equal(count, 1 + np.arange(self.count))
        if self.trigger != "none":
            called = watcher.trigger_counts
            assert fired(results) == called
            ends = [results.trigger_counts.first[-1], results.trigger_counts.last[-1]]
            assert ends == ([called[0], called[-1]] if called else [0, 0])
        if self.trigger == "linearisation":
            sigma = np.sqrt(np.diag(watcher.honest))
            honest, unit = covariances(state.trigger_state.memory)[-1], np.outer(sigma, sigma)
            np.testing.assert_allclose(honest / unit, watcher.honest / unit, rtol=0, atol=close)
        return naive, np.array(covariance)


def fired(results):
    """Samples at which a trigger called for a reset."""
    return [*(1 + np.flatnonzero(np.diff(np.asarray(results.trigger_counts.count), prepend=0.0)))]


PASSES = {"count": 900, "stored": 300, "phi_deg": (1.0, -2.0, 15.0), "r": 0.1**2}
PASSES |= {"every": 130, "gain": 0.7, "resets": (250, 750), "turn_factor": 3.0}
WAITS = {"every": 300, "resets": (301, 599, 1200), "at_feedback": True, "kind": "yaw"}
SCHEDULES = {
    "feedback every sample": {},
    "partial feedback, yaw resets": {"every": 10, "gain": 0.3, "resets": (250, 777), "kind": "yaw"},
    "a reset where feedback is due, P times 10": {"every": 100, "gain": 0.05, "kind": "scale"}
    | {"resets": (500, 1499)},
    "resets alone feed back, in any order": {"every": 10**9, "resets": (1400, 3, 800)},
    "resets restart feedback": {"every": 70, "gain": 0.5, "resets": (99, 140, 1333)}
    | {"restarts": True},
    "yaw resets wait for feedback, two for the same": WAITS,
    "resets wait, and restart nothing": WAITS | {"every": 64, "restarts": True, "kind": "full"},
    "A(t) of a base at rest": {"every": 7, "resets": (1, 500), "force": "gravity"},
    "three passes": PASSES | {"turn": "carried"},
    "three passes, P inflated": PASSES | {"turn": "inflated"},
    "three passes, P reset": PASSES | {"turn": "reset"},
}
FAST = (
    *("kalman5-partial feedback, yaw resets", "kalman10-three passes, P reset"),
    *("kalman_sincos-feedback every sample", "kalman_surge-three passes"),
    "invariant-resets restart feedback",
)


@pytest.mark.nightly(fast=FAST)
@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize("name", CASES)
def test_closed_loop_matches_naive_filter(name, schedule):
    """Over one pass, or over three from a smaller misalignment, with feedback over the turns."""
    run = Run(name, **{"count": 1500} | SCHEDULES[schedule])
    naive, covariance = run.compare()
    assert (np.ptp(naive.latitude) > 1e-9) == (name == "kalman10")
    if name in ("kalman5", "kalman10"):
        upper = np.array([naive.p[:, i, j] for i in (2, 3, 4) for j in range(i, 5)])
        np.testing.assert_allclose(covariance, upper, rtol=1e-6, atol=1e-9 * upper.max())
    if name == "kalman_sincos" and run.stored == run.count:
        assert_first_order(naive, covariance)


def assert_first_order(naive, covariance):
    """The covariance of the attitude is P taken through the attitude's own derivative."""
    known = np.flatnonzero(covariance[-1] < 0.1)
    for k in known[[len(known) // 2, -1]]:
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


# Triggers


def threshold_at(scores, share):
    """A threshold that some share of the scores that are not zero exceed, and none meets."""
    ordered = np.unique([score for score in scores if score > 0])
    at = int(share * (len(ordered) - 1))
    return float(np.sqrt(ordered[at] * ordered[at + 1])) if at + 1 < len(ordered) else np.inf


@pytest.mark.nightly(fast=("kalman5-innovation", "kalman5-linearisation"))
@pytest.mark.parametrize("trigger", TRIGGERS)
@pytest.mark.parametrize("name", ["kalman5", "kalman10"])
@given(
    share=st.floats(0, 0.99),
    window=st.integers(1, 12),
    refractory=st.sampled_from([0, 1, 5, 13]),
    most=st.integers(1, 6) | st.just(100),
    until=st.sampled_from([np.inf, 7, 30]),
    scheduled=st.sets(st.integers(1, 60), max_size=4),
    every=st.sampled_from([1, 4, 7]),
    stored=st.sampled_from([60, 23]),
    kind=st.sampled_from(["full", "yaw"]),
)
@settings(max_examples=25, deadline=None)
def test_triggered_resets_match_naive_filter(
    name, trigger, share, window, refractory, most, until, scheduled, every, stored, kind
):
    """At a large misalignment, with scheduled resets between, and over turns of the record."""
    changes = {"every": every, "gain": 0.6, "resets": (*scheduled,), "r": 1e-5, "kind": kind}
    changes |= {"at_feedback": every == 4, "restarts": every == 7, "position": "fixed"}
    large = {"phi_deg": (10.0, -8.0, 60.0), "trigger": trigger}
    run = Run(name, count=60, stored=stored, **large, **changes)
    numbers = Numbers(np.inf, window, refractory, most, until)
    threshold = threshold_at(run.naive(numbers)[1].scores, share)
    run.compare(numbers._replace(threshold=threshold))


def fired_at(*resets, **numbers):
    """Of 60 samples, with a threshold that every score exceeds."""
    run = Run("kalman5", count=60, trigger="innovation", resets=resets)
    return fired(run.engine(Numbers(0.0, **numbers))[-1])


def test_refractory_time_cap_and_end_limit_trigger_firing():
    """With a threshold of zero a trigger fires whenever it may."""
    assert fired_at() == [*range(1, 61)]
    assert fired_at(refractory=20) == [20, 40, 60]
    assert fired_at(refractory=1, most=3) == [1, 2, 3]
    assert fired_at(refractory=20, until=40.0) == [20, 40]
    assert fired_at(refractory=20, until=39.0) == [20]
    # From the start and from any reset, a scheduled one too.
    assert fired_at(25, refractory=20) == [20, 45]
    assert fired_at(window=7) == [7, 14, 21, 28, 35, 42, 49, 56]
    assert fired_at(10, 40, window=20) == [30, 60]
    # A window that was full within the refractory time is not waited for.
    assert fired_at(window=8, refractory=20) == [24, 48]

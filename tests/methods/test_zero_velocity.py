"""[P1]'s filters in closed loop against naive ones: schedules, passes over a record, triggers.

`test_naive_filters.py` does the same for filters with other error models.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.in_engine import (
    PAPER1,
    covariances,
    follow,
    measured,
    paper_filter,
    params,
    shown,
    site,
)
from oracles.naive import DEG, PAPER, WGS84, closed_loop, exp, of_quaternion
from oracles.naive_triggers import Numbers, Watcher, normalised

from sinsjax.methods.filters.triggers import TRIGGERS, TriggerParams
from sinsjax.methods.method import Options
from sinsjax.methods.registry import METHODS

pytestmark = pytest.mark.optimised(False)

DT, STATES = 0.01, {"kalman5": 5, "kalman10": 10}
START, LARGE = np.array([5.0, 5.0, 30.0]) * DEG, np.array([10.0, -8.0, 60.0]) * DEG
V0 = np.array([0.3, -0.2])
QUIET = Numbers(np.inf)


class Summing(Watcher):
    """A trigger that sums the normalised innovations squared, too."""

    def look(self, seen, x, p):
        self.squares = [*getattr(self, "squares", []), normalised(seen.r, seen.s)]
        return super().look(seen, x, p)


class Case:
    """A filter, its record and start: a naive run of it, and one by the engine."""

    def __init__(self, name, filt, *, count, stored=None, phi=START, trigger="none"):
        self.name, self.filt, self.phi, self.trigger = name, filt, phi, trigger
        self.count, self.stored = count, stored or count
        moves = filt.position == "integrated"
        self.planet, self.latitude = (WGS84, -41.0 * DEG) if moves else (PAPER, 32.0 * DEG)
        self.rows = measured(self.planet, self.latitude, count)

    def naive(self, numbers=QUIET):
        """History, and the watcher."""
        filt, trigger = self.filt, "innovation" if self.trigger == "none" else self.trigger
        noise = {"q": filt.q, "r": filt.r, "p0": filt.p0, "dt": DT}
        watcher = Summing(trigger, numbers, **noise, every=filt.every if filt.at_feedback else 1)
        about = {"c": exp(-self.phi) @ PAPER1.matrix(0.0), "v": V0, "latitude": self.latitude}
        about |= {"filt": filt, "stored": self.stored, "count": self.count, "watcher": watcher}
        return closed_loop(self.rows, DT, self.planet, **about), watcher

    def engine(self, numbers=QUIET):
        """After every sample: state, attitude with estimates taken out, covariance, results."""
        filt, numbers_ = self.filt, params(self.filt)
        if self.trigger != "none":
            at_feedback = np.float64(1) if filt.at_feedback else None
            trigger = TriggerParams(*map(np.float64, numbers), at_feedback)
            numbers_ = numbers_._replace(trigger=trigger)
        options = Options(DT, filt.force, filt.position, self.trigger, innovations=True)
        here, start = site(self.planet, self.latitude), (PAPER1.matrix(0.0), self.phi, V0)
        passes = {"records": self.count, "stored": self.stored, "rewinds": filt.turn == "rewind"}
        state = follow(self.name, numbers_, self.rows, here, start, options=options, **passes)
        results = METHODS[self.name].build(options).results(here, state)
        return state, *shown(self.name, options, state), results

    def compare(self, numbers=QUIET):
        """Fail unless both are the same at every sample; returns history and watcher."""
        naive, watcher = self.naive(numbers)
        state, attitude, covariance, results = self.engine(numbers)
        close = {"rtol": 0, "atol": 1e-9}
        c = of_quaternion(np.stack(state.nav.q, axis=1))
        np.testing.assert_allclose(c, naive.c, rtol=0, atol=1e-10)
        v = np.stack([state.nav.ve, state.nav.vn], axis=1)
        np.testing.assert_allclose(v, naive.v, rtol=0, atol=1e-10)
        np.testing.assert_allclose(state.nav.latitude, naive.latitude, rtol=0, atol=1e-15)
        np.testing.assert_allclose(state.nav.longitude, naive.longitude, rtol=0, atol=1e-15)
        sigma = np.sqrt(np.diagonal(naive.p, axis1=1, axis2=2))
        x = np.stack(state.belief.x, axis=1)
        np.testing.assert_allclose(x / sigma, naive.x / sigma, **close)
        # Biases are small: to 1e-9 of what they are believed to be at the start.
        bias = np.stack(state.bias, axis=1) if state.bias else np.zeros((self.count, 0))
        unit = np.sqrt(self.filt.p0[5:])
        np.testing.assert_allclose(bias / unit, naive.bias / unit, **close)
        p, unit = covariances(state.belief.p), sigma[:, :, None] * sigma[:, None, :]
        np.testing.assert_allclose(p / unit, naive.p / unit, **close)
        # What a user is given: the attitude with all that is estimated taken out.
        corrected = np.array([exp(x[2:5]) @ c for x, c in zip(naive.x, naive.c, strict=True)])
        found = of_quaternion(np.stack(attitude, axis=1))
        np.testing.assert_allclose(found, corrected, **close)
        upper = np.array([p[:, i, j] for i in (2, 3, 4) for j in range(i, 5)])
        np.testing.assert_array_equal(np.array(covariance), upper)
        summed, count = results.innovations
        np.testing.assert_allclose(summed, np.cumsum(watcher.squares), rtol=1e-8)
        np.testing.assert_array_equal(count, 1 + np.arange(self.count))
        if self.trigger != "none":
            called = watcher.trigger_counts
            assert fired(results) == called
            ends = [results.trigger_counts.first[-1], results.trigger_counts.last[-1]]
            assert ends == ([called[0], called[-1]] if called else [0, 0])
        if self.trigger == "linearisation":
            sigma = np.sqrt(np.diag(watcher.honest))
            honest, unit = covariances(state.trigger_state.memory)[-1], np.outer(sigma, sigma)
            np.testing.assert_allclose(honest / unit, watcher.honest / unit, **close)
        return naive, watcher


def fired(results):
    """Samples at which a trigger called for a reset."""
    return [*(1 + np.flatnonzero(np.diff(np.asarray(results.trigger_counts.count), prepend=0.0)))]


YAW = {"kind": "yaw"}
SCHEDULES = {
    "feedback every sample": {},
    "feedback every 7 samples, full resets": {"every": 7, "resets": (1, 500, 1333)},
    "partial feedback, yaw resets": {"every": 10, "gain": 0.3, "resets": (250, 777)} | YAW,
    "a reset where feedback is due, P times 10": {"every": 100, "gain": 0.05}
    | {"resets": (500, 1999), "kind": "scale"},
    "P shrunk": {"every": 33, "resets": (200,), "kind": "scale", "factor": 0.01},
    "resets alone feed back, in any order": {"every": 10**9, "resets": (1600, 3, 800)},
    "other noise": {"r": 1e-6, "every": 50, "resets": (60,)},
    "resets restart feedback": {"every": 70, "gain": 0.5, "resets": (99, 140, 1333)}
    | {"restarts": True},
    "yaw resets wait for feedback, two for the same": {"every": 300, "resets": (301, 599, 1200)}
    | {"at_feedback": True}
    | YAW,
    "resets wait, and restart nothing": {"every": 64, "resets": (65, 500)}
    | {"at_feedback": True, "restarts": True},
}


PASSES = {"every": 130, "gain": 0.7, "resets": (250, 1500), "turn_factor": 3.0}
SCHEDULES |= {
    "A(t) of a base at rest": {"every": 7, "resets": (1, 500), "force": "gravity"},
    **{
        f"three passes, P {turn}": PASSES | {"turn": turn}
        for turn in ("carried", "inflated", "reset")
    },
    "three passes, resets restart feedback": PASSES | {"turn": "carried", "restarts": True},
    "three passes, rewound": PASSES | {"turn": "rewind"},
    "three passes, rewound, resets wait": PASSES | {"turn": "rewind", "at_feedback": True},
}
FAST = "kalman5-partial feedback, yaw resets", "kalman10-three passes, rewound"


@pytest.mark.nightly(fast=FAST)
@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize("name", STATES)
def test_closed_loop_matches_naive_filter(name, schedule):
    """Over one pass, or over three from a smaller misalignment, with biases fed back.

    The latter with feedback over the turn, and P carried, inflated or reset; or all forward,
    rewound from what biases and feedback leave at their ends.
    """
    position = {"kalman5": "fixed", "kalman10": "integrated"}[name]
    filt = paper_filter(STATES[name], position=position, **SCHEDULES[schedule])
    passes = {"count": 2000}
    if "turn" in SCHEDULES[schedule]:
        passes = {"count": 1800, "stored": 600, "phi": np.array([1.0, -2.0, 5.0]) * DEG}
    naive, _ = Case(name, filt, **passes).compare()
    assert (np.ptp(naive.latitude) > 1e-9) == (position == "integrated")


# Triggers


def threshold_at(scores, share):
    """A threshold that some share of the scores that are not zero exceed, and none meets."""
    ordered = np.unique([score for score in scores if score > 0])
    at = int(share * (len(ordered) - 1))
    return float(np.sqrt(ordered[at] * ordered[at + 1])) if at + 1 < len(ordered) else np.inf


@pytest.mark.nightly(fast=("kalman5-innovation", "kalman5-linearisation"))
@pytest.mark.parametrize("trigger", TRIGGERS)
@pytest.mark.parametrize("name", STATES)
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
    """At a large misalignment, with scheduled resets between, and over turns of the record.

    With feedback every few samples all resets wait for that, scheduled ones as well.
    """
    filt = paper_filter(STATES[name], every=every, gain=0.6, resets=(*scheduled,), r=1e-5)
    filt = filt._replace(at_feedback=every > 1, restarts=every == 7, kind=kind)
    case = Case(name, filt, count=60, stored=stored, phi=LARGE, trigger=trigger)
    numbers = Numbers(np.inf, window, refractory, most, until)
    threshold = threshold_at(case.naive(numbers)[1].scores, share)
    case.compare(numbers._replace(threshold=threshold))


def fired_at(*resets, **numbers):
    """Of 60 samples, with a threshold that every score exceeds."""
    case = Case("kalman5", paper_filter(5, resets=resets), count=60, trigger="innovation")
    return fired(case.engine(Numbers(0.0, **numbers))[-1])


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

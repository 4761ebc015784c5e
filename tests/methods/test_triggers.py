"""Triggers against naive ones: alone on random sequences, and in the filter on a swinging base."""

from functools import cache
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.in_engine import (
    PAPER1,
    covariances,
    measured,
    navigation,
    paper_filter,
    params,
    site,
    step_and_close,
)
from oracles.naive import DEG, PAPER, WGS84, closed_loop, exp, of_quaternion, quaternion, updates
from oracles.naive_triggers import SCORES, Numbers, Watcher
from oracles.naive_triggers import Seen as NaiveSeen
from sinsjax.methods.triggers import trigger as triggers
from support.studies import small_study

from sinsjax.execution import run as study_run
from sinsjax.maths.algebra import select_tree, triangle_index
from sinsjax.methods import passes
from sinsjax.methods.filters.kalman import Belief
from sinsjax.methods.filters.loop import FilterState
from sinsjax.methods.filters.triggers import TRIGGERS, AssumedNoise, FilterSnapshot, TriggerName
from sinsjax.methods.method import AttitudeCovariance, Options
from sinsjax.methods.registry import METHODS
from sinsjax.types import Quat, Sample, Vec3

pytestmark = pytest.mark.optimised(False)

DT = 0.01
LATITUDE = 32 * DEG
NOISE = np.array([2e-4, 3e-4, 1e-4, 2e-4, 3e-4]), 0.04
"""Process noise and measurement noise of the random sequences."""


def test_every_trigger_has_study_name_and_naive_score():
    assert {*TRIGGERS, "none"} == {*get_args(TriggerName)}
    assert {*SCORES} == {*TRIGGERS}


# Alone


class Params(NamedTuple):
    """The part of a filter's params that its trigger reads."""

    q: Any
    r: Any
    trigger: Any


class Step(NamedTuple):
    """What is fed to a trigger at one sample, beside the covariance to which a reset goes."""

    n: Any
    innovation: Any
    variance: Any
    updated: Any
    x: Any
    fed: Any
    at_rest: Any
    scheduled: Any
    feedback_at: Any
    after_reset: Any


def positive(rng, *shape, scale=1.0):
    """Random covariances (*shape)."""
    half = rng.normal(size=shape) * scale
    return half @ np.swapaxes(half, -1, -2) + 0.1 * scale**2 * np.eye(shape[-1])


def sequence(seed, samples, scheduled=(), every=1):
    """Random things to see, one a sample; innovations are correlated over time."""
    rng = np.random.default_rng(seed)
    s = positive(rng, samples, 2, 2)
    r = np.array([np.linalg.cholesky(one) @ rng.normal(size=2) for one in s])
    for k in range(1, samples):
        r[k] += rng.uniform(-0.9, 0.9) * r[k - 1]
    n = np.arange(1.0, samples + 1)
    return Step(
        n=n,
        innovation=r,
        variance=s,
        updated=positive(rng, samples, 5, 5),
        x=rng.normal(size=(samples, 5)),
        fed=rng.normal(size=(samples, 3)),
        at_rest=0.3 * rng.normal(size=(samples, 5, 5)),
        scheduled=np.isin(n, list(scheduled)),
        feedback_at=np.ceil(n / every) * every,
        after_reset=positive(rng, 5, 5),
    )


def upper(matrices):
    """Upper triangles, a tuple of entries with the leading axes of ``matrices``."""
    rows, across = np.triu_indices(matrices.shape[-1])
    return tuple(matrices[..., rows, across][..., k] for k in range(len(rows)))


def entries(matrices):
    pairs = [(i, j) for i in range(5) for j in range(5)]
    return {pair: matrices[..., pair[0], pair[1]] for pair in pairs}


def attitude_covariance(belief):
    """That of the last three of five states."""
    at = triangle_index(5)
    pairs = ((i, j) for i in (2, 3, 4) for j in (2, 3, 4) if i <= j)
    return AttitudeCovariance(*(belief.p[at[pair]] for pair in pairs))


def columns_of(rows):
    return tuple(rows[:, i] for i in range(rows.shape[1]))


def engine_numbers(trigger_params, at_feedback=False):
    at_feedback = np.float64(1) if at_feedback else None
    return triggers.TriggerParams(*map(np.float64, trigger_params), at_feedback)


@cache
def driven(name):
    """A compiled trigger: score and firing of every sample, and what it tells at last."""
    trigger = TRIGGERS[name].trigger

    @jax.jit
    def run(trigger_params, noise, p0, after_reset, steps):
        def one(trigger_state, step):
            n, innovation, variance, updated, x, fed, at_rest, *rest = step
            due, feedback_at, _ = rest
            filter_params = Params(noise.q, noise.r, trigger_params)
            state = FilterState(None, Belief(x, updated), (), feedback_at, trigger_state)
            snapshot = FilterSnapshot(
                innovation,
                variance,
                Belief(x, updated),
                Vec3(*(a + b for a, b in zip(state.trigger_state.fed_back, x[2:], strict=True))),
                Vec3(*x[2:]),
                attitude_covariance,
                at_rest,
            )
            memory = state.trigger_state.memory
            score = trigger.score(trigger_params, noise, memory, snapshot)[1]
            state = triggers.update_trigger(trigger, filter_params, state, snapshot, n)
            fires = triggers.fired(state.trigger_state, n)
            reset = due | fires
            p = tuple(jnp.where(reset, a, b) for a, b in zip(after_reset, updated, strict=True))
            closed = state._replace(belief=Belief(x, p))
            closed = triggers.update_after_closing(
                trigger, filter_params, closed, reset=reset, correction=Vec3(*fed), n=n
            )
            return closed.trigger_state, (score, fires)

        return jax.lax.scan(one, triggers.start(trigger, trigger_params, p0), steps)

    return run


def drive(name, trigger_params, steps, *, at_feedback=False):
    """The engine's trigger over a sequence."""
    packed = steps._replace(
        **{k: columns_of(getattr(steps, k)) for k in ("innovation", "x", "fed")},
        **{k: upper(getattr(steps, k)) for k in ("variance", "updated")},
        at_rest=entries(steps.at_rest),
        after_reset=steps.n,
    )
    noise = AssumedNoise(tuple(NOISE[0]), np.float64(NOISE[1]))
    trigger_state, out = driven(name)(
        engine_numbers(trigger_params, at_feedback),
        noise,
        upper(steps.after_reset),
        upper(steps.after_reset),
        packed,
    )
    score, fires = map(np.asarray, out)
    return score, [int(n) for n in steps.n[fires]], trigger_state


def drive_naively(name, trigger_params, steps, every=1):
    """The naive trigger over a sequence."""
    q, r = NOISE
    watcher = Watcher(name, trigger_params, q=q, r=r, p0=steps.after_reset, dt=DT, every=every)
    for i in range(len(steps.n)):
        k, x, p = i + 1, steps.x[i], steps.updated[i]
        r, s, correction = steps.innovation[i], steps.variance[i], watcher.fed + x[2:]
        now = NaiveSeen(r, s, correction, x[2:], p[2:, 2:])
        due = watcher.judge(k, now, np.eye(5) + steps.at_rest[i])
        watcher.feed(steps.fed[i])
        if due or steps.scheduled[i]:
            watcher.begin(k, steps.after_reset)
    return watcher


def threshold_at(scores, share):
    """A threshold that some share of the scores that are not zero exceed, and none meets."""
    ordered = np.unique([score for score in scores if score > 0])
    at = int(share * (len(ordered) - 1))
    return float(np.sqrt(ordered[at] * ordered[at + 1])) if at + 1 < len(ordered) else np.inf


@pytest.mark.parametrize("name", sorted(SCORES))
@given(
    seed=st.integers(0, 2**32 - 1),
    share=st.floats(0, 0.99),
    window=st.integers(1, 12),
    refractory=st.sampled_from([0, 1, 5, 13]),
    most=st.integers(1, 6) | st.just(100),
    until=st.sampled_from([np.inf, 7, 30]),
    scheduled=st.sets(st.integers(1, 60), max_size=4),
    every=st.sampled_from([1, 4, 7]),
)
@settings(max_examples=25)
def test_trigger_scores_and_firing_match_naive_trigger(
    name, seed, share, window, refractory, most, until, scheduled, every
):
    """Every so many samples, too; all of its resets wait for that, scheduled ones as well."""
    steps = sequence(seed, 60, {-(-k // every) * every for k in scheduled}, every)
    trigger_params = Numbers(np.inf, window, refractory, most, until)
    quiet = drive_naively(name, trigger_params, steps, every)
    trigger_params = trigger_params._replace(threshold=threshold_at(quiet.scores, share))
    naive = drive_naively(name, trigger_params, steps, every)
    score, trigger_counts, trigger_state = drive(name, trigger_params, steps, at_feedback=every > 1)
    assert all(k % every == 0 for k in trigger_counts)
    np.testing.assert_allclose(score, naive.scores, rtol=1e-9, atol=1e-12)
    assert trigger_counts == naive.trigger_counts
    assert tuple(trigger_state.trigger_counts) == (
        len(trigger_counts),
        *(trigger_counts[::-1][-1:] + trigger_counts[-1:] if trigger_counts else (0, 0)),
    )
    np.testing.assert_allclose(np.stack(trigger_state.fed_back), naive.fed, rtol=0, atol=1e-12)
    assert trigger_state.last_reset == naive.reset_at


def fired_at(steps, **trigger_params):
    return drive("innovation", Numbers(0.0, **trigger_params), steps)[1]


def test_refractory_time_cap_and_end_limit_trigger_firing():
    """With a threshold of zero a trigger fires whenever it may."""
    steps = sequence(1, 60)
    assert fired_at(steps) == list(range(1, 61))
    assert fired_at(steps, refractory=20) == [20, 40, 60]
    assert fired_at(steps, refractory=1, most=3) == [1, 2, 3]
    assert fired_at(steps, refractory=20, until=40.0) == [20, 40]
    assert fired_at(steps, refractory=20, until=39.0) == [20]
    # From the start and from any reset, a scheduled one too.
    assert fired_at(sequence(1, 60, {25}), refractory=20) == [20, 45]
    assert fired_at(steps, window=7) == [7, 14, 21, 28, 35, 42, 49, 56]
    assert fired_at(sequence(1, 60, {10, 40}), window=20) == [30, 60]
    # A window that was full within the refractory time is not waited for.
    assert fired_at(steps, window=8, refractory=20) == [24, 48]


# In the filter

SAMPLES, PHI0, V0 = 400, np.array([10.0, -8.0, 60.0]) * DEG, np.array([0.3, -0.2])
FILTERS = {"kalman5": (5, PAPER, "fixed"), "kalman10": (10, WGS84, "integrated")}
"""States, Earth, and what becomes of the position."""


@cache
def program(name, trigger, force):
    """A compiled run of one program over updates of either way: the state after each of them."""
    method = METHODS[name](Options(DT, force, FILTERS[name][2], trigger))

    @jax.jit
    def run(filt, here, nav, read):
        def step(state, xs):
            sample, n, backward, turns = xs
            turned = method.passes.reverse(filt, passes.site_of_pass(here, ~backward), state)
            state = select_tree(turns, turned, state)
            state = step_and_close(
                method, filt, passes.site_of_pass(here, backward), state, sample, n
            )
            return state, (
                state,
                method.attitude(state),
                method.results(here, state).trigger_counts,
            )

        return jax.lax.scan(step, method.init(filt, nav), read)[1]

    return run


def engine_run(name, trigger, trigger_params, filt, stored=None):
    """State, corrected attitude and the trigger's result after every update."""
    planet = FILTERS[name][1]
    all_read = list(updates(measured(planet, LATITUDE, SAMPLES), stored, SAMPLES))
    q = np.array([quaternion(u.turn) for u in all_read])
    dv = np.array([u.dv for u in all_read])
    read = (
        Sample(Quat(*q.T), Vec3(*dv.T)),
        np.array([float(u.k) for u in all_read]),
        np.array([u.way < 0 for u in all_read]),
        np.array([u.turns for u in all_read]),
    )
    nav = navigation(exp(-PHI0) @ PAPER1.matrix(0.0), V0, LATITUDE)
    trigger_params = engine_numbers(trigger_params, filt.at_feedback)
    filt_params = params(filt)._replace(trigger=trigger_params)
    return program(name, trigger, filt.force)(filt_params, site(planet, LATITUDE), nav, read)


def naive_run(name, trigger, trigger_params, filt, stored=None):
    """History, and the watcher."""
    planet = FILTERS[name][1]
    every = filt.every if filt.at_feedback else 1
    watcher = Watcher(trigger, trigger_params, q=filt.q, r=filt.r, p0=filt.p0, dt=DT, every=every)
    c = exp(-PHI0) @ PAPER1.matrix(0.0)
    case = {"latitude": LATITUDE, "c": c, "v": V0, "filt": filt, "watcher": watcher}
    return closed_loop(
        measured(planet, LATITUDE, SAMPLES), DT, planet, stored=stored, count=SAMPLES, **case
    ), watcher


def compare(name, trigger, trigger_params, filt, stored=None):
    """Both runs, update by update; returns the naive watcher."""
    naive, watcher = naive_run(name, trigger, trigger_params, filt, stored)
    state, attitude, trigger_counts = engine_run(name, trigger, trigger_params, filt, stored)
    at = 1 + np.flatnonzero(np.diff(np.asarray(trigger_counts.count), prepend=0.0))
    assert list(at) == watcher.trigger_counts
    first, last = (
        (watcher.trigger_counts[0], watcher.trigger_counts[-1])
        if watcher.trigger_counts
        else (0, 0)
    )
    assert (trigger_counts.first[-1], trigger_counts.last[-1]) == (first, last)
    close = {"rtol": 0, "atol": 1e-10}
    np.testing.assert_allclose(of_quaternion(np.stack(state.nav.q, axis=1)), naive.c, **close)
    np.testing.assert_allclose(np.stack([state.nav.ve, state.nav.vn], axis=1), naive.v, **close)
    corrected = np.array([exp(x[2:5]) @ c for x, c in zip(naive.x, naive.c, strict=True)])
    np.testing.assert_allclose(of_quaternion(np.stack(attitude, axis=1)), corrected, **close)
    sigma = np.sqrt(np.diagonal(naive.p, axis1=1, axis2=2))
    unit = sigma[:, :, None] * sigma[:, None, :]
    p = covariances(state.belief.p)
    np.testing.assert_allclose(p / unit, naive.p / unit, rtol=0, atol=1e-7)
    if trigger == "linearisation":
        sigma = np.sqrt(np.diag(watcher.honest))
        honest, unit = covariances(state.trigger_state.memory)[-1], np.outer(sigma, sigma)
        np.testing.assert_allclose(honest / unit, watcher.honest / unit, rtol=0, atol=1e-9)
    return watcher


CLOSED = {"every": 7, "gain": 0.6, "resets": (90, 333)}
NEAR = Numbers(np.inf, window=20, refractory=10, most=12, until=380)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("name", "trigger", "stored", "changes"),
    [
        ("kalman5", "innovation", None, CLOSED | {"r": 1e-5}),
        ("kalman5", "innovation", 145, CLOSED | {"r": 1e-5, "kind": "yaw"}),
        ("kalman10", "linearisation", 145, CLOSED),
        ("kalman5", "innovation", 145, CLOSED | {"r": 1e-5, "restarts": True}),
        ("kalman5", "innovation", 145, CLOSED | {"r": 1e-5, "at_feedback": True}),
        ("kalman5", "linearisation", 145, CLOSED | {"every": 31, "at_feedback": True}),
    ],
)
def test_triggered_filter_resets_match_naive_filter(name, trigger, stored, changes):
    """At a large misalignment, with scheduled resets between, and over turns of the record."""
    n, _, position = FILTERS[name]
    filt = paper_filter(n, position=position, **changes)
    _, quiet = naive_run(name, trigger, NEAR, filt, stored)
    for share in (0.0, 0.5, 0.9):
        trigger_params = NEAR._replace(threshold=threshold_at(quiet.scores, share))
        assert compare(name, trigger, trigger_params, filt, stored).trigger_counts


# In a study

ROWS = {
    "study": {"duration_s": 2.0, "window_s": [0, 2], "settle_bands_arcmin": [60]},
    "filter": {"r_velocity_m_per_s": 1e-3},
    "resets": {
        "trigger_window_s": 0.01,
        "trigger_refractory_s": 0.3,
        "trigger_until_s": 1.2,
        "reset_times_s": [0.5],
    },
    "axes": {"reset_trigger": ["none", "innovation"], "trigger_threshold": [1e12, 3e-4]},
}
QUIET, LOUD = 2, 3
"""Variants with a trigger, of four."""


def of_variant(rows, number):
    return [row for row in rows if row["variant_id"] == number]


@pytest.mark.nightly
def test_trigger_results_are_independent_of_other_runs():
    """Other neighbours, fewer draws: the same bits."""
    rows = study_run.run(small_study(**ROWS)).summary.to_pylist()
    tables = ROWS | {"study": ROWS["study"] | {"draws": 2}}
    tables["axes"] = ROWS["axes"] | {"trigger_threshold": [0.0, 3e-4]}
    alone = study_run.run(small_study(**tables)).summary.to_pylist()
    assert of_variant(alone, LOUD) == of_variant(rows, LOUD)[:2]
    assert all(row["triggered_count"] for row in of_variant(alone, QUIET))

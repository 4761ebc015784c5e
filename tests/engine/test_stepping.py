"""Going from event to event changes no bit."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.studies import small_study

from sinsjax.engine import batch, build
from sinsjax.engine import lanes as lane_layout
from sinsjax.engine.environment import Static
from sinsjax.engine.run import run_tile
from sinsjax.engine.stepping import Blocks, Steps, event_by_event, sample_by_sample
from sinsjax.methods.schedules import Resets, next_due, reset_due

HEEDING = {"reset_at_feedback": [False, True], "reset_restarts_feedback": [False, True]}
SCHEDULES = {
    "reset_times_s": [(), (1.37, 4.0), (0.5,), (2.0, 2.01, 2.02)],
    "feedback_interval_s": [0.01, 0.07, 1.0, 5.0],
    **HEEDING,
}
"""As many as a tile has lanes."""

TRIGGER = {"reset_trigger": "innovation", "trigger_threshold": 3e-4, "trigger_window_s": 0.01}


def group_of(draws: int, axes: dict[str, list], **tables: Any) -> lane_layout.Group:
    study = small_study(study={"draws": draws, "curves": True}, axes=axes, **tables)
    (part,) = build.parts(study)
    return part.group


@cache
def program(static: Static, by_event: bool) -> Callable:
    return jax.jit(partial(run_tile, static, by_event=by_event))


def run_tiles(group: lane_layout.Group, *, by_event: bool = True) -> tuple:
    """Outcomes and curves of the group's tiles."""
    tiles = lane_layout.tiles_of(group, batch.plan(group)[0])
    one = program(group.static, by_event)
    rows = [one(group.environment, jax.tree.map(lambda a, i=i: a[i], tiles)) for i in range(2)]
    return tuple(jax.tree.leaves(rows))


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("draws", "axes"), [(2, SCHEDULES), (130, {"reset_times_s": [(1.37, 4.0)]})]
)
def test_event_stepping_is_bitwise_equal_to_sample_stepping(draws, axes):
    """One draw and 64 a tile: their noise is made in pieces, or by sample.

    Schedules have what restarts the clock, and what waits for it.
    """
    group = group_of(draws, axes)
    by_sample = run_tiles(group, by_event=False)
    for a, b in zip(run_tiles(group), by_sample, strict=True):
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()


@pytest.mark.nightly
@pytest.mark.optimised(False)
def test_event_stepping_matches_sample_stepping_for_triggered_resets():
    """To rounding: a trigger's samples are compiled anew."""
    given = {
        "filter": {"r_velocity_m_per_s": 1e-3},
        "resets": TRIGGER | {"reset_times_s": [1.37, 4.0]},
    }
    group = group_of(32, HEEDING, **given)
    by_sample = run_tiles(group, by_event=False)
    for a, b in zip(run_tiles(group), by_sample, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


@pytest.mark.nightly
def test_other_schedules_in_tile_do_not_change_run():
    """One of 64 schedules, and the same beside 63 others."""
    resets = [(0.3 + 0.11 * i, 4.5, 5.0) for i in range(15)]
    others = {"reset_times_s": [(1.37, 4.0), *resets], "feedback_interval_s": [0.07]} | HEEDING
    many, same = (run_tiles(group_of(2, axes)) for axes in (SCHEDULES, others))
    mine = (1 * 4 + 1) * 4 + 3  # (1.37, 4.0) and 0.07 s, each heeding the other
    for a, b in zip(many, same, strict=True):
        axis = a.shape.index(64)
        x, y = (np.moveaxis(np.asarray(leaf), axis, 0)[at] for leaf, at in ((a, mine), (b, 3)))
        assert x.tobytes() == y.tobytes()


@given(
    st.lists(st.integers(1, 40), max_size=4),
    st.integers(1, 60),
    st.integers(0, 45),
)
def test_next_event_is_first_sample_with_due_feedback_or_reset(resets, feedback_at, n):
    schedule = Resets(np.array(resets, float).reshape(-1), None)
    if feedback_at <= n:  # it would have been closed
        feedback_at = n + 1
    found = next_due(np.float64(feedback_at), schedule, np.float64(n))
    ahead = range(n + 1, 100)
    due = (k for k in ahead if k >= feedback_at or bool(reset_due(schedule, np.float64(k))))
    assert float(found) == next(due)


@settings(max_examples=6)
@given(
    st.sampled_from([(1, 1), (12, 1), (12, 3), (12, 12)]),
    st.lists(st.integers(1, 15), min_size=3, max_size=3),
    st.integers(0, 3),
)
def test_stepping_visits_every_sample_once_with_previous_sample(sizes, events, told):
    count, piece = sizes
    at = jnp.asarray(sorted(events))
    foreseen = at[:told]  # of the others the samples themselves tell

    def make(before, number):
        now = 100.0 + (number * piece + jnp.arange(piece)).astype(float)
        return (now, jnp.concatenate([before[None], now[:-1]])), now[-1]

    def step(state, place, sample):
        total, log, closings = state
        now, before = sample
        return 3.0 * total + 7.0 * now + before, log.at[place].add(1), closings

    def close(state, place):
        total, log, closings = state
        return total, log, jnp.where(jnp.any(at == place), closings + 1, closings)

    def next_event(state, place):
        ahead = jnp.where(foreseen > place, foreseen.astype(float), jnp.inf)
        return jnp.min(ahead, initial=jnp.inf)

    def called(state, place):
        return jnp.any(at[told:] == place)

    start = (jnp.asarray(0.0), jnp.zeros(count, int), jnp.asarray(0)), jnp.asarray(5.0)
    steps = Steps(step, close, next_event, called if told < 3 else None)
    blocks = Blocks(count, piece, make)
    one = sample_by_sample(steps, *start, blocks)
    other = event_by_event(steps, *start, blocks)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)
    (total, log, closings), last = one
    expected, before = 0.0, 5.0
    for now in 100.0 + np.arange(count):
        expected, before = 3.0 * expected + 7.0 * now + before, now
    assert (float(total), float(last)) == (expected, before)
    np.testing.assert_array_equal(log, 1)
    assert int(closings) == len({e for e in events if e <= count})

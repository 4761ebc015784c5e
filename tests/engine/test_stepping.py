"""Going from event to event changes no bit, and a run taken alone can be differentiated."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.studies import small_study

from sinsjax.alignment.schedules import Resets, next_due, reset_due
from sinsjax.engine import batch, build, tile
from sinsjax.engine import lanes as lane_layout
from sinsjax.engine.stepping import event_by_event, sample_by_sample

SCHEDULES = {
    "reset_times_s": [(), (1.37, 4.0), (0.5,), (2.0, 2.01, 2.02)],
    "feedback_interval_s": [0.01, 0.07, 1.0, 5.0],
}
NIS = {"reset_trigger": "nis", "trigger_threshold": 3e-4}


def group_of(draws: int, **axes: list) -> lane_layout.Group:
    study = small_study(study={"draws": draws, "curves": True}, axes=axes)
    (part,) = build.parts(study)
    return part.group


def run_tiles(group: lane_layout.Group) -> tuple:
    """Outcomes and curves of the group's tiles."""
    tiles = lane_layout.tiles_of(group, batch.plan(group)[0])
    one = jax.jit(partial(tile.run_tile, group.static, group.environment))
    rows = [one(jax.tree.map(lambda a, i=i: a[i], tiles)) for i in range(2)]
    return tuple(jax.tree.leaves(rows))


@pytest.mark.parametrize("draws", [1, 20, 130])
def test_closing_at_events_and_at_every_sample_give_the_same_bits(draws, monkeypatch):
    """One draw, four and 64 a tile: their noise is made in different pieces, or by sample."""
    group = group_of(draws, **(SCHEDULES if draws < 64 else {"reset_times_s": [(1.37, 4.0)]}))
    at_events = run_tiles(group)
    monkeypatch.setattr(tile, "event_by_event", lambda *given, **_: sample_by_sample(*given))
    for a, b in zip(at_events, run_tiles(group), strict=True):
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()


@pytest.mark.parametrize(("trigger", "off"), [({}, 0), (NIS, 1e-12)])
def test_resets_that_heed_feedback_are_closed_at_events_as_well(trigger, off, monkeypatch):
    """What restarts the clock, and what waits for it; a trigger's samples are compiled anew."""
    study = small_study(
        study={"draws": 32, "curves": True},
        filter={"r_velocity_m_per_s": 1e-3},
        resets=trigger | {"reset_times_s": [1.37, 4.0]},
        axes={"reset_at_feedback": [False, True], "reset_restarts_feedback": [False, True]},
    )
    (part,) = build.parts(study)
    at_events = run_tiles(part.group)
    monkeypatch.setattr(tile, "event_by_event", lambda *given, **_: sample_by_sample(*given))
    for a, b in zip(at_events, run_tiles(part.group), strict=True):
        np.testing.assert_allclose(a, b, rtol=off, atol=off)


def test_other_schedules_in_the_tile_change_no_bit_of_a_run():
    """One of sixteen schedules, and the same beside fifteen others."""
    resets = [(0.3 + 0.11 * i,) for i in range(15)]
    others = {"reset_times_s": [(1.37, 4.0), *resets], "feedback_interval_s": [0.07]}
    many, same = (run_tiles(group_of(4, **axes)) for axes in (SCHEDULES, others))
    mine = 1 * 4 + 1  # (1.37, 4.0) and 0.07 s
    for a, b in zip(many, same, strict=True):
        axis = a.shape.index(64)
        x, y = (np.moveaxis(np.asarray(leaf), axis, 0)[at::16] for leaf, at in ((a, mine), (b, 0)))
        assert x.tobytes() == y.tobytes()


@given(
    st.lists(st.integers(1, 40), max_size=4),
    st.integers(1, 60),
    st.integers(0, 45),
)
def test_an_event_is_the_next_sample_at_which_anything_is_due(resets, feedback_at, n):
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
def test_every_sample_is_taken_once_and_looks_back_at_the_one_before(sizes, events, told):
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
    one = sample_by_sample(*start, count, step, close, make, piece)
    asked = called if told < 3 else None
    other = event_by_event(*start, count, step, close, make, piece, next_event, asked)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)
    (total, log, closings), last = one
    expected, before = 0.0, 5.0
    for now in 100.0 + np.arange(count):
        expected, before = 3.0 * expected + 7.0 * now + before, now
    assert (float(total), float(last)) == (expected, before)
    np.testing.assert_array_equal(log, 1)
    assert int(closings) == len({e for e in events if e <= count})

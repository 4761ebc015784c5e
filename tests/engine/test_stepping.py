"""Going from event to event changes no bit."""

from functools import cache, partial
from typing import Any

import jax
import pytest
from support.batches import assert_same, batch_of
from support.studies import small_study

from sinsjax.engine.run import run_tile

HEEDING = {"reset_at_feedback": [False, True], "reset_restarts_feedback": [False, True]}
SCHEDULES = {
    "reset_times_s": [(), (1.37, 4.0), (0.5,), (2.0, 2.01, 2.02)],
    "feedback_interval_s": [0.01, 0.07, 1.0, 5.0],
    **HEEDING,
}
"""As many as a tile has lanes: those that restart the clock, and those that wait for it."""

TRIGGER = {"reset_trigger": "innovation", "trigger_threshold": 3e-4, "trigger_window_s": 0.01}
TRIGGERED = {
    "filter": {"r_velocity_m_per_s": 1e-3},
    "resets": TRIGGER | {"reset_times_s": [1.37, 4.0]},
}


SETTINGS = {"draws": 2, "curves": True}
FEW: dict[str, list] = {"reset_times_s": [(1.37, 4.0)]}


@cache
def tile_program(spec, by_event):
    return jax.jit(partial(run_tile, spec, by_event=by_event))


def run_tiles(runs, *, by_event):
    """Return all results of the first two tiles, which go from event to event or by samples."""
    tiles = runs.lay_out().tiles_of_chunk(runs, 0)
    program = tile_program(runs.spec, by_event)
    found = [program(runs.environment, jax.tree.map(lambda a, i=i: a[i], tiles)) for i in range(2)]
    return jax.tree.leaves(found)


@pytest.mark.nightly(fast=("fast",))
@pytest.mark.parametrize(
    ("draws", "axes", "tables", "tolerance"),
    [
        pytest.param(130, FEW, {}, 0.0, id="fast", marks=pytest.mark.optimised(False)),
        pytest.param(130, FEW, {}, 0.0, id="64 draws a tile"),
        pytest.param(2, SCHEDULES, {}, 0.0, id="one draw a tile"),
        pytest.param(
            *(32, HEEDING, TRIGGERED, 1e-12), id="triggered", marks=pytest.mark.optimised(False)
        ),
    ],
)
def test_event_stepping_equals_sample_stepping(
    draws: int, axes: dict[str, list], tables: dict[str, Any], tolerance: float
) -> None:
    """Noise is made in pieces, or by sample; the samples of a trigger are compiled anew."""
    runs = batch_of(small_study(study=SETTINGS | {"draws": draws}, axes=axes, **tables))
    assert_same(run_tiles(runs, by_event=True), run_tiles(runs, by_event=False), tolerance)

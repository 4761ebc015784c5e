"""Batches of runs for tests, which need to know neither how one is made nor how it is laid out."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import numpy as np

from sinsjax.arena.export import simulated_records
from sinsjax.engine.batch import Batch, Chunk, Chunks, map_in_threads
from sinsjax.engine.inputs import ProgramSpec
from sinsjax.engine.metrics import Observation, Outcome
from sinsjax.engine.run import run_tile
from sinsjax.engine.scenario import Scenario
from sinsjax.records.reference import StoredRecord
from sinsjax.study.study import Study

Run = tuple[int, int]
"""Draw and variant."""


def batches_of(
    study: Study, stored: StoredRecord | None = None, *, curves: bool | None = None
) -> list[Batch]:
    """Return the batches of all programs of a study."""
    scenario = Scenario(study, stored, curves=curves)
    return [scenario.batch(number) for number in range(len(scenario.specs))]


def batch_of(
    study: Study, stored: StoredRecord | None = None, *, curves: bool | None = None
) -> Batch:
    """Return the only batch of a study."""
    (only,) = batches_of(study, stored, curves=curves)
    return only


def run_chunks(runs: Batch, *, devices: int = 1, tiles_per_chunk: int | None = None) -> list[Chunk]:
    """Run a batch, chunk by chunk, on some devices."""
    chunks = Chunks(runs, tiles_per_chunk=tiles_per_chunk)
    chunks.compile()
    return list(map_in_threads(chunks.compute, range(len(chunks)), devices))


def all_runs(runs: Batch, **options: int) -> tuple[Outcome, Observation | None]:
    """Return the outcomes and curves of all runs, by run number."""
    chunks = run_chunks(runs, **options)
    whole = jax.tree.map(lambda *leaves: np.concatenate(leaves), *chunks)
    order = np.lexsort((whole.variant, whole.draw))
    found: tuple[Outcome, Observation | None] = jax.tree.map(
        lambda a: a[order], (whole.outcome, whole.curves)
    )
    return found


def runs_of_variant(whole: Any, study: Study, variant: int) -> Any:
    """Return those of all runs that are of one variant, leaves (draws, ...)."""
    return jax.tree.map(lambda a: a[variant :: study.n_variants], whole)


def break_variant(runs: Batch, variant: int) -> Batch:
    """Return a batch in which one variant starts from an angle that is no number."""
    phi = runs.params.phi
    up = np.where(np.arange(len(phi.z)) == variant, np.nan, phi.z)
    return runs._replace(params=runs.params._replace(phi=phi._replace(z=up)))


def lay_out(study: Study, tiles_per_chunk: int | None) -> list[tuple[list[Run], list[Run]]]:
    """Return, chunk by chunk, the runs of its lanes: as planned, and as its tiles have them.

    The p0 of the last state, in degrees, numbers the variants from 1.
    """
    runs = batch_of(study)
    layout, chunks = runs.lay_out(tiles_per_chunk=tiles_per_chunk), []
    for number in range(len(layout)):
        places, active_lanes = layout[number], layout.active(number)
        in_lanes = np.argsort(active_lanes.lane)
        draws, variants = active_lanes.draw[in_lanes], active_lanes.variant[in_lanes]
        planned = list(zip(draws.tolist(), variants.tolist(), strict=True))
        assert {layout.chunk_of(*run) for run in planned} == {number}
        tiles = layout.tiles_of(runs, number)
        ids = np.asarray(tiles.draws.draw_id).reshape(*places.draw.shape[:2], -1)
        draw = np.take_along_axis(ids, np.broadcast_to(tiles.row[:, None], places.draw.shape), 2)
        variant = np.sqrt(tiles.params.method.p0[-1]) / np.deg2rad(1) - 1
        active = (places.draw < runs.n_draws) & (places.variant < runs.n_variants)
        variant = np.broadcast_to(variant[:, None], active.shape).round().astype(int)
        given = list(zip(draw[active].tolist(), variant[active].tolist(), strict=True))
        chunks.append((planned, given))
    return chunks


def run_tiles(runs: Batch, *, by_event: bool) -> list[Any]:
    """Return all results of the first two tiles, which go from event to event or by samples."""
    tiles = runs.lay_out().tiles_of(runs, 0)
    program = _tile_program(runs.spec, by_event)
    found = [program(runs.environment, jax.tree.map(lambda a, i=i: a[i], tiles)) for i in range(2)]
    return jax.tree.leaves(found)


@cache
def _tile_program(spec: ProgramSpec, by_event: bool) -> Callable:
    return jax.jit(partial(run_tile, spec, by_event=by_event))


def records_of(study: Study) -> np.ndarray:
    """Return the measured increments of all draws, rad and m/s, (draws, samples, 6)."""
    records = simulated_records(batch_of(study), study.rate_hz, study.name)
    return np.stack([np.concatenate([one.dtheta, one.dv], axis=1) for one in records])


def assert_same(one: Any, other: Any, tolerance: float = 0.0) -> None:
    """Assert that two trees have equal leaves, to rounding if so wanted; nan equals nan."""
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)

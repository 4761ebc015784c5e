"""Batches of runs for tests, which need to know neither how one is made nor how it is laid out."""

from sinsjax.engine.batch import Batch, Chunk, Chunks, map_in_threads
from sinsjax.engine.scenario import Scenario
from sinsjax.records.reference import StoredRecord
from sinsjax.study.study import Study


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

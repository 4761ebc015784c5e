"""Batches of runs for tests, which need to know neither how one is made nor how it is laid out."""

import jax
import numpy as np

from sinsjax.arena.export import simulated_records
from sinsjax.engine.batch import Chunks, map_in_threads
from sinsjax.engine.scenario import Scenario


def batches_of(study, stored=None, *, curves=None):
    """Return the batches of all programs of a study."""
    scenario = Scenario(study, stored, curves=curves)
    return [scenario.batch(number) for number in range(len(scenario.specs))]


def batch_of(study, stored=None, *, curves=None):
    """Return the only batch of a study."""
    (only,) = batches_of(study, stored, curves=curves)
    return only


def run_chunks(runs, *, devices=1, tiles_per_chunk=None):
    """Run a batch, chunk by chunk, on some devices."""
    chunks = Chunks(runs, tiles_per_chunk=tiles_per_chunk)
    chunks.compile()
    return list(map_in_threads(chunks.compute, range(len(chunks)), devices))


def all_runs(runs, **options):
    """Return the outcomes and curves of all runs, by run number."""
    chunks = run_chunks(runs, **options)
    whole = jax.tree.map(lambda *leaves: np.concatenate(leaves), *chunks)
    order = np.lexsort((whole.variant, whole.draw))
    return jax.tree.map(lambda a: a[order], (whole.outcome, whole.curves))


def records_of(study):
    """Return the measured increments of all draws, rad and m/s, (draws, samples, 6)."""
    records = simulated_records(batch_of(study), study.rate_hz, study.name)
    return np.stack([np.concatenate([one.dtheta, one.dv], axis=1) for one in records])


def assert_same(one, other, tolerance=0.0):
    """Assert that two trees have equal leaves, to rounding if so wanted; nan equals nan."""
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)

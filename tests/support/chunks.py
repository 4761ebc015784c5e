"""Synthetic chunks of results."""

import numpy as np

from sinsjax.engine.batch import Chunk
from sinsjax.engine.metrics import Observation, Outcome
from sinsjax.methods.filters.loop import FilterResults
from sinsjax.methods.floors import BiasFloor
from sinsjax.types import Vec3
from sinsjax.units import ARCMIN


def chunk(
    phi_u_arcmin, outside_until, yaw=1.0, *, from_truth=None, level_arcmin=2.0, no_north=False
):
    """Runs of draw 0 with these final errors and ends of their time outside the bands.

    Their bias floor is 1' and -1' in level and -20' in heading, and biases tilt by up to 1.5'.
    """
    n = len(phi_u_arcmin)
    one = np.ones(n)
    level = level_arcmin * ARCMIN * one
    phi = Vec3(level / 2, level, np.array(phi_u_arcmin) * ARCMIN)
    last = Observation(phi, Vec3(one, one, one), 0.1 * one, 0.2 * one, yaw * one)
    outcome = Outcome(
        last=last,
        outside_until=np.stack([outside_until, from_truth or outside_until], axis=1),
        mean=(one,) * 6,
        std=(one,) * 6,
        above_share=(one,) * 3,
        nees=one,
        nis_u=one,
        floor=BiasFloor(
            Vec3(*(arcmin * ARCMIN * one for arcmin in (1.0, -1.0, -20.0))),
            1.5 * ARCMIN * one,
            np.full(n, no_north),
        ),
        results=FilterResults(None, None),
    )
    return Chunk(np.zeros(n, int), np.arange(n), outcome, None)

"""The Numba loop of the benchmarks does what the NumPy baseline does."""

import sys
from pathlib import Path

import numpy as np
import pytest
from oracles.naive import euler_matrix

from sinsjax.bench.baseline import AlignmentSettings, align_with_numpy_loop
from sinsjax.units import DEG, DEG_PER_H

try:
    from numba import njit

    njit(lambda: 1)()
except Exception as error:
    pytest.skip(f"no Numba that works (extra `benchmark`): {error}", allow_module_level=True)

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
import numba_loop  # noqa: E402

UG = 9.8e-6
RATE = 15.041067 * DEG_PER_H


def increments(samples, dt, c):
    """A base that is shaken at random, about what Earth rate and gravity give at rest."""
    random = np.random.default_rng(3)
    mean = np.concatenate([c.T @ [0.0, RATE * 0.8, RATE * 0.6], c.T @ [0.0, 0.0, 9.8]]) * dt
    return mean + random.normal(size=(samples, 6)) * ([1e-3] * 3 + [1e-2] * 3)


@pytest.mark.parametrize("angles", [(0.1, -0.2, 0.7), (0.3, 0.2, 3.1), (0.2, 3.0, 0.1)])
def test_numba_loop_matches_numpy_baseline(angles):
    dt = 0.01
    setting = AlignmentSettings(
        dt=dt,
        rate_n=RATE * 0.8,
        rate_u=RATE * 0.6,
        tan_latitude=0.75,
        radius=6378137.0,
        p0=np.array([0.1, 0.1, 15 * DEG, 15 * DEG, 80 * DEG]) ** 2,
        q=np.array([500 * UG] * 2 + [0.1 * DEG_PER_H] * 3) ** 2,
        r=0.01,
        feedback_every=40,
        resets=(130, 215),
    )
    c = euler_matrix(*angles)
    data = increments(350, dt, c)
    for ours, theirs in zip(
        numba_loop.align(data, c, setting), align_with_numpy_loop(data, c, setting), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12)

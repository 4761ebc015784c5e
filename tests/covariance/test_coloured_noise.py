"""Inputs that are not white in covariance analysis: against dense matrices over all states."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sinsjax.covariance import coloured_noise
from sinsjax.covariance.error_growth import ErrorInputs, IncrementNoise, apply_step, initial_growth
from sinsjax.maths import rotations
from sinsjax.maths.algebra import Minus
from sinsjax.methods.base import ErrorStep
from sinsjax.strapdown import processes
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.types import Quat

pytestmark = pytest.mark.optimised(False)

DT, SAMPLES, N = 0.1, 17, 3
STEP = ErrorStep(
    transition={
        (0, 2): jnp.asarray(0.3),
        (2, 0): Minus(jnp.asarray(0.2)),
        (1, 1): jnp.asarray(-0.1),
    },
    inputs={(0, 0): jnp.asarray(1.0), (1, 2): jnp.asarray(0.5), (2, 4): Minus(jnp.asarray(1.0))},
    gains=((jnp.asarray(0.2), jnp.asarray(0.1), jnp.asarray(-0.05)),),
    measured=(0,),
)
Q = Quat(*(jnp.asarray(x) for x in np.array([0.9, 0.1, -0.3, 0.2]) / 0.9746794))

SCALES = np.array([0.3, 0.7, 1.1])
ALL = Disturbances(
    surge=processes.bounded_velocity_process(SCALES, 2.0, 0.5, DT),
    gyro_instability=processes.sampled_mean_of_gauss_markov(SCALES, 3.0, DT),
    accel_walk=processes.sampled_mean_of_random_walk(SCALES, DT),
)


def dense(disturbances: Disturbances) -> tuple[np.ndarray, np.ndarray]:
    """F and W over an interval, of d and of all processes, sample by sample.

    The surge enters as the difference of its velocities, the others as means over a sample.
    """
    a, c = np.eye(N), np.array([[float(x) for x in row] for row in rotations.matrix(Q)])
    for (i, j), entry in STEP.transition.items():
        a[i, j] += -float(entry.of) if isinstance(entry, Minus) else float(entry)
    g = np.zeros((N, 6))
    for (i, j), entry in STEP.inputs.items():
        g[i, j] = -float(entry.of) if isinstance(entry, Minus) else float(entry)
    ((gain,), (m,)) = STEP.gains, STEP.measured
    kept = np.eye(N)
    kept[:, m] -= np.array([float(x) for x in gain])
    blocks, by_x, by_w, drives = [], [], [], []
    for name, process in disturbances._asdict().items():
        if process is None:
            continue
        phi, b, out = process.transition, process.drive, process.output
        eye = np.eye(3)
        first = {"gyro": 3}.get(name.partition("_")[0], 0)
        axes = np.eye(3) if name == "surge" else c
        into = g[:, first : first + 3] @ axes @ np.diag(process.scale)
        if name == "surge":
            rows, direct = out @ phi - out, out @ b
        else:
            rows, direct = DT * out, DT * process.direct
        blocks.append(np.kron(phi, eye))
        by_x.append(into @ np.kron(rows[None], eye))
        by_w.append(direct * into)
        drives.append(np.kron(b[:, None], eye))
    sizes = [len(block) for block in blocks]
    m_all, w_all = sum(sizes), 3 * len(sizes)
    whole = np.zeros((N + m_all, N + m_all))
    whole[:N, :N] = kept @ a
    whole[:N, N:] = kept @ np.hstack(by_x)
    noise = np.zeros((N + m_all, w_all))
    noise[:N] = kept @ np.hstack(by_w)
    at = N
    for place, (block, drive) in enumerate(zip(blocks, drives, strict=True)):
        whole[at : at + len(block), at : at + len(block)] = block
        noise[at : at + len(block), 3 * place : 3 * place + 3] = drive
        at += len(block)
    f, w = np.eye(N + m_all), np.zeros_like(whole)
    for _ in range(SAMPLES):
        f, w = whole @ f, whole @ w @ whole.T + noise @ noise.T
    return f, w


@pytest.mark.nightly(fast=("surge", "accel_walk"))
@pytest.mark.parametrize("name", [*(n for n, p in ALL._asdict().items() if p is not None), "all"])
def test_coloured_growth_matches_dense_matrices(name: str) -> None:
    own = ALL if name == "all" else Disturbances(**{name: getattr(ALL, name)})
    coloured = coloured_noise.increment_error_processes(own, DT)
    quiet = IncrementNoise((jnp.asarray(0.0),), (jnp.asarray(0.0),))
    growth = initial_growth(ErrorInputs(quiet, coloured), N, jnp.asarray(0.0))
    advance = jax.jit(lambda growth: apply_step(growth, STEP, Q, quiet, coloured))
    for _ in range(SAMPLES):
        growth = advance(growth)
    f, w = dense(own)
    found = np.array(growth.columns).T
    np.testing.assert_allclose(found, f[:N, :N], rtol=1e-10)
    told = w[:N, :N][np.triu_indices(N)]
    np.testing.assert_allclose(np.array(growth.noise), told, rtol=1e-9, atol=1e-12)
    at = N
    for one in growth.coloured:
        response, cross = (np.array(kind).reshape(N, -1) for kind in (one.response, one.cross))
        wide = response.shape[1]
        np.testing.assert_allclose(response, f[:N, at : at + wide], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(cross, w[:N, at : at + wide], rtol=1e-9, atol=1e-12)
        variance = np.kron(one.variance, np.eye(3))
        inside = w[at : at + wide, at : at + wide]
        np.testing.assert_allclose(variance, inside, rtol=1e-9, atol=1e-12)
        at += wide

"""Turns of the base and given attitudes against matrices written anew and differentiated by JAX."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.in_engine import motion, place
from oracles.naive import DEG, WGS84, Swing, skew
from scipy.interpolate import CubicSpline

from sinsjax.strapdown import base_motion
from sinsjax.strapdown.base_motion import attitude_path
from sinsjax.strapdown.turns import Turns
from sinsjax.types import Vec3
from sinsjax.units import DEG_PER_H

pytestmark = pytest.mark.optimised(False)


RATE_HZ = 100.0
HERE = place(WGS84, 45 * DEG)
LEVER = np.array([0.3, -0.2, 0.1])
SWING = Swing(
    np.array([1.0, -2.0, 40.0]) * DEG,
    np.array([2.0, 3.0, 1.0]) * DEG,
    np.array([6.0, 8.0, 5.0]),
    np.array([0.3, 1.0, 0.0]),
)
NODES, WEIGHTS = np.polynomial.legendre.leggauss(24)

# Begin (sample), length (samples), ramp (samples), angle (deg); the last one is not finished.
TURNS = ((20, 1000, 100, 180.0), (1500, 90, 100, -90.0), (150_000, 150_000, 30, -90_000.0))
SAMPLES = (0, 20, 21, 70, 119, 120, 600, 1020, 1100, 1119, 1120, 1501, 1589, 1590, 1610, 1689)
LATE = (150_000, 150_007, 150_029, 150_030, 200_000)

ROWS = np.arange(0, 20, 5 / RATE_HZ)
ANGLES = np.column_stack([3 * np.cos(ROWS), 2 * np.sin(2 * ROWS), 60 * np.sin(ROWS)])
SPLINE = CubicSpline(ROWS, np.radians(ANGLES)).c
"""Given attitudes, pitch, roll and yaw (deg) every five samples."""


def as_turns(turns=TURNS):
    begin, length, ramp, angle = np.array(turns, float).T
    before = np.remainder(np.cumsum(angle) - angle, 360.0) * DEG
    times = (begin / RATE_HZ, length / RATE_HZ, ramp / RATE_HZ)
    return Turns(*times, angle * DEG / (length / RATE_HZ), before)


AXES = ("vertical", "table", "both", "path")


def moved(axis):
    swaying = motion(SWING)._replace(lever=Vec3(*LEVER))
    if axis == "path":
        return swaying._replace(path=attitude_path(ROWS, ANGLES))
    return swaying._replace(**{one: as_turns() for one in AXES[:2] if axis in (one, "both")})


def ramp(length, t):
    x = jnp.clip(t / length, 0, 1)
    return length * (2.5 * x**4 - 3 * x**5 + x**6) + jnp.where(t > length, t - length, 0)


def turned_angle(k, tau):
    """Sum of all turns, from whole samples and a short time."""
    total = 0.0
    for begin, length, steps, angle in TURNS:
        rate = angle * DEG * RATE_HZ / length
        since = (k - begin) / RATE_HZ + tau
        down = (k - begin - length) / RATE_HZ + tau
        total += rate * (ramp(steps / RATE_HZ, since) - ramp(steps / RATE_HZ, down))
    return total


def about(axis, angle):
    """Rotation about axis 0, 1 or 2, by Rodrigues' formula."""
    k = skew(np.eye(3)[axis])
    return jnp.eye(3) + jnp.sin(angle) * k + (1 - jnp.cos(angle)) * k @ k


def matrix(axis, k, tau):
    """C_b^n at a time after the beginning of sample k."""
    t = k / RATE_HZ + tau
    angles = SWING.center + SWING.amplitude * jnp.sin(2 * np.pi * t / SWING.period + SWING.phase)
    if axis == "path":
        row = jnp.asarray(SPLINE)[:, jnp.asarray(k // 5, int)]
        angles = angles + jnp.polyval(row, k % 5 / RATE_HZ + tau)
    pitch, roll, yaw = angles
    psi = turned_angle(k, tau)
    vertical, table = (psi if axis in (one, "both") else 0.0 for one in AXES[:2])
    return about(2, yaw + vertical) @ about(0, pitch) @ about(1, roll) @ about(2, table)


def from_matrix(matrix, tau):
    """Rate and force in b from the matrix alone: its derivatives, and the lever arm's path in n."""
    c, rate = jax.jvp(matrix, (tau,), (1.0,))
    path = lambda tau: matrix(tau) @ LEVER  # noqa: E731
    speed = lambda tau: jax.jvp(path, (tau,), (1.0,))[1]  # noqa: E731
    v, acceleration = jax.jvp(speed, (tau,), (1.0,))
    earth = jnp.array([0.0, HERE.rate_n, HERE.rate_u])
    east, north = v[0] * HERE.curvature_e, v[1] * HERE.curvature_n
    carried = jnp.stack([-north, east, east * HERE.tan_latitude])
    turning = c.T @ rate
    w = jnp.stack([turning[2, 1], turning[0, 2], turning[1, 0]]) + c.T @ (earth + carried)
    f = c.T @ (acceleration + jnp.cross(2 * earth, v) + jnp.array([0, 0, HERE.gravity]))
    return jnp.concatenate([w, f])


@partial(jax.jit, static_argnums=0)
def rates_and_forces(axis, k, taus):
    return jax.lax.map(partial(from_matrix, partial(matrix, axis, k)), taus)


def sampler(moving):
    ahead = base_motion.integration_nodes(moving, RATE_HZ)
    sense = jax.jit(partial(base_motion.ideal_sample, moving))
    return lambda k: np.concatenate(sense(ahead, HERE, RATE_HZ, float(k)).increments)


@pytest.mark.nightly(fast=("both",))
@pytest.mark.parametrize("axis", AXES)
def test_turned_base_matches_exact_integration_at_every_sample(axis):
    sense, taus = sampler(moved(axis)), (0.5 + 0.5 * NODES) / RATE_HZ
    for k in (*SAMPLES, *(() if axis == "path" else LATE)):
        made = sense(k) * RATE_HZ
        exact = 0.5 * WEIGHTS @ np.array(rates_and_forces(axis, float(k), taus))
        np.testing.assert_allclose(made[:3], exact[:3], rtol=0, atol=1e-8 * DEG_PER_H)
        np.testing.assert_allclose(made[3:], exact[3:], rtol=0, atol=1e-12)

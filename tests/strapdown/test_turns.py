"""Turns of the base against an attitude written down anew and differentiated by JAX."""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.in_engine import motion, place
from oracles.naive import DEG, WGS84, Swing, of_quaternion
from scipy.interpolate import CubicSpline

from sinsjax.strapdown import base_motion
from sinsjax.strapdown.attitude_path import attitude_path
from sinsjax.strapdown.turns import Turns
from sinsjax.types import Vec3
from sinsjax.units import DEG_PER_H

pytestmark = pytest.mark.optimised(False)

RATE_HZ = 100.0
LATITUDE = 45 * DEG
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


def as_turns(turns=TURNS):
    begin, length, ramp, angle = np.array(turns, float).T
    before = np.remainder(np.cumsum(angle) - angle, 360.0) * DEG
    times = (begin / RATE_HZ, length / RATE_HZ, ramp / RATE_HZ)
    return Turns(*times, angle * DEG / (length / RATE_HZ), before)


AXES = ("vertical", "table", "both")


def moved(axis):
    axes = AXES[:2] if axis == "both" else [axis]
    return motion(SWING)._replace(lever=Vec3(*LEVER), **{axis: as_turns() for axis in axes})


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
    sin, cos, one, zero = jnp.sin(angle), jnp.cos(angle), jnp.ones(()), jnp.zeros(())
    rows = {
        "x": [[one, zero, zero], [zero, cos, -sin], [zero, sin, cos]],
        "y": [[cos, zero, sin], [zero, one, zero], [-sin, zero, cos]],
        "z": [[cos, -sin, zero], [sin, cos, zero], [zero, zero, one]],
    }
    return jnp.stack([jnp.stack(row) for row in rows[axis]])


def matrix(axis, k, tau):
    """C_b^n at a time after the beginning of sample k."""
    t = k / RATE_HZ + tau
    pitch, roll, yaw = SWING.center + SWING.amplitude * jnp.sin(
        2 * np.pi * t / SWING.period + SWING.phase
    )
    psi = turned_angle(k, tau)
    vertical, table = (psi if axis in (one, "both") else 0.0 for one in AXES[:2])
    c = about("z", yaw + vertical) @ about("x", pitch) @ about("y", roll)
    return c @ about("z", table)


def vee(skew):
    return jnp.stack([skew[2, 1], skew[0, 2], skew[1, 0]])


@partial(jax.jit, static_argnums=0)
def rate_and_force(axis, k, tau):
    return from_matrix(partial(matrix, axis, k), tau)


@partial(jax.jit, static_argnums=0)
def rate_and_force_at_nodes(axis, k, taus):
    return jax.lax.map(partial(rate_and_force, axis, k), taus)


def from_matrix(matrix, tau):
    """Rate and force in b from the matrix alone: its derivatives, and the lever arm's path in n."""
    here = place(WGS84, LATITUDE)
    c, rate = jax.jvp(matrix, (tau,), (1.0,))
    path = lambda tau: matrix(tau) @ LEVER  # noqa: E731
    speed = lambda tau: jax.jvp(path, (tau,), (1.0,))[1]  # noqa: E731
    v, acceleration = jax.jvp(speed, (tau,), (1.0,))
    earth = jnp.array([0.0, here.rate_n, here.rate_u])
    carried = jnp.array([-v[1] * here.curvature_n, v[0] * here.curvature_e, 0.0])
    carried = carried.at[2].set(v[0] * here.curvature_e * here.tan_latitude)
    w = vee(c.T @ rate) + c.T @ (earth + carried)
    f = c.T @ (acceleration + jnp.cross(2 * earth, v) + jnp.array([0, 0, here.gravity]))
    return jnp.concatenate([w, f])


def exact_increment(axis, k):
    """Rate and force over a sample, integrated with 24 nodes."""
    taus = (0.5 + 0.5 * NODES) / RATE_HZ
    values = np.array(rate_and_force_at_nodes(axis, float(k), taus))
    return 0.5 * WEIGHTS @ values / RATE_HZ


@pytest.mark.nightly(fast=("both",))
@pytest.mark.parametrize("axis", AXES)
def test_turned_base_matches_exact_integration_at_every_sample(axis):
    sense = jax.jit(partial(base_motion.increment, moved(axis)))
    ahead = base_motion.integration_nodes(moved(axis), RATE_HZ)
    here = place(WGS84, LATITUDE)
    for k in (*SAMPLES, *LATE):
        made = sense(ahead, here, RATE_HZ, float(k))
        exact = exact_increment(axis, k) * RATE_HZ
        np.testing.assert_allclose(
            np.array(made.dtheta) * RATE_HZ, exact[:3], rtol=0, atol=1e-8 * DEG_PER_H
        )
        np.testing.assert_allclose(np.array(made.dv) * RATE_HZ, exact[3:], rtol=0, atol=1e-12)


@pytest.mark.nightly
@pytest.mark.parametrize("axis", AXES)
def test_attitude_rate_and_force_at_a_time_match_matrix(axis):
    moving = moved(axis)
    for k in (0, 70, 600, 1110, 1600, 200_000):
        t, tau = (k + 0.5) / RATE_HZ, 0.5 / RATE_HZ
        q = base_motion.attitude(moving, t)
        c = np.array(matrix(axis, float(k), tau))
        np.testing.assert_allclose(of_quaternion(np.array(q)), c, rtol=0, atol=1e-11)
        rate, force = base_motion.rate_and_force(moving, place(WGS84, LATITUDE), t)
        exact = rate_and_force(axis, float(k), tau)
        np.testing.assert_allclose(np.array(rate), exact[:3], rtol=0, atol=1e-11)
        np.testing.assert_allclose(np.array(force), exact[3:], rtol=0, atol=1e-10)


def test_many_turns_are_found_like_few():
    many = [(100 * n, 50, 20, 90.0 if n % 2 else -45.0) for n in range(100)]
    turns = as_turns(many)
    for n in (0, 1, 50, 99):
        few = turns._replace(**{f: getattr(turns, f)[n : n + 1] for f in turns._fields})
        for t in (n + 0.1, n + 0.35, n + 0.9):
            np.testing.assert_allclose(turns.at(t), few.at(t), rtol=0, atol=1e-12)


def test_lever_arm_from_axis_gives_centripetal_and_tangential_force():
    still = Swing(np.zeros(3), np.zeros(3), np.ones(3), np.zeros(3))
    turning = motion(still)._replace(lever=Vec3(0.2, 0.0, 0.0), vertical=as_turns())
    here = place(WGS84, LATITUDE)._replace(rate_n=0.0, rate_u=0.0)
    _, steady = base_motion.rate_and_force(turning, here, 5.0)
    rate = 18 * DEG
    np.testing.assert_allclose(steady[:2], [-0.2 * rate**2, 0.0], rtol=0, atol=1e-9)
    _, middle = base_motion.rate_and_force(turning, here, 0.7)  # of the ramp: half the rate
    peak = 30 / 16 * rate  # largest angular acceleration of a ramp of 1 s
    np.testing.assert_allclose(middle[:2], [-0.2 * rate**2 / 4, 0.2 * peak], rtol=0, atol=1e-9)


@pytest.mark.nightly
@pytest.mark.parametrize(("step_s", "limit_deg_per_h"), [(0.05, 1e-8), (0.033, 1e-6)])
def test_path_through_given_attitudes_matches_exact_integration(step_s, limit_deg_per_h):
    times = np.arange(0, 400 * step_s, step_s)
    angles = np.column_stack([3 * np.cos(times), 2 * np.sin(2 * times), 60 * np.sin(times)])
    spline = CubicSpline(times, np.radians(angles))
    still = Swing(np.zeros(3), np.zeros(3), np.ones(3), np.zeros(3))
    moving = motion(still)._replace(lever=Vec3(*LEVER), path=attitude_path(times, angles))
    sense = jax.jit(partial(base_motion.increment, moving))
    ahead = base_motion.integration_nodes(moving, RATE_HZ)

    @jax.jit
    def values(coefficients, s):
        def c(s):
            pitch, roll, yaw = jnp.polyval(coefficients, s)
            return about("z", yaw) @ about("x", pitch) @ about("y", roll)

        return from_matrix(c, s)

    for k in (0, 3, 10, 33, 66, 502, 1001):
        ends = np.array([k, k + 1]) / RATE_HZ
        inside = [t for t in times if ends[0] + 1e-12 < t < ends[1] - 1e-12]
        exact = np.zeros(6)
        for a, b in itertools.pairwise([ends[0], *inside, ends[1]]):
            knot = np.searchsorted(times, 0.5 * (a + b)) - 1
            for node, weight in zip(NODES, WEIGHTS, strict=True):
                s = 0.5 * (a + b) + 0.5 * (b - a) * node - times[knot]
                exact += 0.5 * (b - a) * weight * np.array(values(spline.c[:, knot], s))
        made = sense(ahead, place(WGS84, LATITUDE), RATE_HZ, float(k))
        error = np.abs(np.array(made.dtheta) - exact[:3]).max() * RATE_HZ / DEG_PER_H
        assert error < limit_deg_per_h, (k, error)
        np.testing.assert_allclose(np.array(made.dv), exact[3:], rtol=0, atol=1e-8)

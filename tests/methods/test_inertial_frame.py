"""Methods in the inertial frame against naive sums and closed forms."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.in_engine import (
    PAPER1,
    measured,
    navigation,
    place,
    runner,
    site,
    swing_increments,
)
from oracles.naive import DEG, PAPER, WGS84, compensate, exp, log, of_quaternion
from scipy.integrate import quad_vec
from scipy.spatial.transform import Rotation

from sinsjax.methods import least_squares
from sinsjax.methods.coarse import align_by_program
from sinsjax.methods.least_squares import dominant_eigenvector, reaction_velocity
from sinsjax.methods.method import Options
from sinsjax.methods.registry import METHODS
from sinsjax.strapdown import sensors
from sinsjax.units import ARCMIN

RATE, SECONDS, LATITUDE = 100, 60, 32 * DEG
SWING = PAPER1._replace(center=np.array([0.5, -0.3, 2.0]))
NAMES = ("optimisation", "optimisation_position", "inertial")


@pytest.mark.optimised(False)
@given(st.integers(0, 2**32 - 1), st.floats(-9, 0), st.floats(-3, 12), st.floats(0, 1e-7))
@settings(max_examples=100, deadline=None)
def test_dominant_eigenvector_is_accurate_for_close_eigenvalues(seed, gap, size, above):
    """To rounding, some 1e-16 over the gap, and what two iterations leave of the other two axes.

    An iteration reduces the share of a distant axis in the plane of both iterates, for either of
    the close ones by its own distance from the shift; the plane's error at the second tilts the
    first by its ratio to the gap.
    """
    rng, gap = np.random.default_rng(seed), 10**gap
    axes, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    k = axes * np.array([1.0, 1 - gap, -0.9, -1.1 + gap]) @ axes.T * 10**size
    triangle = tuple(jnp.asarray(entry) for entry in ((k + k.T) / 2)[np.triu_indices(4)])
    found = np.array(jax.jit(dominant_eigenvector)(triangle, jnp.asarray(10**size * (1 + above))))
    assert np.linalg.norm(found) == pytest.approx(1, rel=1e-14)
    off = axes[:, 0] * np.sign(axes[:, 0] @ found) - found
    near, distant = np.split(axes.T @ np.transpose(least_squares._STARTS), 2)
    first, second = np.linalg.norm(distant @ np.linalg.inv(near), axis=0)
    reach = 1 - max(-0.9, -1.1 + gap)
    first, second = first * (above / reach) ** 2, second * ((above + gap) / reach) ** 2
    assert np.linalg.norm(off) < 5e-14 + 5e-15 / gap + 2 * first * (1 + second * reach / gap)


@given(st.floats(0.01, 1e5), st.floats(-80, 80))
@settings(max_examples=30, deadline=None)
def test_reaction_velocity_matches_numerical_integral(t, latitude_deg):
    here = place(WGS84, latitude_deg * DEG)
    rate = np.array([0.0, here.rate_n, here.rate_u])
    expected, _ = quad_vec(
        lambda s: Rotation.from_rotvec(rate * s).apply([0.0, 0.0, here.gravity]), 0, t
    )
    found = np.array(reaction_velocity(here, jnp.asarray(t)))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * here.gravity * t)


def attitudes(name, rows, start=None):
    """Those after every second."""
    nav = navigation(np.eye(3) if start is None else start, np.zeros(2), LATITUDE)
    _, q, _ = runner(name)((), site(PAPER, LATITUDE), nav, rows)
    return of_quaternion(np.stack(q, axis=1)[RATE - 1 :: RATE])


def record():
    return measured(PAPER, LATITUDE, RATE * SECONDS)


@cache
def of_record(name):
    """`attitudes` over the record."""
    return attitudes(name, record())


@cache
def velocities():
    """Alpha and beta (n, 3) of the record after every sample, and C_b^{b0} there, in plain loops.

    Those of its first samples are those of a record of no more.
    """
    w_ie = np.array(PAPER.rates(LATITUDE, (0.0, 0.0))[0])
    theta, dvs = compensate(record())
    turns, dt = Rotation.from_rotvec(theta), 1 / RATE
    body, alpha = [np.eye(3)], [np.zeros(3)]
    beta, up = [np.zeros(3)], np.array([0.0, 0.0, PAPER.gravity])
    for k, (turn, dv) in enumerate(zip(turns.as_matrix(), dvs, strict=True)):
        alpha.append(alpha[-1] + body[-1] @ dv)
        # Simpson's rule over the sample.
        times = np.array([k, k + 0.5, k + 1]) * dt
        reaction = Rotation.from_rotvec(times[:, None] * w_ie).apply(up)
        beta.append(beta[-1] + dt / 6 * np.array([1, 4, 1]) @ reaction)
        body.append(body[-1] @ turn)
    return np.array(alpha[1:]), np.array(beta[1:]), body[1:]


def fitted(b, body, seconds):
    """SciPy's way to solve Wahba's problem, by singular values, and the attitude then."""
    w_ie = np.array(PAPER.rates(LATITUDE, (0.0, 0.0))[0])
    left, _, right = np.linalg.svd(b)
    n0 = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    return exp(-w_ie * seconds) @ n0 @ body


@pytest.mark.nightly
@pytest.mark.parametrize("seconds", [20, 40, 60])
def test_optimisation_matches_least_squares_fit_of_velocities(seconds):
    n = seconds * RATE
    alpha, beta, body = (of[:n] for of in velocities())
    found = of_record("optimisation")[seconds - 1]
    expected = fitted(beta.T @ alpha, body[-1], seconds)
    assert np.abs(log(expected @ found.T)).max() < 1e-3 * ARCMIN


@pytest.mark.nightly
@pytest.mark.parametrize("seconds", [20, 40, 60])
def test_position_optimisation_leaves_initial_velocity_free(seconds):
    """The residuals of their sums on the time, by least squares, fit best."""
    n = seconds * RATE
    alpha, beta, body = (of[:n] for of in velocities())
    t = np.arange(1.0, n + 1)[:, None] / RATE
    a, b = (
        one - t @ np.linalg.lstsq(t, one)[0]
        for one in (np.cumsum(each, axis=0) / RATE for each in (alpha, beta))
    )
    found = of_record("optimisation_position")[seconds - 1]
    assert np.abs(log(fitted(b.T @ a, body[-1], seconds) @ found.T)).max() < 1e-2 * ARCMIN


@pytest.mark.nightly(fast=("inertial-10",))
@pytest.mark.optimised(False)
@pytest.mark.parametrize(
    ("name", "seconds"), [("inertial", 1), ("inertial", 10), ("optimisation", SECONDS)]
)
def test_coarse_alignment_is_that_of_its_method(name, seconds):
    rows = record()[: seconds * RATE]
    samples = jax.jit(sensors.compensate_record)(rows, rows[0])
    program = METHODS[name].build(Options(1 / RATE))
    q = jax.jit(lambda s: align_by_program(program, s, site(PAPER, LATITUDE)))(samples)
    turn = log(of_quaternion(np.array(q)) @ attitudes(name, rows)[-1].T)
    assert np.abs(turn).max() < 1e-9


@pytest.mark.nightly
@pytest.mark.parametrize("name", NAMES)
def test_error_free_attitude_is_found_within_one_minute(name):
    rows = swing_increments(SWING, PAPER, LATITUDE, rate=RATE, samples=RATE * SECONDS)
    found = attitudes(name, rows)
    assert np.abs(log(SWING.matrix(SECONDS) @ found[-1].T)).max() < 0.05 * ARCMIN

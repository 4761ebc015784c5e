"""Methods in the inertial frame against naive sums, coarse alignment and closed forms."""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.in_engine import follow, measured, place, shown, site
from oracles.naive import DEG, PAPER, WGS84, compensate, exp, log, of_quaternion
from scipy.integrate import quad_vec
from scipy.spatial.transform import Rotation

from sinsjax.methods.inertial_frame import reaction_velocity
from sinsjax.methods.method import Options
from sinsjax.units import ARCMIN

RATE, SECONDS, LATITUDE = 100, 60, 32 * DEG
W_IE = np.array(PAPER.rates(LATITUDE, (0.0, 0.0))[0])


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


@cache
def attitudes(name, seconds=SECONDS):
    """Those after every second of the record."""
    rows, start = record()[: seconds * RATE], (np.eye(3), np.zeros(3), np.zeros(2))
    options, here = Options(1 / RATE), site(PAPER, LATITUDE)
    state = follow(name, (), rows, here, start, options=options, records=len(rows))
    q, _ = shown(name, options, state)
    return of_quaternion(np.stack(q, axis=1)[RATE - 1 :: RATE])


def record():
    return measured(PAPER, LATITUDE, RATE * SECONDS)


@cache
def velocities():
    """Alpha and beta (n, 3) of the record after every sample, and C_b^{b0} there, in plain loops.

    Those of its first samples are those of a record of no more.
    """
    theta, dvs = compensate(record())
    turns, dt = Rotation.from_rotvec(theta), 1 / RATE
    body, alpha = [np.eye(3)], [np.zeros(3)]
    beta, up = [np.zeros(3)], np.array([0.0, 0.0, PAPER.gravity])
    for k, (turn, dv) in enumerate(zip(turns.as_matrix(), dvs, strict=True)):
        alpha.append(alpha[-1] + body[-1] @ dv)
        # Simpson's rule over the sample.
        times = np.array([k, k + 0.5, k + 1]) * dt
        reaction = Rotation.from_rotvec(times[:, None] * W_IE).apply(up)
        beta.append(beta[-1] + dt / 6 * np.array([1, 4, 1]) @ reaction)
        body.append(body[-1] @ turn)
    return np.array(alpha[1:]), np.array(beta[1:]), body[1:]


@pytest.mark.nightly
@pytest.mark.parametrize("seconds", [20, 40, 60])
@pytest.mark.parametrize(
    ("name", "arcmin"), [("optimisation", 1e-3), ("optimisation_position", 1e-2)]
)
def test_optimisation_matches_least_squares_fit_of_velocities(name, arcmin, seconds):
    """Or of their sums less a slope in time, which leaves the initial velocity free."""
    n = seconds * RATE
    alpha, beta, body = (of[:n] for of in velocities())
    if name == "optimisation_position":
        t = np.arange(1.0, n + 1)[:, None] / RATE
        alpha, beta = (
            one - t @ np.linalg.lstsq(t, one)[0]
            for one in (np.cumsum(each, axis=0) / RATE for each in (alpha, beta))
        )
    # SciPy's way to solve Wahba's problem, by singular values, and the attitude then.
    left, _, right = np.linalg.svd(beta.T @ alpha)
    n0 = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    expected = exp(-W_IE * seconds) @ n0 @ body[-1]
    assert np.abs(log(expected @ attitudes(name)[seconds - 1].T)).max() < arcmin * ARCMIN

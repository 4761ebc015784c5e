from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.in_engine import PAPER1, PAPER2, motion, navigation, place
from oracles.naive import DEG, PAPER, WGS84, Planet, exp, log, of_quaternion, skew
from scipy.integrate import quad_vec, solve_ivp

from sinsjax.maths import rotations
from sinsjax.strapdown import base_motion, earth, mechanisation, sensors
from sinsjax.types import Navigation

pytestmark = pytest.mark.optimised(False)

ARCSEC = DEG / 3600
TILTED = PAPER1._replace(center=np.array([0.3, -0.2, 2.5]), phase=np.array([1.0, -2.0, 3.0]))


@partial(jax.jit, static_argnames=("rate", "seconds"))
def free_run(swing, here, *, rate, seconds):
    """Angle (rad) and speed (m/s) off truth every second of a run without errors from the truth."""
    rows = base_motion.ideal_increments(swing, here, rate * 1.0, rate * seconds)
    samples = sensors.compensate_record(rows, rows[0])
    zero = jnp.zeros(())

    def one_second(nav, xs):
        def step(nav, sample):
            return mechanisation.advance_navigation(nav, sample, here, 1 / rate)[0], None

        t, block = xs
        nav, _ = jax.lax.scan(step, nav, block)
        nav = nav._replace(q=rotations.normalise(nav.q))
        phi = jnp.stack(rotations.misalignment(base_motion.attitude(swing, t), nav.q))
        return nav, (jnp.linalg.norm(phi), jnp.hypot(nav.ve, nav.vn))

    start = Navigation(base_motion.attitude(swing, 0.0), zero, zero, zero, zero)
    blocks = jax.tree.map(lambda a: a.reshape(seconds, rate), samples)
    return jax.lax.scan(one_second, start, (1.0 + jnp.arange(1.0 * seconds), blocks))[1]


@pytest.mark.parametrize(
    ("swing", "planet", "latitude_deg", "rate", "seconds"),
    [
        (TILTED, WGS84, -71.0, 100, 60),
        pytest.param(PAPER1, PAPER, 32.0, 100, 900, marks=pytest.mark.nightly),
        pytest.param(PAPER2, WGS84, 32.057313, 200, 600, marks=pytest.mark.nightly),
    ],
)
def test_error_free_runs_stay_at_truth(swing, planet, latitude_deg, rate, seconds):
    """The requirement is 0.01 arcsec and 1e-5 m/s."""
    here = place(planet, latitude_deg * DEG)
    angle, speed = free_run(motion(swing), here, rate=rate, seconds=seconds)
    assert len(angle) == seconds
    assert max(angle) < 1e-4 * ARCSEC
    assert max(speed) < 1e-6


def body(t):
    """w_ib^b (rad/s) and f^b (m/s^2) of a vehicle under way."""
    rate = 0.02 * np.cos(t), 0.03 * np.sin(0.7 * t), 0.01 + 0.05 * np.cos(0.3 * t)
    force = 0.3 * np.sin(0.5 * t), 0.2 * np.cos(0.4 * t), 9.8 + 0.1 * np.sin(t)
    return np.array([*rate, *force])


def exact_flight(planet, start, v, latitude, seconds, *, moves):
    """Attitude, velocity and position by DOP853, VU = 0; without ``moves`` the Earth stays."""

    def slope(t, y):
        c, velocity, here = y[:9].reshape(3, 3), y[9:11], y[11] if moves else latitude
        w_ie, w_en = planet.rates(here, velocity)
        rm, rn = planet.radii(here)
        turn = c @ skew(body(t)[:3]) - skew(w_ie + w_en) @ c
        acceleration = c @ body(t)[3:] - np.cross(2 * w_ie + w_en, [*velocity, 0.0])
        travel = velocity[1] / rm, velocity[0] / (rn * np.cos(here))
        return np.concatenate([turn.ravel(), acceleration[:2], travel])

    y0 = np.concatenate([start.ravel(), v, [latitude, 0.0]])
    y = solve_ivp(slope, (0, seconds), y0, method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    return y[:9].reshape(3, 3), y[9:11], y[11:]


@pytest.fixture(scope="module")
def flight_increments():
    """Increments of the vehicle under way for 20 s, at 100 and 200 Hz."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    out = {}
    for rate in (100, 200):
        times = (np.arange(20 * rate)[:, None] + (nodes + 1) / 2) / rate
        out[rate] = np.einsum("q,ckq->kc", weights / (2 * rate), body(times))
    return out


def flight(rows, rate, start, v, planet, latitude, *, moves):
    """The engine's attitude, velocity and position at the end of the flight."""
    here = place(planet, latitude)
    model = earth.wgs84() if planet is WGS84 else earth.sphere(planet.rate, planet.a, 9.8)

    @jax.jit
    def fly(nav, samples):
        def step(nav, sample):
            now = earth.place(model, nav.latitude) if moves else here
            nav, _ = mechanisation.advance_navigation(nav, sample, now, 1 / rate)
            return mechanisation.advance_position(nav, now, 1 / rate), None

        return jax.lax.scan(step, nav, samples)[0]

    # The sample before the first is known here.
    before = quad_vec(body, -1 / rate, 0, epsabs=1e-16)[0]
    nav = fly(navigation(start, v, latitude), sensors.compensate_record(rows, before))
    c = of_quaternion(rotations.normalise(nav.q))
    return c, np.array([nav.ve, nav.vn]), np.array([nav.latitude, nav.longitude])


# An Earth that turns a hundred times faster makes the order of the Coriolis terms visible.
FAST = Planet(7.292115e-3, 6378137.0, 6378137.0, 9.8)


@pytest.mark.nightly(fast=("planet0-57.0-False", "planet2-40.0-True"))
@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize(("planet", "latitude_deg"), [(WGS84, 57.0), (PAPER, -32.0), (FAST, 40.0)])
def test_moving_vehicle_navigation_matches_ode_integration(
    flight_increments, planet, latitude_deg, moves
):
    start, v, latitude = exp([0.2, -0.1, 2.0]), np.array([220.0, -170.0]), latitude_deg * DEG
    c, velocity, position = exact_flight(planet, start, v, latitude, 20.0, moves=moves)
    off = {}
    for rate, rows in flight_increments.items():
        turned, *moved = flight(rows, rate, start, v, planet, latitude, moves=moves)
        off[rate] = log(turned @ c.T), moved[0] - velocity, moved[1] - position
    # A step takes the rates at its start, so it is off by half their change: first order in dt,
    # which two sample times extrapolate away. Coriolis alone is 0.5 m/s here (50 m/s on the fast
    # Earth), transport rate 7e-4 rad, the way 8e-4 rad.
    turning = planet.rate / WGS84.rate
    for coarse, fine, bound in zip(off[100], off[200], (1e-7, 5e-5 * turning, 1e-7), strict=True):
        assert np.linalg.norm(coarse) < bound
        assert np.linalg.norm(2 * fine - coarse) < 0.01 * bound

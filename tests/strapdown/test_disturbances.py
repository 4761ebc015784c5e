"""What disturbs base and sensors, against free navigation, which knows nothing of it."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.in_engine import PAPER1, PAPER2, motion, place
from oracles.naive import DEG, PAPER, WGS84
from scipy.spatial.transform import Rotation

from sinsjax.maths import rotations
from sinsjax.strapdown import base_motion, disturbances, mechanisation, processes, sensors
from sinsjax.strapdown.disturbances import Disturbances, SampleDisturbance
from sinsjax.types import Increments, Navigation, Vec3

pytestmark = pytest.mark.optimised(False)

LEVER = Vec3(*np.array([1.2, -0.7, 2.0]))


def with_lever(swing):
    return motion(swing)._replace(lever=LEVER)


def position(moving, t):
    """Of the sensors from the centre of the sway, in n."""
    return jnp.stack(rotations.rotate(base_motion.attitude(moving, t), moving.lever))


VELOCITY = jax.jit(jax.vmap(jax.jacfwd(position, argnums=1), in_axes=(None, 0)))
ACCELERATION = jax.jit(jax.jacfwd(jax.jacfwd(position, argnums=1), argnums=1))


@pytest.mark.nightly
@pytest.mark.parametrize(("swing", "planet"), [(PAPER1, PAPER), (PAPER2, WGS84)])
def test_lever_arm_force_matches_second_derivative_of_position(swing, planet):
    here, moving, t = place(planet, 0.6), with_lever(swing), 3.21
    rate, force = base_motion.rate_and_force(moving, here, t)
    rate0, force0 = base_motion.rate_and_force(motion(swing), here, t)
    to_b = np.asarray(
        Rotation.from_quat(base_motion.attitude(moving, t), scalar_first=True).as_matrix()
    ).T
    v, a = np.asarray(VELOCITY(moving, np.array([t])))[0], np.asarray(ACCELERATION(moving, t))
    earth = np.array([0.0, here.rate_n, here.rate_u])
    np.testing.assert_allclose(
        np.subtract(force, force0), to_b @ (a + np.cross(2 * earth, v)), atol=1e-12
    )
    over = [-v[1] * here.curvature_n, v[0] * here.curvature_e]
    over = to_b @ [*over, over[1] * here.tan_latitude]
    np.testing.assert_allclose(np.subtract(rate, rate0), over, rtol=0, atol=1e-15)


@partial(jax.jit, static_argnums=(4, 5))
def navigated(rows, q, v, here, rate, seconds):
    """Velocity and attitude every second of free navigation, without errors, from the truth."""
    samples = sensors.compensate_record(rows, rows[0])
    samples = jax.tree.map(lambda a: a.reshape(seconds, rate), samples)
    zero = jnp.zeros(())

    def one_second(nav, block):
        def step(nav, sample):
            return mechanisation.advance_navigation(nav, sample, here, 1 / rate)[0], None

        nav = jax.lax.scan(step, nav, block)[0]
        return nav, (jnp.stack([nav.ve, nav.vn]), nav.q)

    return jax.lax.scan(one_second, Navigation(q, v[0], v[1], zero, zero), samples)[1]


@pytest.mark.nightly
def test_free_navigation_follows_lever_arm_motion():
    """60 s at 200 Hz: 5e-5 m/s of 0.1 m/s, and 0.1 arcsec."""
    here, moving, rate, seconds = place(PAPER, 32 * DEG), with_lever(PAPER1), 200, 60
    rows = base_motion.ideal_increments(moving, here, rate * 1.0, rate * seconds)
    times = np.arange(seconds + 1.0)
    truth = np.asarray(VELOCITY(moving, times))[:, :2]
    q0 = base_motion.attitude(moving, 0.0)
    velocity, q = navigated(rows, q0, jnp.asarray(truth[0]), here, rate, seconds)
    assert np.abs(truth).max() > 0.09
    np.testing.assert_allclose(velocity, truth[1:], rtol=0, atol=5e-5)
    q_true = jax.vmap(partial(base_motion.attitude, moving))(jnp.asarray(times[1:]))
    off = jax.vmap(rotations.misalignment)(q_true, q)
    assert np.abs(np.stack(off)).max() < 0.1 * DEG / 3600


def surging(rate, seconds, model):
    # Level: the mechanisation takes the vertical velocity for zero.
    numbers = np.array([0.1, 0.1, 0.0]), np.asarray(5.0)
    if model == "gauss_markov":
        surge = processes.gauss_markov_process(*numbers, 1 / rate)
    else:
        surge = processes.bounded_velocity_process(*numbers, np.asarray(1.0), 1 / rate)
    here, them, moving = place(WGS84, 0.6), Disturbances(surge=surge), motion(PAPER1)
    ahead = base_motion.integration_nodes(moving, rate * 1.0)

    @jax.jit
    def run(draw):
        states = disturbances.initial_states(them, np.asarray(1), draw)
        driven = disturbances.driving_noise(them, np.asarray(1), draw, jnp.arange(rate * seconds))

        def step(states, one):
            k, driven = one
            states, now = disturbances.advance_processes(them, states, driven, 1 / rate)
            exact = base_motion.ideal_sample(moving, ahead, here, rate * 1.0, k)
            made = disturbances.disturb_motion(exact, now, here, 1 / rate)
            return states, (jnp.stack(jax.tree.leaves(made)), jnp.stack([*now.before, *now.after]))

        numbers = jnp.arange(rate * seconds * 1.0)
        return jax.lax.scan(step, states, (numbers, driven))[1]

    return here, moving, *map(np.asarray, run(np.asarray(5)))


@pytest.mark.nightly
@pytest.mark.parametrize("model", ["third_order", "gauss_markov"])
def test_free_navigation_follows_surge_velocity(model):
    """Sway and surge together, 60 s at 200 Hz: 5e-5 m/s of 0.3 m/s, and 0.1 arcsec."""
    rate, seconds = 200, 60
    here, moving, rows, speeds = surging(rate, seconds, model)
    np.testing.assert_array_equal(speeds[1:, :3], speeds[:-1, 3:])
    q0 = base_motion.attitude(moving, 0.0)
    first = jnp.asarray(speeds[0, :2])
    velocity, q = navigated(jnp.asarray(rows), q0, first, here, rate, seconds)
    truth = speeds[rate - 1 :: rate, 3:5]
    assert np.abs(truth).max() > 0.15
    np.testing.assert_allclose(velocity, truth, rtol=0, atol=5e-5)
    times = 1.0 + jnp.arange(seconds * 1.0)
    q_true = jax.vmap(partial(base_motion.attitude, moving))(times)
    off = jax.vmap(rotations.misalignment)(q_true, q)
    assert np.abs(np.stack(off)).max() < 0.1 * DEG / 3600


@pytest.mark.optimised(True)
def test_drift_is_added_to_matching_increments():
    """Every part goes where it belongs, and what there is not costs no sum."""
    three = [Vec3(*np.arange(3.0) + i) for i in range(3)]
    still = base_motion.IdealSample(Increments(three[0], three[1]), None)
    drifting = SampleDisturbance(None, None, None, None, three[2])
    drifted = disturbances.add_drifts(still.increments, drifting)
    assert drifted.dtheta is three[0]
    np.testing.assert_array_equal(drifted.dv, np.add(three[1], three[2]))
    states, none = disturbances.advance_processes(
        Disturbances(), Disturbances(), Disturbances(), 0.1
    )
    assert not any(jax.tree.leaves((states, none)))


def test_quantised_increment_sums_stay_within_half_quantum():
    """Sums of quantised increments are those of the exact ones to half a quantum."""
    rows = np.random.default_rng(1).normal(size=(500, 6)) * 3e-6
    errors = sensors.error_free_sensors()._replace(
        gyro_quantum=np.array([1e-6, 2e-6, 0.0]), accel_quantum=np.array([5e-6, 0.0, 1e-7])
    )
    zero = Vec3(*(jnp.zeros(()) for _ in range(3)))

    def step(left, row):
        out, left = sensors.quantise(sensors.split_record_row(row), errors, left)
        return left, jnp.stack(jax.tree.leaves(out))

    out = np.asarray(jax.lax.scan(step, Increments(zero, zero), jnp.asarray(rows))[1])
    quanta = np.array([1e-6, 2e-6, 0, 5e-6, 0, 1e-7])
    off = np.abs(np.cumsum(out, 0) - np.cumsum(rows, 0)).max(0)
    assert (off <= quanta / 2 + 1e-15).all() and (off[quanta > 0] > quanta[quanta > 0] / 4).all()
    some = quanta > 0
    counts = out[:, some] / quanta[some]
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)

"""Coarse alignment: exact without errors, as good as theory says with them, sound on a record."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sinsjax.engine.inputs import align_by_program
from sinsjax.maths import rotations
from sinsjax.methods.method import Options, Site
from sinsjax.methods.registry import METHODS
from sinsjax.strapdown import base_motion, earth, sensors
from sinsjax.strapdown.base_motion import Motion, Sway
from sinsjax.strapdown.earth import Place
from sinsjax.types import Array, Quat, Sample
from sinsjax.units import ARCSEC, DEG, DEG_PER_H, MICRO

pytestmark = pytest.mark.optimised(False)

RATE = 100.0
DT = 1 / RATE
SECONDS = 23  # no whole number of any sway period below
GYRO, ACCEL = slice(0, 3), slice(3, 6)

latitudes = st.floats(-75, 75)
turns = st.floats(-180, 180)
pitches = st.floats(-80, 80)
some = settings(max_examples=40, deadline=None)


def swinging(amplitude, pitch=0.0, roll=0.0, yaw=0.0) -> Motion:
    """Angles in degrees; [P1]'s periods."""
    sways = ((pitch, 6.0, 0.3), (roll, 8.0, 1.1), (yaw, 10.0, 2.0))
    return Motion(*(Sway(c * DEG, amplitude * DEG, period, phase) for c, period, phase in sways))


def at(latitude_deg) -> Place:
    return earth.place(earth.wgs84(), latitude_deg * DEG)


def coarse(samples: Sample, place: Place, dt: float) -> Quat:
    """Attitude at the end of samples."""
    program = METHODS["inertial"].build(Options(dt))
    return align_by_program(program, samples, Site(earth.wgs84(), place, 0.0))


@functools.partial(jax.jit, static_argnames="seconds")
def ideal(motion: Motion, place: Place, seconds: int = SECONDS) -> Array:
    """Increments of one sample that goes before, and of the interval."""
    return base_motion.ideal_increments(motion, place, RATE, round(seconds * RATE) + 1)


@jax.jit
def error(increments: Array, place: Place, truth: Quat) -> Array:
    """Misalignment (rad) of the coarse attitude after the last increment."""
    samples = sensors.compensate_record(increments[1:], increments[0])
    return jnp.stack(rotations.misalignment(truth, coarse(samples, place, DT)))


def end(motion: Motion, increments: Array) -> Quat:
    return base_motion.attitude(motion, len(increments) * DT)


@some
@given(latitudes, pitches, turns, turns)
@example(-33.0, 0.0, 0.0, 180.0)
@example(48.0, 0.0, 180.0, 0.0)
@example(48.0, 0.0, 180.0, 180.0)
def test_coarse_alignment_is_exact_on_static_base(latitude, pitch, roll, yaw):
    motion, place = swinging(0.0, pitch, roll, yaw), at(latitude)
    increments = ideal(motion, place)
    east, north, up = error(increments, place, end(motion, increments))
    # A rounding of the horizontal Earth rate turns the heading the more, the less there is.
    np.testing.assert_allclose([east, north, up * np.cos(latitude * DEG)], 0, atol=1e-10)


@some
@given(latitudes, st.floats(-40, 40), st.floats(-40, 40), turns)
def test_inertial_is_exact_at_interval_end_on_swinging_base(latitude, pitch, roll, yaw):
    motion, place = swinging(2.0, pitch, roll, yaw), at(latitude)
    increments = ideal(motion, place)
    phi = error(increments, place, end(motion, increments))
    np.testing.assert_allclose(phi, 0, atol=0.1 * ARCSEC)


def test_constant_biases_leave_known_bias_floors():
    yaw, latitude = 40.0, 32.0
    motion, place = swinging(0.0, yaw=yaw), at(latitude)
    increments = ideal(motion, place)
    c_nb = Rotation.from_euler("Z", yaw, degrees=True).as_matrix()
    eps, nabla = np.array([0.01, -0.02, 0.03]) * DEG_PER_H, np.array([30.0, 50.0, -40.0]) * MICRO
    biased = increments.at[:, GYRO].add(c_nb.T @ eps * DT)
    biased = biased.at[:, ACCEL].add(c_nb.T @ nabla * place.gravity * DT)
    phi = error(biased, place, end(motion, increments))
    phi_u = -eps[0] / place.rate_n + nabla[0] * np.tan(latitude * DEG)
    expected = [-nabla[1], nabla[0] - eps[1] * SECONDS / 2, phi_u]
    np.testing.assert_allclose(phi, expected, rtol=0.01)


def velocity_fit(samples: Sample, place: Place) -> Rotation:
    """Attitude at the end from all velocities, each less their mean: Wahba's problem in SciPy."""
    attitude = [Rotation.identity()]  # of b against b at the start
    for turn in Rotation.from_quat(np.stack(samples.turn, axis=1), scalar_first=True):
        attitude.append(attitude[-1] * turn)
    felt = Rotation.concatenate(attitude[:-1]).apply(np.stack(samples.dv, axis=1))
    n, rate = len(felt), np.array([0.0, place.rate_n, place.rate_u])
    times = (np.arange(n) + 0.5) * DT
    known = Rotation.from_rotvec(times[:, None] * rate).apply([0, 0, float(place.gravity) * DT])
    known_v, felt_v = (np.cumsum(dv, axis=0) for dv in (known, felt))
    start, _ = Rotation.align_vectors(known_v - known_v.mean(axis=0), felt_v - felt_v.mean(axis=0))
    return Rotation.from_rotvec(-n * DT * rate) * start * attitude[-1]


def test_inertial_matches_least_squares_velocity_fit_with_unknown_start():
    motion, place, force = swinging(2.0, yaw=-50.0), at(32.0), 100 * MICRO
    noise = np.random.default_rng(3).normal(size=(SECONDS * int(RATE) + 1, 3))
    increments = ideal(motion, place).at[:, ACCEL].add(noise * force * place.gravity * DT)
    truth = end(motion, increments)
    samples = jax.jit(sensors.compensate_record)(increments[1:], increments[0])
    fit = Quat(*velocity_fit(samples, place).as_quat(scalar_first=True))
    expected = jnp.stack(rotations.misalignment(truth, fit))
    limit = float(np.sqrt(30 / 7 / (SECONDS * RATE)) * 2 * force / SECONDS / place.rate_n)
    assert abs(expected[2]) > 0.1 * limit
    np.testing.assert_allclose(error(increments, place, truth), expected, atol=0.005 * limit)

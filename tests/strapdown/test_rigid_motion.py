"""Every motion of [motion] is that of one rigid body, whose increments give the truth.

Noise-free increments are navigated by NumPy alone (`oracles.rigid_body`), from the true start.
"""

from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import rigid_body
from oracles.in_engine import PAPER1, motion, place
from oracles.naive import DEG, WGS84
from oracles.rigid_body import multiply, of_vector, rotate

from sinsjax.strapdown import base_motion, disturbances, housing, processes
from sinsjax.strapdown.base_motion import attitude_path
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.strapdown.turns import Turns
from sinsjax.types import Increments, Vec3
from sinsjax.units import micro_g

RATE_HZ, DT = 100.0, 0.01
SEED, DRAW = np.asarray(1), np.asarray(3)
HERE = place(WGS84, 45 * DEG)
ANGLE, VELOCITY = 0.01 / 60 * DEG, 1e-4
"""Largest errors after 900 s, rad and m/s."""

CASES = [*product(*[(0, 1)] * 6, (0, 1, 2))]
"""Sway, lever, surge, shaking, rocking and path off or on; no turns, vertical, or a turntable."""


def base_of(case: np.ndarray) -> base_motion.Motion:
    """The base of a case: paper 1's sway, slow and fast turns, and a swing given as a path."""
    sway, lever, _, _, _, path, turn = case
    center, phase = np.array([2.0, -3.0, 30.0]) * DEG, np.array([20.0, 50.0, 80.0]) * DEG
    swing = PAPER1._replace(center=center, phase=phase, amplitude=sway * PAPER1.amplitude)

    def turns(acts: np.ndarray) -> Turns:
        begin, length, rate = np.array([5.0, 40.0]), np.array([18.0, 3.0]), np.array([10.0, -30.0])
        before = np.array([0.0, 180.0]) * DEG
        return Turns(begin, length, np.ones(2), acts * rate * DEG, acts * before)

    knots = np.arange(0.0, 920.0, 2.5)
    added = np.stack([np.sin(knots / k + k) for k in (4.0, 7.0, 9.0)], axis=1)
    return motion(swing)._replace(
        lever=Vec3(*(lever * np.array([2.0, 1.0, -1.5]))),
        vertical=turns(1.0 * (turn == 1)),
        table=turns(1.0 * (turn == 2)),
        path=attitude_path(knots, path * added * np.array([1.0, 1.5, 4.0])),
    )


def disturbances_of(case: np.ndarray) -> Disturbances:
    """Surge of 0.1 m/s; vibration of 5,000 ug and 5 deg/s at 30 Hz; less on two axes."""
    _, _, surge, shaking, rocking, _, _ = case
    omega, axes = 2 * np.pi * 30.0, np.array([1.0, 0.5, 0.8])
    vibration = partial(processes.resonance_process, frequency_hz=30.0, damping=0.05, dt=DT)
    return Disturbances(
        surge=processes.velocity_of_bounded_position(surge * 0.1 * axes, 5.0, 1.0, DT),
        shaking=vibration(shaking * 5000 * micro_g(9.8) / omega * axes),
        rocking=vibration(5 * DEG / omega * axes) if rocking else None,
    )


@partial(jax.jit, static_argnums=2)
def simulate(base, them, samples):
    """Increments (samples, 6), and surge, angle, rate and velocity of the housing at their ends."""
    ahead, zero = base_motion.integration_nodes(base, RATE_HZ), jnp.zeros(())
    none = Increments(Vec3(zero, zero, zero), Vec3(zero, zero, zero))

    def moving(states):
        now = disturbances.housing_motion(them, states)
        surge = processes.process_output(them.surge, states.surge)
        return now, jnp.stack([jnp.stack(none.dv if a is None else a) for a in (surge, *now)])

    begin = disturbances.initial_states(them, SEED, DRAW)
    now, first = moving(begin)
    rate = base_motion.rate_and_force(base, HERE, zero)[0]
    lever = base.lever if now.angle is not None else None
    state = housing.start_housing(now, lever, rate, none)

    def step(carry, inputs):
        (states, state), (driven, ideal) = carry, inputs
        states, disturbed = disturbances.advance_processes(them, states, driven, DT)
        rigid = ideal._replace(increments=disturbances.add_surge(ideal, disturbed, HERE, DT))
        state, made = housing.vibrate_housing(state, rigid, disturbed.housing, lever, HERE, DT)
        return (states, state), (jnp.stack(jax.tree.leaves(made)), moving(states)[1])

    numbers = jnp.arange(samples)
    sense = partial(base_motion.ideal_sample, base, ahead, HERE, RATE_HZ)
    ideals = jax.lax.map(sense, numbers.astype(float), batch_size=1000)
    driven = disturbances.driving_noise(them, SEED, DRAW, numbers)
    _, (rows, later) = jax.lax.scan(step, (begin, state), (driven, ideals))
    return rows, jnp.concatenate([first[None], later])


base_attitudes = jax.jit(jax.vmap(base_motion.attitude, in_axes=(None, 0)))


def truth(base, moving, samples):
    """Attitude (4, n + 1) and velocity (3, n + 1) of the housing, by differences in time."""
    times, h = np.arange(samples + 1) * DT, 1e-4
    surge, angle, rate, velocity = moving.transpose(1, 2, 0)
    lever = np.array(base.lever)[:, None]
    at, later, earlier = (np.stack(base_attitudes(base, times + d)) for d in (0.0, h, -h))

    def on_base(a):
        return rotate(of_vector(a), lever + 0 * a)

    carried = rotate(later, on_base(angle)) - rotate(earlier, on_base(angle))
    swung = (on_base(angle + 1e-6 * rate) - on_base(angle - 1e-6 * rate)) / 2e-6
    v = surge + carried / (2 * h) + rotate(at, swung + velocity)
    return multiply(at, of_vector(angle)), v


def errors(cases, samples):
    """Largest errors of attitude, rad, and velocity, m/s, of some cases."""
    cases = np.asarray(cases, float)
    bases, them = (
        jax.tree.map(lambda *leaves: np.stack(leaves), *map(make, cases))
        for make in (base_of, disturbances_of)
    )
    made = jax.vmap(simulate, in_axes=(0, 0, None))(bases, them, samples)
    for number in range(len(cases)):
        base = jax.tree.map(lambda a, i=number: a[i], bases)
        rows, moving = (np.asarray(a[number]) for a in made)
        q_true, v_true = truth(base, moving, samples)
        q, v = rigid_body.navigate(rows, q_true[:, 0], v_true, HERE, DT)
        yield rigid_body.angle_between(q, q_true[:, 1:]).max(), np.abs(v - v_true[:, 1:]).max()


@pytest.mark.nightly
@pytest.mark.parametrize("rocks", [0, 1])
def test_increments_of_all_combinations_give_the_truth_over_a_minute(rocks) -> None:
    """Angles within a fifteenth of what 900 s may have, velocities within a fifth.

    The velocity of a lever arm lags by half a sample in the ramp of a fast turn, 9e-6 m/s.
    """
    cases = [case for case in CASES if case[4] == rocks]
    found = zip(cases, errors(cases, 6000), strict=True)
    beyond = {case: e for case, e in found if e[0] > ANGLE / 15 or e[1] > VELOCITY / 5}
    assert beyond == {}


@pytest.mark.parametrize("case", [(1,) * 7, (1,) * 6 + (2,), (1, 1) + (0,) * 5], ids=str)
def test_increments_give_the_truth_over_900_s(case) -> None:
    ((angle, velocity),) = errors([case], 90_000)
    assert angle < ANGLE and velocity < VELOCITY, (angle, velocity)

"""Every motion of [motion] is that of one rigid body, whose increments give the truth.

Noise-free increments are navigated by NumPy alone (`oracles.rigid_body`), from the true start.
"""

from functools import partial
from itertools import product
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.compute as pc
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest
from oracles import rigid_body
from oracles.in_engine import place
from oracles.naive import DEG, WGS84, compensate, euler_matrix, quaternion

import sinsjax
from sinsjax.strapdown import base_motion, disturbances, housing, processes
from sinsjax.strapdown.attitude_path import attitude_path
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.strapdown.turns import Turns
from sinsjax.types import Increments, Vec3
from sinsjax.units import micro_g

RATE_HZ, DT = 100.0, 0.01
SEED, DRAW = np.asarray(1), np.asarray(3)
HERE = place(WGS84, 45 * DEG)
ANGLE, VELOCITY = 0.01 / 60 * DEG, 1e-4
"""Largest errors after 900 s, rad and m/s."""

NAMES = ("sway", "lever", "surge", "shaking", "rocking", "path", "turn")
COMBINATIONS = [case for case in product(*[(0, 1)] * 6, (0, 1, 2))]
"""Each motion off or on; no turns, turns about the vertical, or a turntable."""

COVERING = (
    *((0, 0, 0, 0, 0, 0, 0), (1, 1, 1, 1, 1, 1, 1), (1, 1, 1, 1, 1, 1, 2), (1, 1, 0, 0, 0, 0, 0)),
    *((0, 1, 0, 1, 1, 0, 0), (0, 0, 1, 1, 0, 0, 1), (1, 0, 0, 0, 1, 0, 1), (1, 0, 1, 0, 1, 1, 0)),
    *((0, 1, 1, 0, 0, 1, 2), (0, 0, 0, 0, 1, 1, 2), (1, 0, 0, 1, 0, 0, 2), (0, 1, 0, 0, 0, 1, 1)),
)
"""Cases with every pair of motions, for runs of full length."""


def test_covering_cases_have_every_pair_of_motions() -> None:
    cases = np.array(COVERING)
    for i, j in product(range(6), range(7)):
        if i != j:
            pairs = {(a, b) for a, b in zip(cases[:, i], cases[:, j], strict=True)}
            assert pairs == set(product((0, 1), (0, 1, 2) if j == 6 else (0, 1))), (i, j)


def base_of(case: np.ndarray) -> base_motion.Motion:
    """The base of a case: paper 1's sway, slow and fast turns, and a swing given as a path."""
    sway, lever, _, _, _, path, turn = case
    angles = zip(
        (2.0, -3.0, 30.0), (1.8, 2.4, 2.8), (6.0, 8.0, 10.0), (20.0, 50.0, 80.0), strict=True
    )
    sways = [
        base_motion.Sway(center * DEG, sway * amplitude * DEG, period, phase * DEG)
        for center, amplitude, period, phase in angles
    ]

    def turns(acts: np.ndarray) -> Turns:
        begin, length, rate = np.array([5.0, 40.0]), np.array([18.0, 3.0]), np.array([10.0, -30.0])
        before = np.array([0.0, 180.0]) * DEG
        return Turns(begin, length, np.ones(2), acts * rate * DEG, acts * before)

    knots = np.arange(0.0, 920.0, 2.5)
    swing = np.stack([np.sin(knots / k + k) for k in (4.0, 7.0, 9.0)], axis=1)
    return base_motion.Motion(
        *sways,
        lever=Vec3(*(lever * np.array([2.0, 1.0, -1.5]))),
        vertical=turns(1.0 * (turn == 1)),
        table=turns(1.0 * (turn == 2)),
        path=attitude_path(knots, path * swing * np.array([1.0, 1.5, 4.0])),
    )


def disturbances_of(case: np.ndarray) -> Disturbances:
    """Surge of 0.1 m/s; vibration of 5,000 ug and 5 deg/s at 30 Hz; less on two axes."""
    _, _, surge, shaking, rocking, _, _ = case
    omega, axes = 2 * np.pi * 30.0, np.array([1.0, 0.5, 0.8])
    vibration = partial(processes.resonance_process, frequency_hz=30.0, damping=0.05, dt=DT)
    return Disturbances(
        surge=processes.bounded_velocity_process(surge * 0.1 * axes, 5.0, 1.0, DT),
        shaking=vibration(shaking * 5000 * micro_g(9.8) / omega * axes),
        rocking=vibration(5 * DEG / omega * axes) if rocking else None,
    )


@partial(jax.jit, static_argnums=2)
def simulate(base, them, samples):
    """Increments (samples, 6), and surge, angle, rate and velocity of the housing at their ends."""
    ahead, zero = base_motion.integration_nodes(base, RATE_HZ), jnp.zeros(())
    none = Increments(Vec3(zero, zero, zero), Vec3(zero, zero, zero))

    def moving(states):
        motion = disturbances.housing_motion(them, states)
        surge = processes.process_output(them.surge, states.surge)
        rows = [jnp.stack(none.dv if a is None else a) for a in (surge, *motion)]
        return motion, jnp.stack(rows)

    begin = disturbances.initial_states(them, SEED, DRAW)
    motion, first = moving(begin)
    rate = base_motion.rate_and_force(base, HERE, zero)[0]
    lever = base.lever if motion.angle is not None else None
    state = housing.start_housing(motion, lever, rate, none)

    def step(carry, inputs):
        (states, state), (driven, ideal) = carry, inputs
        states, disturbed = disturbances.advance_processes(them, states, driven, DT)
        rigid = ideal._replace(increments=disturbances.disturb_motion(ideal, disturbed, HERE, DT))
        state, made = housing.sense_in_housing(state, rigid, disturbed.housing, lever, HERE, DT)
        return (states, state), (jnp.stack(jax.tree.leaves(made)), moving(states)[1])

    numbers = jnp.arange(samples)
    sense = partial(base_motion.ideal_sample, base, ahead, HERE, RATE_HZ)
    ideals = jax.lax.map(sense, numbers.astype(float), batch_size=1000)
    driven = disturbances.driving_noise(them, SEED, DRAW, numbers)
    _, (rows, later) = jax.lax.scan(step, (begin, state), (driven, ideals))
    return rows, jnp.concatenate([first[None], later])


@jax.jit
def base_attitudes(base, times):
    return jax.vmap(lambda t: jnp.stack(base_motion.attitude(base, t)))(times)


def truth(base, moving, samples):
    """Attitude (4, n + 1) and velocity (3, n + 1) of the housing, by differences in time."""
    times, h = np.arange(samples + 1) * DT, 1e-4
    surge, angle, rate, velocity = moving.transpose(1, 2, 0)
    lever = np.array(base.lever)[:, None]
    at, later, earlier = (np.asarray(base_attitudes(base, times + d)).T for d in (0.0, h, -h))

    def on_base(a):
        return rigid_body.rotate(rigid_body.of_vector(a), lever + 0 * a)

    carried = rigid_body.rotate(later, on_base(angle)) - rigid_body.rotate(earlier, on_base(angle))
    swung = (on_base(angle + 1e-6 * rate) - on_base(angle - 1e-6 * rate)) / 2e-6
    v = surge + carried / (2 * h) + rigid_body.rotate(at, swung + velocity)
    return rigid_body.multiply(at, rigid_body.of_vector(angle)), v


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


@pytest.mark.parametrize("rocks", [0, 1])
def test_increments_of_all_combinations_give_the_truth_over_a_minute(rocks) -> None:
    """Angles within a fifteenth of what 900 s may have, velocities within a fifth.

    The velocity of a lever arm lags by half a sample in the ramp of a fast turn, 9e-6 m/s.
    """
    cases = [case for case in COMBINATIONS if case[NAMES.index("rocking")] == rocks]
    found = zip(cases, errors(cases, 6000), strict=True)
    beyond = {case: e for case, e in found if e[0] > ANGLE / 15 or e[1] > VELOCITY / 5}
    assert beyond == {}


@pytest.mark.parametrize("case", COVERING, ids=lambda case: "".join(map(str, case)))
def test_increments_give_the_truth_over_900_s(case) -> None:
    ((angle, velocity),) = errors([case], 90_000)
    assert angle < ANGLE and velocity < VELOCITY, (angle, velocity)


def test_exported_vibrating_records_compose_to_the_exported_truth(tmp_path: Path) -> None:
    """Six draws at 5 deg/s on a base that sways: within 0.1' of the truth over 300 s."""
    study = sinsjax.study_from_dict(
        {
            "study": {"duration_s": 300.0, "rate_hz": RATE_HZ, "draws": 6},
            "earth": {"latitude_deg": 45.0, "earth": "wgs84"},
            "motion": {
                **{"yaw_center_deg": 30.0, "yaw_amplitude_deg": 2.8, "yaw_period_s": 10.0},
                **{"pitch_amplitude_deg": 1.8, "pitch_period_s": 6.0, "lever_arm_m": [2, 1, -1.5]},
                **{"vibration_ug_rms": 5000.0, "vibration_deg_per_h_rms": 18_000.0},
            },
            "alignment": {
                "method": "kalman5",
                "phi_e0_deg": 0.0,
                "phi_n0_deg": 0.0,
                "phi_u0_deg": 0.0,
            },
            "filter": {"q_accel_ug": 500.0, "q_gyro_deg_per_h": 0.1, "q_reading": "per_step"}
            | {"r_velocity_m_per_s": 0.1},
        }
    )
    out = sinsjax.export_study(study, tmp_path / "out", format="parquet")
    true, starts = pq.read_table(out / "truth.parquet"), pacsv.read_csv(out / "initial.csv")
    for draw in range(6):
        rows = pq.read_table(out / "imu" / f"draw_{draw:05d}.parquet")
        rows = np.column_stack([rows[name] for name in rows.column_names if "time" not in name])
        turns, _ = compensate(np.concatenate([0 * rows[:1], rows]))
        start = np.array([starts[f"q_{axis}"][draw].as_py() for axis in "wxyz"])
        q = rigid_body.multiply(
            start[:, None], rigid_body.products(rigid_body.of_vector(turns[1:].T))
        )
        here = true.filter(pc.equal(true["draw_id"], draw))
        times = here["time_s"].to_numpy()
        earth = rigid_body.of_vector(np.array([[0.0], [HERE.rate_n], [HERE.rate_u]]) * times)
        q = rigid_body.multiply(
            rigid_body.conjugate(earth), q[:, np.round(times / DT).astype(int) - 1]
        )
        pitch, roll, yaw = (
            here[f"{angle}_deg"].to_numpy() * DEG for angle in ("pitch", "roll", "yaw")
        )
        matrices = np.array(
            [euler_matrix(*angles) for angles in zip(pitch, roll, yaw, strict=True)]
        )
        off = rigid_body.angle_between(q, quaternion(matrices).T)
        assert off.max() < 0.1 / 60 * DEG, draw

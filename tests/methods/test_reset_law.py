"""Resets by their law: its information, its schedules, and predicted settling times."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
from support.commands import Command
from support.refusals import Refusal, refused
from support.studies import refusal_line, small_study

from sinsjax import run
from sinsjax.methods import reset_law
from sinsjax.methods.reset_law import ResetProblem, predict_settling_time
from sinsjax.units import ARCMIN, DEG, DEG_PER_H

pytestmark = pytest.mark.optimised(False)

G = 9.8


def north_rate(latitude_deg: float) -> float:
    return 15.041067 * DEG_PER_H * math.cos(latitude_deg * DEG)


PAPER = ResetProblem(
    velocity_noise=(500e-6 * G) ** 2 / 0.01,
    measurement_noise=0.01,
    velocity=0.1,
    level=15 * DEG,
    heading=80 * DEG,
    north_rate=north_rate(32),
    gravity=G,
    feedback_s=1.0,
    is_force_measured=True,
)
"""Q per step and R as a density, as paper 1 prints them."""

NOISY = PAPER._replace(
    accel_noise=(500e-6 * G) ** 2 * 0.01, gyro_noise=(0.1 * DEG_PER_H) ** 2 * 0.01
)

# The law


def dense_information(length_s: float, problem: ResetProblem, steps: int = 400) -> float:
    """The information on heading of velocities with unknown start, tilt and heading, 1/rad^2."""
    dt = length_s / steps
    t = dt * np.arange(1, steps + 1)
    noise = problem.velocity_noise * np.minimum.outer(t, t)
    noise += problem.measurement_noise / dt * np.eye(steps)
    design = np.column_stack([np.ones(steps), G * t, G * problem.north_rate * t**2 / 2])
    information = design.T @ np.linalg.solve(noise, design)
    return 1 / float(np.linalg.inv(information)[2, 2])


@pytest.mark.parametrize("in_tau", [0.3, 0.69, 0.71, 8.0, 40.0])
def test_information_is_that_of_least_squares(in_tau: float) -> None:
    length_s = in_tau * PAPER.tau
    dense = dense_information(length_s, PAPER)
    assert reset_law.heading_information(length_s, PAPER) == pytest.approx(dense, rel=0.02)


@pytest.mark.parametrize("length_s", [30.0, 120.0])
def test_heading_sigma_of_surge_is_that_of_least_squares(length_s: float) -> None:
    surging = PAPER._replace(surge=0.004)
    white = PAPER._replace(measurement_noise=0.004, velocity_noise=1e-15)
    sigma = dense_information(length_s, white) ** -0.5
    assert reset_law.heading_sigma(length_s, surging) == pytest.approx(sigma, rel=0.02)


def test_last_reset_waits_until_surge_leaves_two_degrees() -> None:
    problem = NOISY._replace(velocity_noise=NOISY.accel_noise, measurement_noise=0.004)
    # A weak surge does not move it.
    quiet, weak, later = (
        reset_law.schedule(problem._replace(surge=surge), 150 * DEG) for surge in (0.0, 1e-6, 0.004)
    )
    assert weak.times_s == quiet.times_s
    assert later.times_s[:3] == quiet.times_s[:3] and later.times_s[3] > quiet.times_s[3]
    surge_alone = PAPER._replace(surge=0.004)
    assert reset_law.heading_sigma(later.segments[0], surge_alone) == pytest.approx(2 * DEG)
    assert later.settling_s > quiet.settling_s


GRAVITY = PAPER._replace(is_force_measured=False)


def cell(problem: ResetProblem, q: float = 1, latitude: float = 32, **given: Any) -> ResetProblem:
    noise = PAPER.velocity_noise * q
    return problem._replace(velocity_noise=noise, north_rate=north_rate(latitude), **given)


CELLS = {
    "R1": (cell(GRAVITY, feedback_s=0.1), (1.9, 85.7, 169.5), 254),
    "R2": (cell(GRAVITY, latitude=60, q=10), (3.0, 249.0, 495.0), 742),
    "R3": (cell(GRAVITY, latitude=0, q=0.1, feedback_s=0.1), (1.8, 66.4), 132),
    "R4": (cell(GRAVITY, latitude=75), (2.0, 182.0, 362.0), 543),
    "R5": (cell(GRAVITY, q=10, feedback_s=10.0), (2.86, 179.23, 349.23), 524),
    "R6": (cell(NOISY), (2.0, 4.0, 6.0, 120.0), 328),
    "R8": (cell(NOISY, latitude=60, q=0.1), (2.0, 4.0, 6.0, 75.0), 320),
    "R10": (cell(NOISY, feedback_s=10.0), (1.87, 3.74, 5.61, 117.55), 328),
}
"""Problems, the resets of the theory's table, and the time that they promise."""


@pytest.mark.parametrize("name", CELLS)
def test_schedule_of_cells_is_at_their_optimum(name: str) -> None:
    """The optimum is flat: times differ by two seconds, what they promise does not."""
    problem, times_s, promised_s = CELLS[name]
    found = reset_law.schedule(problem, 150 * DEG)
    assert found.settling_s == pytest.approx(promised_s, rel=0.005)
    assert len(found.times_s) == len(times_s)
    assert found.times_s == pytest.approx(times_s, rel=0.03)


# Predicted settling times

QUICK = GRAVITY._replace(feedback_s=0.1)
SCHEDULES = [(2.0, 4.0, 80.0), (2.0, 4.0, 60.0, 120.0)]
HEADINGS, VELOCITIES = [10, 90, 150], [0.1, 1.0]
MEASURED = {
    "gravity": [125, 121, 198, 179, 293, 242, 141, 118, 196, 185, 251, 226],
    "measured": [125, 121, 179, 188, 184, 231, 141, 118, 194, 185, 254, 207],
}
"""Settling times (s) of noise-free alignments over resets, headings (deg) and P0 (m/s)."""


@pytest.mark.parametrize(("force", "apart"), [("gravity", 0.08), ("measured", 0.16)])
def test_prediction_is_what_measured_alignments_did(force: str, apart: float) -> None:
    problem = QUICK._replace(
        velocity_noise=(500e-6 * G) ** 2 / 0.02, is_force_measured=force == "measured"
    )
    told = [
        predict_settling_time(
            problem._replace(velocity=velocity), times, 500.0, heading * DEG, 5 * (1 + 1j) * DEG
        )
        for times, heading, velocity in itertools.product(SCHEDULES, HEADINGS, VELOCITIES)
    ]
    ratio = told / np.array(MEASURED[force])
    assert abs(np.median(ratio) - 1) < 0.04
    np.testing.assert_allclose(ratio, 1, atol=apart)


def test_law_is_exact_where_q_limits_and_velocity_is_open() -> None:
    """Turned with the heading, the tilt makes 2 tan(phi/2) contract by 1 + s0^2 J."""
    problem = QUICK._replace(measurement_noise=1e-4, velocity=10.0)
    times = np.linspace(1.0, 600.0, 60_000)
    for heading in (10.0, 90.0, 150.0):
        ratio = 2 * np.tan(heading * DEG / 2) / (10 * ARCMIN)
        law = np.interp(ratio, reset_law.contraction(times, problem), times)
        told = predict_settling_time(problem, (), 600.0, heading * DEG)
        assert told == pytest.approx(law, rel=0.01)


PER_STEP = {"q_accel_ug": 500.0, "q_gyro_deg_per_h": 0.1, "q_reading": "per_step"}
PER_STEP |= {"r_reading": "psd"}


# In a study

LAW = {"schedule": "law"}
LONG = {"filter": PER_STEP, "study": {"duration_s": 400.0, "window_s": [200, 400]}}


def test_sweep_carries_the_schedule_of_each_variant() -> None:
    axes = {"latitude_deg": [0.0, 32.0], "q_scale": [0.1, 1.0]}
    study = small_study(**LONG, resets=LAW, axes=axes)
    times = study.reset_times()
    assert len(set(times)) == 4
    assert times[3] == reset_law.schedule(NOISY, 150 * DEG).times_s
    assert study.values("reset_count") == [None] * 4


@pytest.mark.nightly
def test_schedules_by_name_are_swept_beside_times() -> None:
    policies = ["none", "times", "law", "trigger"]
    axes = {"policy": {"schedule": policies, "reset_times_s": [[], [10.0, 60.0], [], []]}}
    study = small_study(**LONG, resets={}, axes=axes)
    none, times, law, trigger = study.reset_times()
    assert (none, times, trigger) == ((), (10.0, 60.0), ()) and law[:3] == (2.0, 4.0, 6.0)
    assert study.values("reset_trigger") == [None, None, None, "linearisation"]
    summary = run(study.replace({"study.draws": 2}), curves=False).summary
    rows = {(row["schedule"], row["draw_id"]): row for row in summary.to_pylist()}
    assert rows["trigger", 0]["triggered_count"] > 0 == rows["law", 0]["triggered_count"]
    assert rows["law", 1]["reset_times_s"] == list(law)
    assert rows["law", 0]["settle_10_s"] is not None is rows["none", 0]["settle_10_s"]


@refused("""
    resets.reset_times_s = [10.0]                                   -> [resets] reset_times_s
    study.duration_s = 30.0 & study.window_s = [2, 30] & sensors.gyro_noise_deg_per_h = 0.0
        & sensors.accel_noise_ug = 0.0                              -> [resets] schedule: 90
    alignment.method = "kalman10"                                   -> [resets] schedule
    filter.q_accel_ug = 0.0                                         -> [resets] schedule
    resets.heading_bound_deg = 180.0                                -> [resets] heading_bound_deg
    resets.reset_kind = "yaw"                                       -> [resets] reset_kind
""")
def test_schedule_that_cannot_be_made_is_refused_in_one_line(refusal: Refusal) -> None:
    given = {name: LONG.get(name, {}) | table for name, table in refusal.tables.items()}
    given["resets"] = LAW | given.get("resets", {})
    refusal.check(refusal_line(**LONG | given))


# The command


def test_schedule_command_shows_times(sinsjax: Command) -> None:
    code, out, error = sinsjax("schedule", "paper1_resets")
    assert (code, error) == (0, "")
    assert "2, 4, 6, 118 s" in out and "10' from 150 deg: 301 s (median run, predicted)" in out
    places = ["axes.latitude_deg=[32, 60]", 'axes.specific_force=["measured", "gravity"]']
    code, out, _ = sinsjax("schedule", "reset_sweep", "--set", places[0], "--set", places[1])
    *_, gravity = out.partition('latitude_deg 32, specific_force "gravity"')
    assert code == 0 and gravity.lstrip().startswith("resets   2, ")

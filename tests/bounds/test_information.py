"""The information bound: dense matrices, closed forms and published cells, at rest and turning."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.spatial.transform import Rotation

from sinsjax.advice.advise import sheet_problem
from sinsjax.advice.sheet import read_sheet
from sinsjax.bounds.estimator import heading_variances
from sinsjax.bounds.information import (
    GYRO,
    BaseMotion,
    HeadingProblem,
    IncrementError,
    coloured_errors,
    heading_bound,
    parked,
)
from sinsjax.strapdown import earth, processes
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.strapdown.sensors import SensorErrors, error_free_sensors
from sinsjax.units import ARCMIN, DEG, DEG_PER_H, DEG_PER_SQRT_H, micro_g

PLACE = earth.place(earth.wgs84(), 45 * DEG)
AXES, UG, NORTH = np.ones(3), micro_g(), np.eye(3)
WEST = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

# A base at rest, with samples of DT

DT = 0.25
ACCEL, GYROS = 500 * UG * 0.05, 0.5 * DEG_PER_H * DT  # of an increment, m/s and rad
OF_SURGE = {
    "third order": processes.velocity_of_bounded_position(np.array([0.1, 0.2, 0.1]), 5.0, 0.5, DT),
    "gauss-markov": processes.gauss_markov_process(np.array([0.1, 0.2, 0.1]), 5.0, DT),
}


def still_problem(accel=ACCEL * AXES, gyro=GYROS * AXES, to_n=NORTH, **disturbances):
    return HeadingProblem(
        partial(parked, to_n, PLACE),
        place=PLACE,
        dt=DT,
        errors=error_free_sensors()._replace(accel_noise=accel, gyro_noise=gyro),
        increment_errors=partial(coloured_errors, Disturbances(**disturbances)),
        still=True,
    )


def still_bound(time_s, **changes):
    return heading_bound([time_s], still_problem(**changes))[0]


def at_rest():
    """I + A dt, written out: level velocity error, then misalignment."""
    a = np.zeros((5, 5))
    g, wn, wu = PLACE.gravity, PLACE.rate_n, PLACE.rate_u
    cn, ce = PLACE.curvature_n, PLACE.curvature_e
    a[0, 1], a[1, 0] = 2 * wu, -2 * wu
    a[0, 3], a[1, 2] = -g, g
    a[2, 1], a[3, 0], a[4, 0] = -cn, ce, PLACE.tan_latitude * ce
    a[2, 3], a[3, 2] = wu, -wu
    a[2, 4], a[4, 2] = -wn, wn
    return np.eye(5) + a * DT


def autocovariance(process, n):
    """(n,) of the process at unit scale, from its stationary covariance."""
    c, x, out = process.output, process.begin @ process.begin.T @ process.output, []
    for _ in range(n):
        out.append(c @ x)
        x = process.transition @ x
    return np.array(out)


def least_squares_sigma(n, **disturbances):
    """Generalised least squares with the covariance C (2 n, 2 n) of u, sample by sample."""
    powers = [np.eye(5)]
    for _ in range(n):
        powers.append(at_rest() @ powers[-1])
    powers = np.array(powers)
    d, c = powers[1:, :2, 2:].reshape(2 * n, 3), np.zeros((2 * n, 2 * n))
    changes = np.eye(n, n + 1, 1) - np.eye(n, n + 1)
    for axis, sigma in enumerate([ACCEL] * 2 + [GYROS] * 3):
        moved = np.zeros((n, 2, n))  # what an error of one increment does to u later
        for j in range(n):
            moved[j:, :, j] = powers[: n - j, :2, axis]
        moved = moved.reshape(2 * n, n)
        c += sigma**2 * moved @ moved.T
        for name, process in disturbances.items():
            first = 2 if name.startswith("gyro") else 0
            if (axis >= 2) == (first == 2):
                entering = moved @ changes if name == "surge" else moved * DT
                entering = entering * process.scale[axis - first]
                lags = toeplitz(autocovariance(process, entering.shape[1]))
                c += entering @ lags @ entering.T
    return np.sqrt(np.linalg.inv(d.T @ np.linalg.solve(c, d))[2, 2])


@pytest.mark.parametrize("name", [None, *OF_SURGE])
def test_information_bound_matches_generalised_least_squares(name):
    surge = {"surge": OF_SURGE[name]} if name else {}
    found = heading_bound([40 * DT, 200 * DT], still_problem(to_n=WEST, **surge))
    expected = [least_squares_sigma(n, **surge) for n in (40, 200)]
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("name", "rms"),
    [("gyro_instability", DEG_PER_H), ("accel_instability", 9.8e-3)],
    ids=["gyro", "accel"],
)
def test_bound_with_drifts_matches_generalised_least_squares(name, rms):
    drift = {name: processes.gauss_markov_process(rms * np.array([1.0, 0.5, 0.7]), 5.0, DT)}
    found = still_bound(100 * DT, **drift)
    assert found > 1.1 * still_bound(100 * DT)
    np.testing.assert_allclose(found, least_squares_sigma(100, **drift), rtol=1e-5)


def test_bounded_vibration_barely_raises_bound_and_walk_does():
    shaking = processes.resonance_process(1e-3 * AXES, 1.5, 0.1, DT)
    rocking = processes.resonance_process(1e-6 * AXES, 1.5, 0.1, DT)
    walk = processes.sampled_mean_of_random_walk(1e-8 * AXES, DT)
    alone = still_bound(120.0)
    assert alone < still_bound(120.0, shaking=shaking) < 1.01 * alone
    assert still_bound(120.0, rocking=rocking) == alone  # the gyros measure it
    assert still_bound(300.0, gyro_walk=walk) > 1.5 * still_bound(300.0)
    assert still_bound(120.0, accel_walk=walk) == pytest.approx(alone, rel=1e-3)


DISTURBED = {
    "white noise": {},
    "surge": {"surge": OF_SURGE["gauss-markov"]},
    "drift": {"gyro_instability": processes.gauss_markov_process(DEG_PER_H * AXES, 5.0, DT)},
}


@pytest.mark.parametrize("name", DISTURBED)
def test_parked_bound_with_known_biases_equals_bound_from_floor(name):
    """The heading at the end with steps of second order, and at the beginning with the first."""
    problem, times = still_problem(**DISTURBED[name]), [30.0, 120.0, 300.0]
    from_truth = replace(problem, still=False, longest_step_s=DT)
    found, expected = heading_bound(times, from_truth), heading_bound(times, problem)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


# A base that turns, and constant errors with priors

RAMP_S = 1.0
MEMS, FOG = (1, 0.02, 500, 50), (0.1, 0.005, 200, 30)
"""Gyro bias (deg/h), random walk (deg/sqrt(h)), accelerometer bias (ug) and noise (ug/sqrt(Hz))."""


def earth_rate(place):
    return np.array([0.0, place.rate_n, place.rate_u])


def turned_angle(turns, rate, t):
    """Angle (deg) of turns (begin in s, angle in deg) at a rate (deg/s), with ramps."""
    angle = 0 * t
    for begin, whole in turns:
        for sign, start in ((1, begin), (-1, begin + abs(whole) / rate)):
            x = np.clip((t - start) / RAMP_S, 0, 1)
            path = RAMP_S * x**4 * (2.5 - 3 * x + x * x) + np.maximum(t - start - RAMP_S, 0)
            angle = angle + sign * np.copysign(rate, whole) * path
    return angle


def motion(turns=(), rate=10.0, sway=(), place=PLACE):
    """A base that turns and sways: amplitude (deg), period (s) and phase (rad) of pitch, roll."""

    def attitude(t):
        angles = np.zeros((len(t), 3))
        angles[:, 0] = turned_angle(turns, rate, t)
        for axis, (amplitude, period, phase) in enumerate(sway, start=1):
            angles[:, axis] = amplitude * np.sin(2 * np.pi * t / period + phase)
        return Rotation.from_euler("ZXY", angles, degrees=True)

    def at(t, half=1e-3):
        c, before, after = (attitude(t + shift) for shift in (0.0, -half, half))
        turn = (before.inv() * after).as_rotvec() / (2 * half)
        return BaseMotion(c.as_matrix(), turn + c.inv().apply(earth_rate(place)))

    return at


def centred(middle, angle, rate=10.0):
    return middle - (abs(angle) / rate + RAMP_S) / 2, angle


def sensors(grade, ppm=0.0, mrad=0.0, dt=0.01):
    gyro_bias, arw, accel_bias, vrw = grade
    return SensorErrors(
        gyro_bias=gyro_bias * DEG_PER_H * AXES,
        accel_bias=accel_bias * UG * AXES,
        gyro_noise=arw * DEG_PER_SQRT_H * np.sqrt(dt) * AXES,
        accel_noise=vrw * UG * np.sqrt(dt) * AXES,
        gyro_matrix=np.where(np.eye(3), ppm * 1e-6, mrad * 1e-3),
        accel_matrix=np.zeros((3, 3)),
    )


def bound(end, moving, grade, ppm=0.0, mrad=0.0, dt=0.01, **changes):
    """The bound in arcmin."""
    given = {"errors": sensors(grade, ppm, mrad, dt)} | changes
    problem = HeadingProblem(moving, place=PLACE, dt=dt, **given)
    return heading_bound(np.atleast_1d(np.asarray(end, float)).tolist(), problem) / ARCMIN


HALF = [centred(150, 180)]


def dense_sigma(end, problem, drift, step=0.5, fine=0.05):
    """The bound in rad from the whole covariance of u after each step, by fine Euler steps.

    The gyros drift, with a rms (rad/s) and a correlation time (s).
    """
    count, every, errors = round(end / fine), round(step / fine), problem.errors
    c, w = problem.motion((np.arange(count) + 0.5) * fine)
    f, turn = PLACE.gravity * c[:, 2], -np.cross(earth_rate(problem.place), np.eye(3)).T
    kept, eye, root = np.exp(-fine / drift[1]), np.eye(3), np.sqrt(problem.dt * fine)
    gyro, accel = np.diag(errors.gyro_noise) / root, np.diag(errors.accel_noise) / root
    # Columns of x: phi(0), then normal numbers of variance 1: for the constant errors, for the
    # noise of each fine step and axis, for the drifts and the lever arm.
    at_noise, at_drift = 27, 27 + 6 * count
    x = np.zeros((5, at_drift + 3 * (count + 1) + 3))
    x[2:, :3], drifting = eye, np.zeros((3, x.shape[1]))
    drifting[:, at_drift : at_drift + 3] = drift[0] * eye
    rows, arm = [], np.zeros(3)
    arm[: len(problem.lever_arms)] = np.diag(problem.lever_arms)
    c_0, w_0 = (a[0] for a in problem.motion(np.zeros(1)))
    start = np.cross(c_0 @ w_0 - earth_rate(problem.place), c_0.T).T @ np.diag(arm)
    for k in range(count):
        rate, force = drifting.copy(), np.zeros_like(drifting)
        rate[:, 3:27] += np.hstack([eye, 0 * eye, np.kron(eye, w[k]), np.zeros((3, 9))])
        force[:, 3:27] += np.hstack([0 * eye, eye, np.zeros((3, 9)), np.kron(eye, f[k])])
        for error in (rate, force):
            error[:, 3:27] *= problem.constant_sigmas[:24]
        own = at_noise + 6 * k
        rate[:, own : own + 3], force[:, own + 3 : own + 6] = gyro, accel
        tilt = turn @ x[2:] - c[k] @ rate
        middle = x[2:] + tilt * fine / 2
        x[:2] += (c[k, :2] @ force + PLACE.gravity * np.array([-middle[1], middle[0]])) * fine
        x[2:] += tilt * fine
        own = at_drift + 3 * (k + 1)
        drifting *= kept
        drifting[:, own : own + 3] = drift[0] * np.sqrt(1 - kept**2) * eye
        if (k + 1) % every == 0:
            c_end, w_end = (a[0] for a in problem.motion(np.array([fine * (k + 1)])))
            rate = c_end @ w_end - earth_rate(problem.place)
            x[:2, -3:] = (np.cross(rate, c_end.T).T @ np.diag(arm) - start)[:2]
            rows.append(x[:2].copy())
    data, sought = np.concatenate(rows), x[4]
    d, e = data[:, :3], data[:, 3:]
    gain = np.linalg.solve(e @ e.T, np.column_stack([d, e @ sought[3:]]))
    left = sought[:3] - gain[:, 3] @ d
    known = sought[3:] @ sought[3:] - (e @ sought[3:]) @ gain[:, 3]
    return np.sqrt(known + left @ np.linalg.solve(d.T @ gain[:, :3], left))


@pytest.mark.parametrize("drift", [None, (0.5 * DEG_PER_H, 8.0)])
@pytest.mark.parametrize("arm", [(), (0.1, 2.0, 3.0)])
@pytest.mark.parametrize("sway", [(), ((2.0, 3.0, 0.3), (3.0, 4.0, 1.0))], ids=["level", "sways"])
def test_bound_matches_dense_least_squares(sway, arm, drift):
    """With axes that differ, turns of 10 deg a step, and an Earth that turns 5 deg."""
    grade = sensors((3.0, 0.02, 500.0, 50.0), 300.0, 1.0)
    errors = grade._replace(
        gyro_noise=grade.gyro_noise * [1.0, 2.0, 0.5],
        accel_noise=grade.accel_noise * [1.0, 0.7, 2.0],
        accel_matrix=np.full((3, 3), 2e-2),
    )
    rms, time_s = drift or (0.0, 1.0)
    fast = PLACE._replace(rate_n=60 * PLACE.rate_n, rate_u=60 * PLACE.rate_u)
    moving = motion([(3.0, 170.0)], 20.0, sway, place=fast)
    problem = HeadingProblem(moving, fast, 0.01, errors, lever_arms=np.diag(arm))

    def drifts(step):
        drift = processes.sampled_mean_of_gauss_markov(rms * AXES, time_s, step)
        return {0: IncrementError(drift._replace(scale=drift.scale * step), GYRO)}

    drifting = replace(problem, increment_errors=drifts)
    found = heading_bound([20.0], drifting)
    assert found == pytest.approx(dense_sigma(20.0, problem, (rms, time_s)), rel=2e-3)


def test_half_turn_finds_heading_without_prior_of_level_gyro_biases():
    errors = sensors(MEMS)._replace(gyro_bias=np.array([1e4, 1e4, 1]) * DEG_PER_H)
    assert bound(300, motion(), MEMS, errors=errors) > 1e6
    turned = bound(300, motion(HALF), MEMS, errors=errors)
    assert turned == pytest.approx(bound(300, motion(HALF), MEMS), rel=0.01)


def test_several_times_in_one_call_equal_separate_calls():
    times = [100.0, 160.0, 300.0]
    together = bound(times, motion(HALF), FOG, ppm=300)
    separate = [bound(time, motion(HALF), FOG, ppm=300)[0] for time in times]
    np.testing.assert_allclose(together, separate, rtol=1e-9)


def test_step_length_has_little_influence():
    coarse = bound(299.0, motion(HALF), FOG, 300, 1)
    fine = bound(299.0, motion(HALF), FOG, 300, 1, longest_step_s=0.1)
    assert coarse == pytest.approx(fine, rel=1e-3)
    # 2,999 samples are a prime number: steps of one sample
    assert bound(59.98, motion(), MEMS, dt=0.02) == pytest.approx(bound(60.0, motion(), MEMS), 0.01)


def rounded_sheet(**changes):
    """The problem of a sheet with rounded angles on a base that turns."""
    sheet = {
        "earth": {"latitude_deg": 48.0},
        "sensors": {
            **{"gyro_arw_deg_per_sqrt_h": 0.005, "accel_vrw_ug_per_sqrt_hz": 30.0},
            "gyro_quantisation_arcsec": 10.0,
        },
        "drawn": {"gyro_bias_deg_per_h": {"normal": [0.0, 0.05]}},
        "motion": {
            **{"turn_times_s": [30.0, 60.0], "turn_angles_deg": [360.0, -360.0]},
            "turn_rate_deg_per_s": 20.0,
        },
    }
    return sheet_problem(read_sheet(sheet, changes=changes))


def test_rounded_angles_turn_with_the_body_in_steps_of_any_length():
    """The remainder of a rounded angle is carried on in axes that turn meanwhile."""
    problem = rounded_sheet()
    fine, coarse = (
        sum(
            heading_variances(
                [100.0], replace(problem, longest_step_s=step), ("gyro_quantisation",)
            ).values()
        )
        for step in (0.1, 1.0)
    )
    assert np.sqrt(coarse) == pytest.approx(np.sqrt(fine), rel=0.005)


def test_rounded_angles_at_the_end_of_an_arm_are_a_rounded_velocity():
    """Of the level axes for an arm along the vertical, by two remainders over 0.1 s."""
    quantum = np.sqrt(2) * 10.0 * DEG / 3600 / 0.1 * 2.0
    other = {"sensors.accel_quantisation_um_per_s": [1e6 * quantum, 1e6 * quantum, 0.0]}
    sources = ("gyro_quantisation", "accel_quantisation", "swing")
    problem = rounded_sheet(**other, **{"motion.lever_arm_m": [0.0, 0.0, 2.0]})
    found = heading_variances([100.0], problem, sources)
    assert found["swing"] == pytest.approx(found["accel_quantisation"], rel=1e-9) and found["swing"]

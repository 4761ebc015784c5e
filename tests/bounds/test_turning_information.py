"""The information bound of a turning base: dense matrices, closed forms, and published cells."""

import math

import numpy as np
import pytest

from sinsjax.bounds.coloured_noise import ANGLE, IN_B, IN_N, VELOCITY
from sinsjax.bounds.information import heading_bound
from sinsjax.bounds.turning_information import (
    ConstantErrors,
    HeadingProblem,
    WhiteNoise,
    turning_heading_bound,
)
from sinsjax.strapdown import earth, processes
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.strapdown.sensors import error_free_sensors
from sinsjax.units import ARCMIN, DEG, DEG_PER_H, DEG_PER_SQRT_H, micro_g

PLACE = earth.place(earth.wgs84(), 45 * DEG)
AXES, UG = np.ones(3), micro_g()
RAMP_S = 1.0
MEMS, FOG, LASER = (1, 0.02, 500, 50), (0.1, 0.005, 200, 30), (0.01, 0.001, 50, 10)
NO_SWAY = ((0.0, 1.0, 0.0), (0.0, 1.0, 0.0))


def turn_angle(turns, rate, t):
    """Angle (rad) and rate (rad/s) of turns (begin in s, angle in deg) with ramps."""
    angle, speed = 0 * t, 0 * t
    for begin, whole in turns:
        for sign, start in ((1, begin), (-1, begin + abs(whole) / rate)):
            x = np.clip((t - start) / RAMP_S, 0, 1)
            factor = sign * math.copysign(rate, whole) * DEG
            path = RAMP_S * x**4 * (2.5 - 3 * x + x * x) + np.maximum(t - start - RAMP_S, 0)
            angle, speed = angle + factor * path, speed + factor * x**3 * (10 - 15 * x + 6 * x * x)
    return angle, speed


def rotations(axis, angle):
    """(n, 3, 3) about a coordinate axis."""
    out = np.zeros((len(angle), 3, 3))
    i, j = [k for k in range(3) if k != axis]
    sign = -1 if axis == 1 else 1
    out[:, axis, axis] = 1
    out[:, i, i] = out[:, j, j] = np.cos(angle)
    out[:, i, j], out[:, j, i] = -sign * np.sin(angle), sign * np.sin(angle)
    return out


def motion(turns=(), rate=10.0, sway=NO_SWAY):
    """A base that turns and sways: amplitude (deg), period (s) and phase (rad) of pitch, roll."""

    def at(t):
        yaw, yaw_rate = turn_angle(turns, rate, t)
        angles, speeds = [], []
        for amplitude, period, phase in sway:
            omega = 2 * np.pi / period
            angles.append(amplitude * DEG * np.sin(omega * t + phase))
            speeds.append(amplitude * DEG * omega * np.cos(omega * t + phase))
        roll = rotations(1, angles[1])
        c = rotations(2, yaw) @ rotations(0, angles[0]) @ roll
        zero = 0 * t
        up = np.stack([zero, zero + PLACE.rate_n, PLACE.rate_u + yaw_rate], -1)
        w = np.einsum("nji,nj->ni", c, up) + np.stack([zero, speeds[1], zero], -1)
        return c, w + np.einsum("nji,nj->ni", roll, np.stack([speeds[0], zero, zero], -1))

    return at


def centred(middle, angle, rate=10.0):
    return middle - (abs(angle) / rate + RAMP_S) / 2, angle


def reversing(end, rate):
    turns, begin, angle = [], 0.0, 180.0
    while begin < end:
        turns.append((begin, angle))
        begin, angle = begin + abs(angle) / rate + RAMP_S, math.copysign(360.0, -angle)
    return turns


def constant_errors(gyro_bias=0.0, accel_bias=0.0, ppm=0.0, mrad=0.0):
    matrix = np.full((3, 3), mrad * 1e-3)
    np.fill_diagonal(matrix, ppm * 1e-6)
    return ConstantErrors(
        gyro_bias * DEG_PER_H * AXES, accel_bias * UG * AXES, matrix, np.zeros((3, 3))
    )


def bound(end, moving, sensors, ppm=0.0, mrad=0.0, **changes):
    """The bound in arcmin."""
    gyro_bias, arw, accel_bias, vrw = sensors
    return (
        turning_heading_bound(
            np.atleast_1d(np.asarray(end, float)).tolist(),
            HeadingProblem(
                moving,
                **{
                    "place": PLACE,
                    "dt": 0.01,
                    "noise": WhiteNoise(arw * DEG_PER_SQRT_H * AXES, vrw * UG * AXES),
                    "constant": constant_errors(gyro_bias, accel_bias, ppm, mrad),
                }
                | changes,
            ),
        )
        / ARCMIN
    )


def flicker(deg_per_h):
    """Flicker noise of the gyros, S = b^2 / (2 pi f), from Gauss-Markov processes."""
    ratio = 3.0
    rms = deg_per_h * DEG_PER_H * np.sqrt(np.log(ratio) / np.pi)

    def errors(step):
        for time in ratio ** np.arange(9):
            drift = processes.sampled_mean_of_gauss_markov(rms * AXES, time, step)
            yield drift._replace(scale=drift.scale * step), (ANGLE, IN_B)

    return lambda step: tuple(errors(step))


HALF = [centred(150, 180)]
LATE_HALF = [centred(300, 180)]
CELLS = {
    "parked": (323.6, 300, motion(), MEMS, {}),
    "half turn": (24.05, 300, motion(HALF), MEMS, {}),
    "half turn, FOG": (6.602, 300, motion(HALF), FOG, {}),
    "half turn, laser": (0.9042, 600, motion(LATE_HALF), LASER, {}),
    "quarter turn": (23.59, 600, motion([centred(300, 90)]), MEMS, {}),
    "quarter turn with engine": (
        9.478,
        300,
        motion([centred(120, 90)], sway=((0.1, 3, 0), (0.1, 2, 1))),
        FOG,
        {},
    ),
    "four positions": (4.191, 600, motion([centred(150 * k, 90) for k in (1, 2, 3)]), FOG, {}),
    "carousel": (23.22, 300, motion([(0, 1e6)], 6.0), MEMS, {}),
    "reversing": (4.93, 600, motion(reversing(600, 6.0), 6.0), FOG, {"ppm": 300, "mrad": 1}),
    "half turn with scale": (17.43, 600, motion(LATE_HALF), MEMS, {"ppm": 300, "mrad": 1}),
    "half turn with flicker": (33.59, 600, motion(LATE_HALF), MEMS, {"flicker": 0.2}),
    "half turn on waves": (
        128.4,
        600,
        motion(LATE_HALF, sway=((2, 6, 0.3), (3, 8, 1))),
        (10, 0.15, 1000, 120),
        {},
    ),
}


@pytest.mark.parametrize("name", CELLS)
def test_bound_matches_cells_of_prototypes(name):
    expected, end, moving, sensors, others = CELLS[name]
    given = {key: value for key, value in others.items() if key != "flicker"}
    if "flicker" in others:
        given["increment_errors"] = flicker(others["flicker"])
    assert bound(end, moving, sensors, **given) == pytest.approx(expected, rel=0.01)


def dense_sigma(end, step, fine, moving, noise, constant, drift=None):
    """The bound in rad from the whole covariance of u, integrated in fine Euler steps.

    Args:
        end: s.
        step: time between two values of u, s.
        fine: step of the integration, s.
        moving: attitude and rate.
        noise: of the sensors.
        constant: sigmas.
        drift: rms (rad/s) and time (s) of Gauss-Markov drifts of the gyros.
    """
    count, every = round(end / fine), round(step / fine)
    c, w = moving((np.arange(count) + 0.5) * fine)
    sigmas = np.concatenate([np.ravel(part) for part in constant])
    unknown = np.flatnonzero(sigmas)
    # Columns of x: theta, then the noise of each fine step and axis, and the drifts' beginning.
    at_gyro = 3 + len(unknown)
    at_accel, at_drift = at_gyro + 3 * count, at_gyro + 6 * count
    x = np.zeros((5, at_drift + 3 * (count + 1)))
    x[2:, :3] = np.eye(3)
    drifts = np.zeros((3, x.shape[1]))
    kept = 1.0
    if drift:
        drifts[:, at_drift : at_drift + 3] = drift[0] * np.eye(3)
        kept = np.exp(-fine / drift[1])
    turn = np.array([[0, PLACE.rate_u, -PLACE.rate_n], [-PLACE.rate_u, 0, 0], [PLACE.rate_n, 0, 0]])
    rows = []
    for k in range(count):
        gyro, accel = drifts.copy(), np.zeros_like(drifts)
        effects = [
            np.hstack([np.eye(3), np.zeros((3, 3)), np.kron(np.eye(3), w[k]), np.zeros((3, 9))]),
            np.hstack(
                [
                    np.zeros((3, 3)),
                    np.eye(3),
                    np.zeros((3, 9)),
                    np.kron(np.eye(3), PLACE.gravity * c[k, 2]),
                ]
            ),
        ]
        gyro[:, 3:at_gyro] += effects[0][:, unknown]
        accel[:, 3:at_gyro] += effects[1][:, unknown]
        own = slice(at_gyro + 3 * k, at_gyro + 3 * k + 3)
        gyro[:, own] += np.diag(noise.gyro) / np.sqrt(fine)
        own = slice(at_accel + 3 * k, at_accel + 3 * k + 3)
        accel[:, own] += np.diag(noise.accel) / np.sqrt(fine)
        rate = turn @ x[2:] - c[k] @ gyro
        middle = x[2:] + rate * fine / 2
        force = c[k][:2] @ accel + PLACE.gravity * np.array([-middle[1], middle[0]])
        x[:2] += force * fine
        x[2:] += rate * fine
        if drift:
            own = slice(at_drift + 3 * k + 3, at_drift + 3 * k + 6)
            drifts = kept * drifts
            drifts[:, own] += drift[0] * np.sqrt(1 - kept**2) * np.eye(3)
        if (k + 1) % every == 0:
            rows.append(x[:2].copy())
    data, target = np.concatenate(rows), x[4]
    d, e = data[:, :at_gyro], data[:, at_gyro:]
    whitened = np.linalg.solve(e @ e.T, np.hstack([d, e @ target[at_gyro:, None]]))
    information = d.T @ whitened[:, :-1]
    information[range(3, at_gyro), range(3, at_gyro)] += 1 / sigmas[unknown] ** 2
    left = target[:at_gyro] - whitened[:, -1] @ d
    explained = (e @ target[at_gyro:]) @ whitened[:, -1]
    known = target[at_gyro:] @ target[at_gyro:] - explained
    return np.sqrt(known + left @ np.linalg.solve(information, left))


@pytest.mark.parametrize("drift", [None, (0.5 * DEG_PER_H, 8.0)])
@pytest.mark.parametrize("sway", [NO_SWAY, ((2.0, 3.0, 0.3), (3.0, 4.0, 1.0))])
def test_bound_matches_dense_least_squares(sway, drift):
    """With axes that differ, and turns of 10 deg a step."""
    moving = motion([(3.0, 170.0)], 20.0, sway)
    noise = WhiteNoise(
        0.02 * DEG_PER_SQRT_H * np.array([1.0, 2.0, 0.5]), 50 * UG * np.array([1.0, 0.7, 2.0])
    )
    constant = constant_errors(3.0, 500.0, 300.0, 1.0)._replace(accel_matrix=np.full((3, 3), 2e-4))

    def errors(step):
        if drift is None:
            return ()
        process = processes.sampled_mean_of_gauss_markov(drift[0] * AXES, drift[1], step)
        return ((process._replace(scale=process.scale * step), (ANGLE, IN_B)),)

    problem = HeadingProblem(
        moving, place=PLACE, dt=0.01, noise=noise, constant=constant, increment_errors=errors
    )
    (found,) = turning_heading_bound([20.0], problem)
    expected = dense_sigma(20.0, 0.5, 0.05, moving, noise, constant, drift)
    assert found == pytest.approx(expected, rel=2e-3)


def test_parked_bound_with_known_biases_equals_bound_from_floor():
    dt, times = 0.1, [30.0, 120.0, 300.0]
    for _, arw, _, vrw in (MEMS, FOG, LASER):
        errors = error_free_sensors()._replace(
            gyro_noise=arw * DEG_PER_SQRT_H * np.sqrt(dt) * AXES,
            accel_noise=vrw * UG * np.sqrt(dt) * AXES,
        )
        parked = heading_bound(
            times, place=PLACE, errors=errors, disturbances=Disturbances(), dt=dt
        )
        found = bound(times, motion(), (0, arw, 0, vrw), dt=dt) * ARCMIN
        np.testing.assert_allclose(found, parked, rtol=0.01)


@pytest.mark.parametrize("sensors", [MEMS, FOG, LASER])
def test_parked_bound_with_bias_priors_is_bias_floor_as_sigma(sensors):
    gyro_bias, arw, accel_bias, vrw = sensors
    known = bound(300, motion(), (0, arw, 0, vrw))
    floor = np.array([gyro_bias * DEG_PER_H / PLACE.rate_n, accel_bias * UG / PLACE.gravity])
    drifted = gyro_bias * DEG_PER_H * 150  # of the up gyro, since the middle of the data
    expected = np.sqrt(known**2 + ((floor @ floor) + drifted**2) / ARCMIN**2)
    assert bound(300, motion(), sensors) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.6])
def test_half_turn_follows_closed_form(share):
    """Noise of the slope, over what the mean of exp(i psi) leaves of the bias."""
    end, (gyro_bias, arw, _, vrw) = 600.0, MEMS
    n, va = arw * DEG_PER_SQRT_H, vrw * UG
    r = 2 * va / (PLACE.gravity * n) / end
    slope = n**2 / end * (1 + 2 * r + 12 * r * r)
    prior = (gyro_bias * DEG_PER_H) ** 2
    kappa, mean = prior / (prior + slope), 1 - 2 * share
    middle = slope / (1 - kappa * mean**2) / PLACE.rate_n**2
    later = (end / 2) ** 2 / (1 / prior + (end * PLACE.rate_n) ** 2 / (48 * slope))
    found = bound(end, motion([centred(share * end, 180)]), MEMS)
    assert found == pytest.approx(np.sqrt(middle + later) / ARCMIN, rel=0.08)


def test_scale_factor_costs_half_turn_its_angle_after_mean():
    """Its standard deviation times (psi_end - mean psi), where biases hide both halves' heading."""
    moving, ppm = motion(LATE_HALF), 1000.0
    without, with_scale = (bound(600, moving, MEMS, ppm=given) for given in (0.0, ppm))
    share = np.sqrt(with_scale**2 - without**2) * ARCMIN
    # Heading north and south, the scale factors of the level gyros hardly move the heading.
    assert share == pytest.approx(ppm * 1e-6 * np.pi / 2, rel=0.03)


def test_half_turn_finds_heading_without_prior_of_level_gyro_biases():
    constant = constant_errors(1.0, 500.0)._replace(gyro_bias=np.array([1e4, 1e4, 1]) * DEG_PER_H)
    assert bound(300, motion(), MEMS, constant=constant) > 1e6
    turned = bound(300, motion(HALF), MEMS, constant=constant)
    assert turned == pytest.approx(bound(300, motion(HALF), MEMS), rel=0.01)


def test_heading_of_level_base_and_small_sway_do_not_matter():
    level = bound(300, motion(HALF), FOG)
    ahead = motion(HALF)
    east = rotations(2, np.array([np.pi / 2]))[0]

    def aside(t):
        c, _ = ahead(t)
        _, rate = turn_angle(HALF, 10.0, t)
        c = east @ c
        earth_rate = np.einsum("nji,j->ni", c, [0.0, PLACE.rate_n, PLACE.rate_u])
        return c, earth_rate + rate[:, None] * [0.0, 0.0, 1.0]

    assert bound(300, aside, FOG) == pytest.approx(level, rel=1e-9)
    swaying = motion(HALF, sway=((1.0, 6.0, 0.0), (1.0, 8.0, 0.0)))
    assert bound(300, swaying, FOG) == pytest.approx(level, rel=0.01)


def test_several_times_in_one_call_equal_separate_calls():
    given = {"ppm": 300, "mrad": 1, "increment_errors": flicker(0.1)}
    times = [100.0, 160.0, 300.0]
    together = bound(times, motion(HALF), FOG, **given)
    separate = [bound(time, motion(HALF), FOG, **given)[0] for time in times]
    np.testing.assert_allclose(together, separate, rtol=1e-9)


def test_step_length_has_little_influence():
    coarse = bound(299.0, motion(HALF), FOG, 300, 1)
    fine = bound(299.0, motion(HALF), FOG, 300, 1, longest_step_s=0.1)
    assert coarse == pytest.approx(fine, rel=1e-3)
    # 2,999 samples are a prime number: steps of one sample
    assert bound(59.98, motion(), MEMS, dt=0.02) == pytest.approx(bound(60.0, motion(), MEMS), 0.01)


def test_surge_raises_bound_of_turning_base():
    def surge(step):
        process = processes.gauss_markov_process(0.1 * AXES, 2.0, step)
        change = process.output * (process.transition[0] - 1)
        return ((process._replace(output=change, direct=process.drive[0]), (VELOCITY, IN_N)),)

    at_rest = bound(120, motion([centred(60, 180)]), FOG)
    surging = bound(
        120, motion([centred(60, 180)]), FOG, increment_errors=surge, longest_step_s=0.1
    )
    assert surging > 1.5 * at_rest


def test_heading_is_unknown_after_one_step():
    assert bound(0.5, motion(), MEMS)[0] > 1e6

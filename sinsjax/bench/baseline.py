"""The alignment step as a straightforward NumPy loop over one run.

It serves as a baseline for `bench` and a check on the engine: dense matrices, rotation matrices and
textbook formulas, sharing only the sensor increments with the engine. It is separate from the naive
engine of the tests, which supports every option of a study and is not a measure of speed.
"""

from typing import NamedTuple

import numpy as np


class AlignmentSettings(NamedTuple):
    """Parameters of the loop, in SI units and rad.

    Attributes:
        dt: sample time, s.
        rate_n: Earth rate north, rad/s.
        rate_u: Earth rate up, rad/s.
        tan_latitude: tangent of the latitude.
        radius: of the Earth, m.
        p0: (5,) initial variances.
        q: (5,) process noise per step.
        r: measurement variance.
        feedback_every: samples.
        resets: sample counts after which P is set to P0.
    """

    dt: float
    rate_n: float
    rate_u: float
    tan_latitude: float
    radius: float
    p0: np.ndarray
    q: np.ndarray
    r: float
    feedback_every: int
    resets: tuple[int, ...]


def skew_matrix(v: np.ndarray) -> np.ndarray:
    """Return the cross-product matrix of v."""
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def rotation_matrix(v: np.ndarray) -> np.ndarray:
    """Return the rotation matrix of a rotation vector (Rodrigues)."""
    angle = np.sqrt(v @ v)
    if angle < 1e-12:
        return np.eye(3) + skew_matrix(v)
    k = skew_matrix(v / angle)
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)


def align_with_numpy_loop(
    increments: np.ndarray, c_nb: np.ndarray, settings: AlignmentSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Run the 5-state zero-velocity alignment.

    Args:
        increments: (n, 6) measured angle (rad) and velocity (m/s) increments in b.
        c_nb: (3, 3) initial C_b^n, misaligned.
        settings: parameters.

    Returns:
        C_b^n corrected by the last estimate, and P (5, 5).
    """
    s, velocity = settings, np.zeros(2)
    x, p = np.zeros(5), np.diag(s.p0)
    h = np.eye(2, 5)
    before = increments[0]
    for n, now in enumerate(increments, start=1):
        a, f_dt = transition_and_velocity_increment(
            c_nb, velocity, compensate_coning_and_sculling(now, before)[1], settings
        )
        w_in = navigation_rate(velocity, settings)
        theta, _ = compensate_coning_and_sculling(now, before)
        coriolis = 2 * s.rate_u + velocity[0] * s.tan_latitude / s.radius
        c_nb = rotation_matrix(-w_in * s.dt) @ c_nb @ rotation_matrix(theta)
        velocity = velocity + f_dt[:2] + coriolis * s.dt * np.array([velocity[1], -velocity[0]])
        phi = np.eye(5) + a
        x, p = phi @ x, phi @ p @ phi.T + np.diag(s.q)
        gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + s.r * np.eye(2))
        x, p = x + gain @ (velocity - h @ x), p - gain @ h @ p
        if n in s.resets or n % s.feedback_every == 0:
            velocity, c_nb, x = velocity - x[:2], rotation_matrix(x[2:]) @ c_nb, np.zeros(5)
        if n in s.resets:
            p = np.diag(s.p0)
        before = now
    return rotation_matrix(x[2:]) @ c_nb, p


def compensate_coning_and_sculling(
    increments: np.ndarray, previous: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation vector and velocity increment of a sample with coning and sculling."""
    theta, dv, theta0, dv0 = increments[:3], increments[3:], previous[:3], previous[3:]
    sculling = (np.cross(theta0, dv) + np.cross(dv0, theta)) / 12
    rotation_correction = np.cross(theta, dv) / 2 + np.cross(theta, np.cross(theta, dv)) / 6
    return theta + np.cross(theta0, theta) / 12, dv + rotation_correction + sculling


def navigation_rate(velocity: np.ndarray, settings: AlignmentSettings) -> np.ndarray:
    """Return the rotation rate w_in in n, rad/s."""
    east = velocity[0] / settings.radius
    return np.array(
        [
            -velocity[1] / settings.radius,
            settings.rate_n + east,
            settings.rate_u + east * settings.tan_latitude,
        ]
    )


def transition_and_velocity_increment(
    c_nb: np.ndarray, velocity: np.ndarray, dv: np.ndarray, settings: AlignmentSettings
) -> tuple[np.ndarray, np.ndarray]:
    """A dt from [P1] eq. (3), and the velocity increment in n."""
    ve, vn = velocity
    w_e, w_n, w_u = navigation_rate(velocity, settings)
    f_dt = c_nb @ dv
    f_dt = f_dt - np.cross(np.array([w_e, w_n, w_u]) * settings.dt / 2, f_dt)
    t, r = settings.tan_latitude, settings.radius
    a = np.array(
        [
            [vn * t / r, 2 * settings.rate_u + ve * t / r, 0, 0, 0],
            [-2 * (settings.rate_u + ve * t / r), 0, 0, 0, 0],
            [0, -1 / r, 0, w_u, -w_n],
            [1 / r, 0, -w_u, 0, -vn / r],
            [t / r, 0, w_n, vn / r, 0],
        ]
    )
    a = a * settings.dt
    a[:2, 2:] = skew_matrix(f_dt)[:2]
    return a, f_dt

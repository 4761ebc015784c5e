"""Records of a base that is turned about the vertical, by plain NumPy and fine substeps."""

from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

DEG = np.pi / 180
DEG_PER_H = DEG / 3600
G = 9.80665
EARTH_RATE = 15.041067 * DEG_PER_H
RAMP_S = 1.0
SUBSTEPS = 20


class Turned(NamedTuple):
    """Rates (rad/s), specific forces (m/s^2), right-front-up, and the heading at the end, deg."""

    gyro: np.ndarray
    accel: np.ndarray
    heading_deg: float
    rate_hz: float


def turn_angle(time_s, times_s, angles_deg, rate_deg_per_s):
    """Return psi, rad, and its rate, of turns with ramps of 1 s whose rate is a raised cosine."""
    psi, rate = np.zeros_like(time_s), np.zeros_like(time_s)
    for begin_s, angle in zip(times_s, angles_deg, strict=True):
        for start_s, sign in ((begin_s, 1), (begin_s + abs(angle) / rate_deg_per_s, -1)):
            x = (time_s - start_s) / RAMP_S
            inside = np.clip(x, 0, 1)
            size = sign * np.sign(angle) * rate_deg_per_s * DEG
            rate += size * (1 - np.cos(np.pi * inside)) / 2
            ramp = RAMP_S * (inside / 2 - np.sin(np.pi * inside) / (2 * np.pi))
            psi += size * (ramp + RAMP_S * np.maximum(x - 1, 0))
    return psi, rate


Turning = tuple[tuple[float, ...], tuple[float, ...], float]
"""Begin of the turns, s, their angles, deg, and the rate, deg/s."""

TURNS = {
    "one turn by 180": ((145.0,), (180.0,), 10.0),
    "one turn by 90": ((145.0,), (90.0,), 10.0),
    "four positions": ((70.0, 145.0, 220.0), (90.0, 90.0, 90.0), 10.0),
    "one-way carousel": ((5.0,), (1e6,), 6.0),
    "reversing carousel": (
        (5.0, *(36.0 + 61 * k for k in range(5))),
        (180.0, *(-360.0 * (-1) ** k for k in range(5))),
        6.0,
    ),
}


def turned_record(
    motion,
    *,
    length_s=300.0,
    rate_hz=25.0,
    latitude_deg=48.0,
    gyro_bias_deg_per_h=1.0,
    arw_deg_per_sqrt_h=0.02,
    accel_bias_ug=500.0,
    vrw_ug_per_sqrt_hz=50.0,
    seed=1,
):
    """Return the record of a body with pitch 1 and roll -2 deg, heading 35 deg before the turns.

    Its motion is one of `TURNS`, "parked", or begin, angle and rate of its turns.
    """
    turns = {"parked": ((), (), 1.0), **TURNS}[motion] if isinstance(motion, str) else motion
    gyro, accel, heading_deg = _without_errors(turns, length_s, rate_hz, latitude_deg)
    rng = np.random.default_rng(seed)
    direction = np.array([0.6, -0.64, 0.48])
    gyro_noise = arw_deg_per_sqrt_h * DEG / 60 * np.sqrt(rate_hz)
    accel_noise = vrw_ug_per_sqrt_hz * 1e-6 * G * np.sqrt(rate_hz)
    gyro_errors = gyro_noise * rng.normal(size=gyro.shape)
    accel_errors = accel_noise * rng.normal(size=accel.shape)
    return Turned(
        gyro + (gyro_bias_deg_per_h * DEG_PER_H * direction + gyro_errors),
        accel + (accel_bias_ug * 1e-6 * G * direction + accel_errors),
        heading_deg,
        rate_hz,
    )


@cache
def _without_errors(turns, length_s, rate_hz, latitude_deg):
    dt = 1 / rate_hz / SUBSTEPS
    time_s = (np.arange(round(length_s * rate_hz) * SUBSTEPS) + 0.5) * dt
    psi, psi_rate = turn_angle(time_s, *turns)
    yaw = psi - 35 * DEG
    attitude = Rotation.from_euler(
        "ZXY", np.column_stack([yaw, *([a * DEG] * len(yaw) for a in (1.0, -2.0))])
    )
    latitude = latitude_deg * DEG
    earth = EARTH_RATE * np.array([0.0, np.cos(latitude), np.sin(latitude)])
    rate = np.column_stack([np.zeros((len(psi), 2)), psi_rate]) + earth
    parts = attitude.inv().apply(rate), attitude.inv().apply([0.0, 0.0, G])
    gyro, accel = (p.reshape(-1, SUBSTEPS, 3).mean(axis=1) for p in parts)
    return gyro, accel, float((35 - psi[-1] / DEG) % 360)

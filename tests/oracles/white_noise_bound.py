"""The least heading error under white sensor noise on a base at rest, in closed form."""

import numpy as np


def white_noise_bound(stored_s, *, gyro_noise, accel_noise, rate_hz, gravity, rate_n):
    """sqrt(12 q_a/(g^2 T^3) + q_g/T)/omega_N, rad, from sigmas of single samples, SI units."""
    ramp = 12 * accel_noise**2 / (rate_hz * gravity**2 * stored_s**3)
    return np.sqrt(ramp + gyro_noise**2 / (rate_hz * stored_s)) / abs(rate_n)

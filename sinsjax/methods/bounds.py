"""What a stored record holds about the heading: theory to hold methods against.

On a base at rest, a heading error phi_U tilts a free platform at the constant rate
-omega_N phi_U - eps_E, and the north specific force is g phi_E + nabla_N + noise. So the heading,
from its floor -eps_E/omega_N, is the slope of a ramp in the force. Offset and start are unknown.

* Accelerometers with white noise of density q_a leave the slope of the tilt the variance of a
  straight line's, 12 q_a/(g^2 T^3).
* Gyros with white noise of density q_g turn the ramp into a random walk with a drift, whose
  variance is q_g/T: that of its two ends.

The least variance of an unbiased linear estimator is superadditive in the noise covariance, since
min w'(A + B)w >= min w'A w + min w'B w over the weights w that it may have. The sum is therefore a
bound, and close wherever one of the two noises dominates. Repeated passes add nothing. A
swing about a constant attitude is known from the gyros and turns the biases by too little to
matter.
"""

from typing import Any, TypeAlias

import numpy as np
from scipy import special

Number: TypeAlias = Any
"""A float, or a NumPy array that broadcasts."""


def record_bound(
    stored_s: Number,
    *,
    gyro_noise: Number,
    accel_noise: Number,
    rate_hz: Number,
    gravity: Number,
    rate_n: Number,
) -> np.ndarray:
    """1 sigma of the heading that white sensor noise leaves to any unbiased estimator, rad.

    sqrt(12 q_a/(g^2 T^3) + q_g/T)/omega_N. It is told from the heading's floor for constant biases,
    which no estimator gets rid of on a base that does not turn.

    Args:
        stored_s: length T of the data, s.
        gyro_noise: standard deviation of a sample of the east gyro, rad/s.
        accel_noise: standard deviation of a sample of the north accelerometer, m/s^2.
        rate_hz: samples a second, 1/s.
        gravity: g, m/s^2.
        rate_n: omega_N = omega_ie cos L, rad/s, not 0.

    Returns:
        Of the shape that the arguments broadcast to.
    """
    length = np.asarray(stored_s, float)
    ramp = 12 * np.square(accel_noise) / (rate_hz * np.square(gravity) * length**3)
    walk = np.square(gyro_noise) / (rate_hz * length)
    return np.asarray(np.sqrt(ramp + walk) / np.abs(rate_n))


def share_outside(sigma: Number, band: Number) -> np.ndarray:
    """Share of draws of a normal error that lie outside +-band: 2 (1 - Phi(band/sigma)).

    Args:
        sigma: standard deviation > 0, such as `record_bound`.
        band: half-width, in the same unit.
    """
    return np.asarray(special.erfc(np.asarray(band, float) / (np.sqrt(2) * np.asarray(sigma))))

"""An attitude between given ones: cubic splines of its Euler angles."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from sinsjax.strapdown.turns import AngleRates
from sinsjax.types import Array, Scalar


class AttitudePath(NamedTuple):
    """Cubic splines of pitch, roll and yaw.

    Attributes:
        time: (n,) knots, s, increasing.
        coefficients: (4, n - 1, 3) of the powers 3 to 0 of the time after each knot but the last,
            rad and s.
    """

    time: Array
    coefficients: Array

    def at(self, t: Scalar) -> tuple[AngleRates, AngleRates, AngleRates]:
        """Return pitch, roll and yaw with their derivatives at a time (s)."""
        time, knots = jnp.asarray(self.time), len(self.time)
        place = jnp.clip(jnp.searchsorted(time, t, side="right") - 1, 0, knots - 2)
        s = t - time[place]
        a, b, c, d = jnp.asarray(self.coefficients)[:, place]
        angles = ((a * s + b) * s + c) * s + d
        rates, accelerations = (3 * a * s + 2 * b) * s + c, 6 * a * s + 2 * b
        pitch, roll, yaw = (AngleRates(angles[i], rates[i], accelerations[i]) for i in range(3))
        return pitch, roll, yaw


def attitude_path(time_s: np.ndarray, attitude_deg: np.ndarray) -> AttitudePath:
    """Return the path through pitch, roll and yaw (n, 3), deg, at increasing times (n,), s.

    Jumps by whole turns are removed.
    """
    # Slow to import, and only a file needs it.
    from scipy.interpolate import CubicSpline

    angles = np.unwrap(np.radians(attitude_deg), axis=0)
    return AttitudePath(np.asarray(time_s, float), CubicSpline(time_s, angles).c)

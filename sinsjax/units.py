"""Conversion factors between the units people write and the SI units used inside.

Multiply by a factor to come inside, divide by it to go out: ``0.1 * DEG_PER_H`` is in rad/s.
"""

import math

STANDARD_GRAVITY = 9.80665
"""m/s^2; what an accelerometer datasheet's ug and a record's g mean unless the record says so."""

DEG = math.pi / 180
ARCMIN = DEG / 60
ARCSEC = DEG / 3600
HOUR = 3600.0
DEG_PER_H = DEG / HOUR
DEG_PER_SQRT_H = DEG / math.sqrt(HOUR)
PPM = 1e-6
MICRO = 1e-6


def micro_g(gravity: float = STANDARD_GRAVITY) -> float:
    """One ug in m/s^2, for a given g (m/s^2): the papers take their own g = 9.8."""
    return MICRO * gravity

"""Estimates as the prose of a page prints them."""

import numpy as np

from sinsjax.analysis.estimates import Estimate
from sinsjax.analysis.formats import format_difference, format_estimate


def seconds(time_s: Estimate, digits: int = 0) -> str:
    """A time with its interval, such as ``195 [181, 219] s``."""
    return format_estimate(time_s, "s", digits)


def arcmin(angle: Estimate, digits: int = 1) -> str:
    """An angle with its interval, such as ``1.2 [1.1, 1.3] arcmin``."""
    return format_estimate(angle, "arcmin", digits)


def heading(error_arcmin: Estimate) -> str:
    """A heading error without its unit, to a tenth where it is below 100 arcmin."""
    digits = 0 if error_arcmin.value >= 100 else 1
    return format_estimate(error_arcmin, digits=digits, infinite="no number")


def share(of_runs: Estimate) -> str:
    """A share with its interval, such as ``45 [43, 47] %``."""
    return f"{percent(of_runs)} %"


def apart(later_s: Estimate) -> str:
    """A difference of settling times without its sign: what is sooner or later, the prose says."""
    if np.isfinite(later_s.value) and later_s.value < 0:
        later_s = Estimate(-later_s.value, -later_s.high, -later_s.low, later_s.n)
    return format_difference(later_s, "s", 0)


def degrees(*angles_deg: float) -> str:
    """Angles as a misalignment is told: ``(5, 5, 30) deg``, or ``30 deg`` for one."""
    text = ", ".join(f"{angle:g}" for angle in angles_deg)
    return f"({text}) deg" if len(angles_deg) > 1 else f"{text} deg"


def percent(share: Estimate) -> str:
    """A share with its interval as a number of percent."""
    low, value, high = (100 * x for x in (share.low, share.value, share.high))
    return format_estimate(Estimate(value, low, high, share.n), digits=0)

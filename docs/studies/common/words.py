"""Estimates as the prose of a page prints them."""

import numpy as np

from sinsjax.analysis import Estimate, format_difference, format_estimate
from sinsjax.analysis.formats import format_percent


def seconds(time_s: Estimate, digits: int = 0) -> str:
    """A time with its interval, such as ``195 [181, 219] s``."""
    return format_estimate(time_s, "s", digits)


def arcmin(angle: Estimate, digits: int = 1) -> str:
    """An angle with its interval, such as ``1.2 [1.1, 1.3] arcmin``."""
    return format_estimate(angle, "arcmin", digits)


def share(of_runs: Estimate) -> str:
    """A share with its interval, such as ``45 [43, 47] %``."""
    return f"{format_percent(of_runs)} %"


def apart(later_s: Estimate) -> str:
    """A difference of settling times without its sign: what is sooner or later, the prose says."""
    if np.isfinite(later_s.value) and later_s.value < 0:
        later_s = Estimate(-later_s.value, -later_s.high, -later_s.low, later_s.n)
    return format_difference(later_s, "s", 0)

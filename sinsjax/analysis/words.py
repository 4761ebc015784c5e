"""Estimates as sentences and tables print them."""

from sinsjax.analysis.estimates import Estimate
from sinsjax.analysis.formats import format_estimate


def heading(error_arcmin: Estimate) -> str:
    """A heading error without its unit, to a tenth where it is below 100 arcmin."""
    digits = 0 if error_arcmin.value >= 100 else 1
    return format_estimate(error_arcmin, digits=digits, infinite="no number")


def degrees(*angles_deg: float) -> str:
    """Angles as a misalignment is told: ``(5, 5, 30) deg``, or ``30 deg`` for one."""
    text = ", ".join(f"{angle:g}" for angle in angles_deg)
    return f"({text}) deg" if len(angles_deg) > 1 else f"{text} deg"


def percent(share: Estimate) -> str:
    """A share with its interval as a number of percent."""
    low, value, high = (100 * x for x in (share.low, share.value, share.high))
    return format_estimate(Estimate(value, low, high, share.n), digits=0)

"""Estimates as text, with their intervals."""

import math

from sinsjax.analysis.estimates import Estimate

FEW_DRAWS = "few draws"
"""Words for an end of an interval that the draws are too few to bound."""


def format_estimate(
    estimate: Estimate,
    unit: str = "",
    digits: int = 1,
    infinite: str = "never",
    negative: str = "-never",
) -> str:
    """An estimate as text, such as ``12.3 [11.9, 12.8] s``.

    Args:
        estimate: estimate to write; infinite numbers become words, a value of NaN ``unknown``, and
            one end of NaN ``few draws``, since too few do not bound it. An interval with neither
            end known, or of infinite numbers alone, is omitted.
        unit: unit, written after the interval.
        digits: decimals.
        infinite: words for infinite numbers.
        negative: words for negative infinite numbers.
    """
    words = {"nan": FEW_DRAWS, "inf": infinite, "-inf": negative}
    printed = (f"{number:.{digits}f}" for number in estimate[:3])
    value, low, high = (words.get(text, text) for text in printed)
    if math.isinf(estimate.value) and value == low == high:
        return value
    interval = "" if low == high == FEW_DRAWS else f"[{low}, {high}] "
    return f"{'unknown' if math.isnan(estimate.value) else value} {interval}{unit}".rstrip()


def format_number(value: float | None, digits: int = 1) -> str:
    """A number as text; None and NaN are unknown."""
    return "unknown" if value is None or value != value else f"{value:.{digits}f}"


def format_time_difference(seconds: Estimate) -> str:
    """A difference of two settling times in whole seconds, or which of the two never settles."""
    value, low, high, n = seconds
    if math.isnan(value):
        return "neither settles" if n else "unknown"
    if math.isinf(value) and {low, high} <= {value, 0.0}:  # an end is 0 if neither settles
        seconds = Estimate(value, value, value, n)
    return format_estimate(seconds, "", 0, "it never settles", "the first never settles")


def format_heading_error(error_arcmin: Estimate) -> str:
    """A heading error without its unit, to a tenth where it is below 100 arcmin."""
    digits = 0 if error_arcmin.value >= 100 else 1
    return format_estimate(error_arcmin, digits=digits, infinite="no number")


def format_percent(share: Estimate) -> str:
    """A share with its interval as a number of percent."""
    low, value, high = (100 * x for x in (share.low, share.value, share.high))
    return format_estimate(Estimate(value, low, high, share.n), digits=0)

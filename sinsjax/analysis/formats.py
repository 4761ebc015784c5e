"""Estimates as text, with their intervals."""

import math

from sinsjax.analysis.estimates import Estimate


def format_estimate(estimate: Estimate, unit: str = "", digits: int = 1) -> str:
    """An estimate as text, such as ``12.3 [11.9, 12.8] s``.

    Args:
        estimate: what to write; infinite numbers become ``never``, NaN becomes ``unknown``, and an
            interval of which neither end is known is left out.
        unit: written after the interval if given.
        digits: decimals.
    """
    words = {"nan": "unknown", "inf": "never", "-inf": "-never"}
    printed = (f"{number:.{digits}f}" for number in estimate[:3])
    value, low, high = (words.get(text, text) for text in printed)
    interval = "" if low == high == words["nan"] else f"[{low}, {high}] "
    return f"{value} {interval}{unit}".rstrip()


def format_difference(
    estimate: Estimate,
    unit: str = "",
    digits: int = 1,
    sides: tuple[str, str] = ("one side", "one side"),
) -> str:
    """A difference of two settling times as text: what never settles is told in words.

    Such as ``12.3 [11.9, 12.8] s``, ``one side never settles`` or ``neither settles``.

    Args:
        estimate: of :func:`sinsjax.analysis.quantile_difference`; NaN of some pairs means that
            neither settles.
        unit: written after the interval if given.
        digits: decimals.
        sides: what was compared, the one that the other is taken from first.
    """
    value, low, high = map(float, estimate[:3])
    if math.isnan(value):
        return "neither settles" if estimate.n else "unknown"

    def text(number: float) -> str:
        if math.isinf(number):
            return f"{sides[0] if number > 0 else sides[1]} never settles"
        return "unknown" if math.isnan(number) else f"{number:.{digits}f}"

    if math.isinf(value) and {low, high} <= {value, 0.0}:  # ends at 0 where neither settles
        return text(value)
    return f"{text(value)} [{text(low)}, {text(high)}] {unit}".rstrip()

"""Statistics over the summary table, each with its 95 % interval.

`estimates` are single numbers over some runs, `differences` those between runs on the same noise,
`tables` and `summaries` what is made of a whole summary.
"""

from sinsjax.analysis.differences import difference, proportion_difference, quantile_difference
from sinsjax.analysis.estimates import (
    CONFIDENCE,
    UNKNOWN,
    Estimate,
    chi2_mean_band,
    format_difference,
    format_estimate,
    mean,
    proportion,
    quantile,
    rms,
    std,
)
from sinsjax.analysis.summaries import NEES_FREEDOM, compare, summarise
from sinsjax.analysis.tables import groups, has_status, has_truth, numbers, paired

__all__ = [
    "CONFIDENCE",
    "NEES_FREEDOM",
    "UNKNOWN",
    "Estimate",
    "chi2_mean_band",
    "compare",
    "difference",
    "format_difference",
    "format_estimate",
    "groups",
    "has_status",
    "has_truth",
    "mean",
    "numbers",
    "paired",
    "proportion",
    "proportion_difference",
    "quantile",
    "quantile_difference",
    "rms",
    "std",
    "summarise",
]

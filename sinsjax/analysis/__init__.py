"""Statistics over the summary table, each with its 95 % interval.

`clusters` determines which runs are dependent. `bounded` has the intervals of shares and quantiles
over draws. `estimates` computes statistics of some runs,
`differences` those between runs on the same noise, and `summaries` tables of them from a whole
summary, with the help of `tables`; `headings` has those of the heading error, time by time. `grids`
lays runs out over the axes of a study. `formats` and `words` print estimates.
"""

from sinsjax.analysis.clusters import NO_INTERVAL, are_single, clusters_of
from sinsjax.analysis.differences import (
    chance_apart,
    difference,
    proportion_difference,
    quantile_difference,
)
from sinsjax.analysis.estimates import (
    CONFIDENCE,
    UNKNOWN,
    Estimate,
    chi2_mean_band,
    mean,
    proportion,
    quantile,
    rms,
    share,
    std,
)
from sinsjax.analysis.formats import FEW_DRAWS, format_difference, format_estimate, format_number
from sinsjax.analysis.headings import heading_errors
from sinsjax.analysis.summaries import NEES_FREEDOM, compare, summarise
from sinsjax.analysis.tables import groups, has_status, has_truth, numbers, paired

__all__ = [
    "CONFIDENCE",
    "FEW_DRAWS",
    "NEES_FREEDOM",
    "NO_INTERVAL",
    "UNKNOWN",
    "Estimate",
    "are_single",
    "chance_apart",
    "chi2_mean_band",
    "clusters_of",
    "compare",
    "difference",
    "format_difference",
    "format_estimate",
    "format_number",
    "groups",
    "has_status",
    "has_truth",
    "heading_errors",
    "mean",
    "numbers",
    "paired",
    "proportion",
    "proportion_difference",
    "quantile",
    "quantile_difference",
    "rms",
    "share",
    "std",
    "summarise",
]

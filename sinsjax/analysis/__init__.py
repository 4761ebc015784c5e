"""Statistics over the summary table, each with its 95 % interval.

`estimates` computes statistics of some runs and differences between runs on the same noise, whose
intervals over draws are in `bounds`. `summaries` makes the long table `Estimates` from a whole
summary, using `tables`. `grids` lays runs out over the axes of a study. `formats` prints estimates.
"""

from sinsjax.analysis.estimates import (
    UNKNOWN,
    Estimate,
    cluster_ids,
    mean,
    mean_difference,
    proportion_difference,
    quantile,
    quantile_difference,
    rms,
    share,
)
from sinsjax.analysis.formats import FEW_DRAWS, format_estimate, format_number
from sinsjax.analysis.summaries import (
    NEES_FREEDOM,
    Estimates,
    compare_with_baseline,
    estimate_groups,
    summarise,
)
from sinsjax.analysis.tables import group_rows, numeric_column, pair_by_draw, status_mask

__all__ = [
    "FEW_DRAWS",
    "NEES_FREEDOM",
    "UNKNOWN",
    "Estimate",
    "Estimates",
    "cluster_ids",
    "compare_with_baseline",
    "estimate_groups",
    "format_estimate",
    "format_number",
    "group_rows",
    "mean",
    "mean_difference",
    "numeric_column",
    "pair_by_draw",
    "proportion_difference",
    "quantile",
    "quantile_difference",
    "rms",
    "share",
    "status_mask",
    "summarise",
]

"""Statistics over the summary table, each with its 95 % interval.

`estimates` computes statistics of some runs and differences between runs on the same noise, whose
intervals over draws are in `bounds`. `summaries` makes the long table `Estimates` from a whole
summary, using `tables`. `grids` lays runs out over the axes of a study. `formats` prints estimates.
"""

from sinsjax.analysis.estimates import (
    CONFIDENCE,
    UNKNOWN,
    Estimate,
    chi2_mean_band,
    cluster_ids,
    has_independent_runs,
    mean,
    mean_difference,
    proportion,
    proportion_difference,
    quantile,
    quantile_difference,
    rms,
    share,
    std,
)
from sinsjax.analysis.formats import FEW_DRAWS, format_difference, format_estimate, format_number
from sinsjax.analysis.summaries import (
    NEES_FREEDOM,
    Estimates,
    compare_with_baseline,
    estimate_groups,
    summarise,
)
from sinsjax.analysis.tables import group_rows, has_truth, numeric_column, pair_by_draw, status_mask

__all__ = [
    "CONFIDENCE",
    "FEW_DRAWS",
    "NEES_FREEDOM",
    "UNKNOWN",
    "Estimate",
    "Estimates",
    "has_independent_runs",
    "chi2_mean_band",
    "cluster_ids",
    "compare_with_baseline",
    "mean_difference",
    "estimate_groups",
    "format_difference",
    "format_estimate",
    "format_number",
    "group_rows",
    "status_mask",
    "has_truth",
    "mean",
    "numeric_column",
    "pair_by_draw",
    "proportion",
    "proportion_difference",
    "quantile",
    "quantile_difference",
    "rms",
    "share",
    "std",
    "summarise",
]

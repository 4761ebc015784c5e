"""Statistics over the summary table, each with its 95 % interval.

`clusters` determines which runs are dependent. `bounds` has the intervals of shares and quantiles
over draws. `estimates` computes statistics of some runs,
`differences` compares runs on the same noise, and `summaries` makes tables from a whole
summary, using `tables`; `headings` has the heading errors at report times. `grids`
lays runs out over the axes of a study. `formats` prints estimates.
"""

from sinsjax.analysis.clusters import NO_INTERVAL, cluster_ids, has_independent_runs
from sinsjax.analysis.differences import (
    mean_difference,
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
from sinsjax.analysis.headings import heading_error_statistics
from sinsjax.analysis.summaries import NEES_FREEDOM, compare_with_baseline, summarise
from sinsjax.analysis.tables import group_rows, has_truth, numeric_column, pair_by_draw, status_mask

__all__ = [
    "CONFIDENCE",
    "FEW_DRAWS",
    "NEES_FREEDOM",
    "NO_INTERVAL",
    "UNKNOWN",
    "Estimate",
    "has_independent_runs",
    "chi2_mean_band",
    "cluster_ids",
    "compare_with_baseline",
    "mean_difference",
    "format_difference",
    "format_estimate",
    "format_number",
    "group_rows",
    "status_mask",
    "has_truth",
    "heading_error_statistics",
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

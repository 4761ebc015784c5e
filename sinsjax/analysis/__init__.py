"""Statistics over the summary table, each with its 95 % interval.

`estimates` computes statistics of some runs and differences between runs on the same noise.
`summaries` makes the long table `Estimates` from a whole summary, using `tables`, which also lays
runs out over the axes of a study. `labels` has keys and estimates in words.
"""

from sinsjax.analysis.estimates import (
    UNKNOWN,
    Estimate,
    draw_id_clusters,
    mean,
    mean_difference,
    proportion_difference,
    quantile,
    quantile_difference,
    rms,
    share,
)
from sinsjax.analysis.labels import format_estimate
from sinsjax.analysis.summaries import (
    Estimates,
    compare_with_baseline,
    estimate_groups,
    summarise,
)
from sinsjax.analysis.tables import Grid, group_rows, numeric_column, pair_by_draw

__all__ = [
    "UNKNOWN",
    "Estimate",
    "Estimates",
    "Grid",
    "draw_id_clusters",
    "compare_with_baseline",
    "estimate_groups",
    "format_estimate",
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
    "summarise",
]

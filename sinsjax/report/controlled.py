"""What companions save: expected settling times, from draws alone and with companions."""

from collections.abc import Iterator

import numpy as np

from sinsjax import analysis, columns
from sinsjax.analysis import format_estimate
from sinsjax.analysis.controlled import mean_over_variants
from sinsjax.execution.estimates import read_estimates
from sinsjax.execution.source import Source
from sinsjax.report.base import Table, table_of
from sinsjax.report.over_axes import is_chosen
from sinsjax.study.success import success_of, yardsticks
from sinsjax.study.swept import shown_keys
from sinsjax.study.times import spans_s

_MOST = 10


def tables(source: Source) -> Iterator[Table]:
    """The settings with the shortest expected settling times, over all that is not chosen."""
    study = source.study
    band, keys = success_of(study).band_arcmin, shown_keys(study)
    chosen = [key for key in keys if is_chosen(key)]
    given = [key for key in keys if key not in chosen]
    yard = yardsticks(study)[0]
    column = columns.settle_column(band, truth=yard.truth).name
    draws = source.rows([*chosen, "variant_id", "draw_id", column, f"companion_{column}"])
    mean, error = (c.name for c in columns.settle_estimates(band, truth=yard.truth)[:2])
    known = read_estimates(source.directory, [mean, error])
    if known[mean].null_count:
        return
    expected = [known[name].to_numpy() for name in (mean, error)]
    ends = spans_s(study)[:, 0]
    points = [
        point | {"found": mean_over_variants(rows, column, expected, ends)}
        for point, rows in analysis.groups(draws, chosen)
    ]
    points.sort(key=lambda one: one["found"].controlled.value)
    over = f", mean over {' and '.join(given)}" if given else ""
    yield table_of(
        f"The soonest {yard.words}{over}, with companions",
        chosen,
        points,
        [
            ("mean time (s), draws alone", lambda row: format_estimate(row["found"].plain)),
            ("with companions", lambda row: format_estimate(row["found"].controlled)),
            ("times as many draws saved", lambda row: _factor(row["found"].saved)),
        ],
        "Never counts as the length of the run [95 % interval; with companions the error of their"
        " expectation is in it]. Medians and quantiles elsewhere are of the draws alone.",
        most=_MOST,
        left="settings are not shown",
    )


def _factor(saved: float) -> str:
    return "unknown" if np.isnan(saved) else f"{saved:.1f}"

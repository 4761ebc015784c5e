"""What companions save: expected settling times, from draws alone and with companions."""

from collections.abc import Iterator

from sinsjax import analysis, columns
from sinsjax.analysis import format_estimate, format_number
from sinsjax.analysis.controlled import mean_over_variants
from sinsjax.execution.estimates import read_estimates
from sinsjax.execution.source import Source
from sinsjax.report.base import Table, table_of
from sinsjax.study.keys import is_chosen
from sinsjax.study.success import success_of, yardsticks
from sinsjax.study.swept import shown_keys
from sinsjax.study.times import spans_s


def tables(source: Source) -> Iterator[Table]:
    """The settings with the shortest expected settling times, over all that is not chosen."""
    study = source.study
    band, keys = success_of(study).band_arcmin, shown_keys(study)
    chosen, yard = [key for key in keys if is_chosen(key)], yardsticks(study)[0]
    given = [key for key in keys if key not in chosen]
    column = columns.settle_column(band, truth=yard.truth).name
    draws = source.rows([*chosen, "variant_id", "draw_id", column, f"companion_{column}"])
    mean, error = (c.name for c in columns.settle_estimates(band, truth=yard.truth)[:2])
    known = read_estimates(source.directory, [mean, error])
    if known[mean].null_count:
        return
    expected, ends = [known[name].to_numpy() for name in (mean, error)], spans_s(study)[:, 0]
    found = analysis.groups(draws, chosen)
    points = [point | {"of": mean_over_variants(g, column, expected, ends)} for point, g in found]
    points.sort(key=lambda one: one["of"].controlled.value)
    over = f", mean over {' and '.join(given)}" if given else ""
    yield table_of(
        f"The soonest {yard.words}{over}, with companions",
        chosen,
        points,
        [
            ("mean time (s), draws alone", lambda row: format_estimate(row["of"].plain)),
            ("with companions", lambda row: format_estimate(row["of"].controlled)),
            ("times as many draws saved", lambda row: format_number(row["of"].saved)),
        ],
        "Never counts as the length of the run [95 % interval; with companions the error of their"
        " expectation is in it]. Medians and quantiles elsewhere are of the draws alone.",
        most=10,
        left="settings are not shown",
    )

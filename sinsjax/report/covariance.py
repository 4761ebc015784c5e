"""The report of a study that is estimated without draws: its best settings, and the axes."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis, columns, plots
from sinsjax.analysis import UNKNOWN, Estimate, format_estimate, format_number
from sinsjax.execution.source import Source
from sinsjax.messages import format_count
from sinsjax.report.axis_figures import HeatMaps, repeated_variants_note
from sinsjax.report.base import Block, Fact, Picture, Report, Table, Verdict, build_table
from sinsjax.report.choices import Choices
from sinsjax.report.grouping import describe_undrawn_lines, rows_by_line
from sinsjax.report.markup import render_sentence
from sinsjax.report.verdict import process_noise_caution, warning_facts
from sinsjax.study.keys import is_method_setting
from sinsjax.study.success import SuccessMeasure, success_criteria, success_measures

_MAX_SETTINGS = 10
_Z_95 = 1.96  # 95 % interval, standard errors
_YAW, _SIGMA, _OWN = "phi_u_arcmin", "true_sigma_u_arcmin", "sigma_u_arcmin"
_CHECKED = ("nonlinearity", "filled_by_draws")
_TIMES = (
    "Mean time: where the heading never stays in the band, the length of the run counts [95 %"
    " interval over the sampled errors]."
)
_SIGMAS = "1 sigma: of the true heading error about its mean, and the filter's own, at the end."

Row = Mapping[str, Any]
Cell = tuple[str, Callable[[Row], str]]


class _EstimateColumns(NamedTuple):
    """A criterion of success, and its columns of the estimates."""

    criterion: SuccessMeasure
    mean: str
    error: str
    q10: str
    median: str
    q90: str
    within: str

    def expected_settling(self, row: Row) -> Estimate:
        """The expected settling time of a variant."""
        return _normal_estimate(row[self.mean], row[self.error])

    def format_quantiles(self, row: Row) -> str:
        """Return the times by which 10, 50 and 90 % of the runs have settled, as text."""
        times = (row[name] for name in (self.q10, self.median, self.q90))
        return ", ".join("never" if time is None else f"{time:.0f}" for time in times)

    @property
    def table_cells(self) -> list[Cell]:
        """Headers and formats of the columns of a table of variants."""
        words = self.criterion.description
        return [
            (f"mean time to {words} (s)", lambda row: format_estimate(self.expected_settling(row))),
            ("10, 50, 90 % of runs by (s)", self.format_quantiles),
            (f"{words} at the end (%)", lambda row: format_number(row[self.within], 0, 100.0)),
        ]


def build_report(
    source: Source, *, with_tables: bool = True, warnings_shown: bool = False
) -> Report:
    """The verdict, figures over the axes, and all tables if they are wanted.

    Args:
        source: the estimates.
        with_tables: whether to make the tables.
        warnings_shown: whether the user has seen the study's warnings.

    Raises:
        InputError: variants are missing.
    """
    assert source.draws  # raises if variants are missing
    criteria = _usable_estimate_columns(source)
    parts: dict[str, Sequence[Block]] = {
        "Figures": [
            block
            for columns_of_criterion in criteria
            for block in _axis_figures(source, columns_of_criterion, criteria[0])
        ]
    }
    if with_tables:
        best = [
            block
            for columns_of_criterion in criteria[:1]
            for block in _best_settings_table(source, columns_of_criterion)
        ]
        parts["Tables"] = [
            *best,
            *repeated_variants_note(source),
            _all_variants_table(source, criteria),
        ]
    study = source.study
    variants = format_count(study.n_variants, "variant")
    title = f"{study.name}: {variants} by covariance analysis, without draws"
    expected = _ExpectedSettling.from_source(source, criteria[0])
    facts = [*_answer_facts(expected, criteria[0].criterion), *_linearity_fact(source)]
    doubts = [*warning_facts(source, warnings_shown=warnings_shown), *process_noise_caution(source)]
    verdict = Verdict(title, [*facts, *doubts], _condition_table(expected))
    return Report.from_parts(verdict, parts, f"{study.name}: {variants}, no Monte Carlo runs")


class _ExpectedSettling(NamedTuple):
    """The estimates of a study over its options and conditions.

    Attributes:
        choices: the options and conditions.
        mean_s: (options, conditions) expected settling time, s; NaN if it is unknown.
        error_s: its standard error over the sampled errors, s.
        within: probability of the band at the end.
        heading: rms heading error from the truth at the end, arcmin.
    """

    choices: Choices
    mean_s: NDArray
    error_s: NDArray
    within: NDArray
    heading: NDArray

    @classmethod
    def from_source(
        cls, source: Source, criterion_columns: _EstimateColumns
    ) -> "_ExpectedSettling":
        choices = Choices.from_study(source.study)
        columns = (
            criterion_columns.mean,
            criterion_columns.error,
            criterion_columns.within,
            _YAW,
            _SIGMA,
        )
        rows = source.rows(columns)
        mean, error, within, yaw, sigma = (
            choices.arrange_runs(analysis.numeric_column(rows, name))[..., 0] for name in columns
        )
        return cls(choices, mean, error, within, np.hypot(yaw, sigma))

    def best_option(
        self, options: Sequence[int] | None = None, conditions: Sequence[int] | slice = slice(None)
    ) -> int:
        """The option with the shortest expected settling time, averaged over the conditions."""
        candidates = list(range(len(self.mean_s)) if options is None else options)
        mean_s = self.mean_s[candidates][:, conditions].mean(axis=1)
        return candidates[int(np.argmin(np.nan_to_num(mean_s, nan=np.inf)))]

    def format_settling(self, option: int, conditions: Sequence[int] | slice = slice(None)) -> str:
        """The expected settling time of an option in some conditions, on average."""
        mean, error = self.mean_s[option, conditions], self.error_s[option, conditions]
        return format_estimate(_normal_estimate(float(mean.mean()), float(error.mean())), digits=0)


def _answer_facts(expected: _ExpectedSettling, criterion: SuccessMeasure) -> Iterator[Fact]:
    """Yield the best option, its rivals, and its accuracy."""
    words, best = expected.choices.options, expected.best_option()
    least = 100 * float(expected.within[best].min())
    share = "all settle" if least > 99.95 else f"at least {least:.0f} % settle"
    text = f"{expected.format_settling(best)} s expected, {share}"
    if len(words) == 1:
        yield Fact("Settling", text)
    else:
        yield Fact("Best", f"{words[best]}: {text}")
        rivals = map(expected.best_option, expected.choices.rival_options(best))
        yield Fact(
            "Others", "; ".join(f"{words[i]}: {expected.format_settling(i)} s" for i in rivals)
        )
    heading = float(np.sqrt(np.mean(expected.heading[best] ** 2)))
    yield Fact("Accuracy", f"{heading:.1f}' rms expected from true north at the end")
    yield Fact("Settled", f"{criterion.description}; never counts as the length of the run")


def _condition_table(expected: _ExpectedSettling) -> Table | None:
    """The best option at each point of the condition that matters most."""
    choices, best = expected.choices, expected.best_option()
    axis = choices.most_influential_axis(expected.mean_s[best])
    if axis is None:
        return None

    def format_row(conditions: list[int]) -> list[str]:
        if len(choices.options) == 1:
            within = 100 * float(expected.within[0, conditions].min())
            error = float(np.sqrt(np.mean(expected.heading[0, conditions] ** 2)))
            return [f"{within:.0f}", expected.format_settling(0, conditions), f"{error:.1f}"]
        best_here = expected.best_option(conditions=conditions)
        without_reset = choices.options_without_reset
        rival = expected.best_option(without_reset, conditions) if without_reset else best
        times = [expected.format_settling(option, conditions) for option in (best_here, rival)]
        return [choices.options[best_here], *times]

    return choices.condition_table(axis, format_row, "expected after")


def _linearity_fact(source: Source) -> Iterator[Fact]:
    """Yield how far covariance analysis is valid."""
    if source.study.checks_linearity:
        index, filled = (
            analysis.numeric_column(source.distinct_rows([name]), name) for name in _CHECKED
        )
        largest = f"{np.nanmax(index):.2f}" if np.isfinite(index).any() else "unknown"
        beyond = int(np.nansum(filled))
        text = render_sentence("linearity", largest=largest, beyond=beyond, variants=len(filled))
        yield Fact("Linearity", text, is_caution=beyond > 0)


def _format_nonlinearity(row: Row) -> str:
    return format_number(row["nonlinearity"], 2) + (
        ", from draws" if row["filled_by_draws"] else ""
    )


def _usable_estimate_columns(source: Source) -> list[_EstimateColumns]:
    """Return the criteria that some variant can be judged by, that of the study first."""
    band, found = success_criteria(source.study).band_arcmin, []
    for yard in success_measures(source.study):
        settled = [c.name for c in columns.settle_estimate_columns(band, truth=yard.truth)]
        within = f"within_{band:g}{'_truth' if yard.truth else ''}_share"
        found.append(_EstimateColumns._make([yard, *settled, within]))
    table = source.rows([one.mean for one in found])
    return [one for one in found if table[one.mean].null_count < table.num_rows]


def _normal_estimate(value: float | None, standard_error: float | None) -> Estimate:
    """An estimate with a standard error."""
    if value is None or standard_error is None:
        return UNKNOWN
    return Estimate(value, value - _Z_95 * standard_error, value + _Z_95 * standard_error, 1)


def _best_settings_table(source: Source, criterion_columns: _EstimateColumns) -> Iterator[Table]:
    """The settings with the shortest expected settling times, over all that is not chosen."""
    keys = source.study.keys_shown
    chosen = [key for key in keys if is_method_setting(key)]
    if not chosen:
        return
    condition_keys = [key for key in keys if key not in chosen]
    needed = (criterion_columns.mean, criterion_columns.error, criterion_columns.within, _SIGMA)
    table = source.distinct_rows([*keys, *needed])
    points = []
    for point, rows in analysis.group_rows(table, chosen):
        time, error, share, sigma = (
            analysis.numeric_column(rows, name) for name in rows.column_names[-4:]
        )
        statistics = {
            "mean": _normal_estimate(time.mean(), error.mean()),
            "longest": time.max(),
            "least": 100 * share.min(),
            "sigma": np.sqrt(np.mean(sigma**2)),
        }
        points.append(point | statistics)
    points.sort(key=lambda row: (np.isnan(row["mean"].value), row["mean"].value))
    words, over = (
        criterion_columns.criterion.description,
        f", mean over {' and '.join(condition_keys)}" if condition_keys else "",
    )
    worst: list[Cell] = [
        ("longest (s)", lambda row: f"{row['longest']:.0f}"),
        ("least share within it at the end (%)", lambda row: f"{row['least']:.0f}"),
    ]
    yield build_table(
        f"The soonest {words}{over}",
        chosen,
        points,
        [
            (f"mean time to {words} (s)", lambda row: format_estimate(row["mean"])),
            *(worst if condition_keys else []),
            ("1 sigma at the end, rms (arcmin)", lambda row: f"{row['sigma']:.1f}"),
        ],
        _TIMES,
        max_rows=_MAX_SETTINGS,
        remainder="settings are not shown",
    )


def _all_variants_table(source: Source, criteria: Sequence[_EstimateColumns]) -> Table:
    keys = source.study.keys_shown
    needed = [name for criterion in criteria for name in criterion[1:]]
    cells = [
        *(cell for criterion in criteria for cell in criterion.table_cells),
        ("phi_u, mean (arcmin)", lambda row: format_number(row[_YAW])),
        ("1 sigma (arcmin)", lambda row: format_number(row[_SIGMA])),
        ("the filter's own (arcmin)", lambda row: format_number(row[_OWN])),
    ]
    if source.study.checks_linearity:
        cells.append(("index of nonlinearity", _format_nonlinearity))
        needed += _CHECKED
    rows = source.distinct_rows([*keys, *needed, _YAW, _SIGMA, _OWN]).to_pylist()
    remainder = "variants are in `estimates/`"
    return build_table(
        "Every variant", keys, rows, cells, f"{_TIMES} {_SIGMAS}", remainder=remainder
    )


def _axis_figures(
    source: Source, criterion_columns: _EstimateColumns, main_criterion: _EstimateColumns
) -> Iterator[Picture]:
    """Over the first two axes of numbers heat maps, along a single one curves."""
    axes, line_keys = source.study.figure_axes
    if len(axes) == 2:
        yield from _heat_map_figures(
            source,
            criterion_columns,
            criterion_columns.criterion.figure_suffix(main_criterion.criterion),
        )
    elif axes and criterion_columns is main_criterion:
        yield _axis_curve_figure(source, criterion_columns, *axes.popitem(), line_keys)


def _heat_map_figures(
    source: Source, criterion_columns: _EstimateColumns, name_suffix: str
) -> Iterator[Picture]:
    """Yield the maps by one criterion of success, without those that show nothing."""
    words, of_floor = (
        criterion_columns.criterion.description,
        criterion_columns.within.replace("_truth", ""),
    )
    maps = HeatMaps(
        source, (criterion_columns.mean, criterion_columns.within, of_floor, "phi_u_arcmin")
    )
    within = np.round(100 * maps.column_values(criterion_columns.within))
    either = np.fmin(maps.column_values(criterion_columns.within), maps.column_values(of_floor))
    if not np.round(100 * either).any():
        return  # no cell is within the band, or cells only pass through it
    if plots.values_differ(maps.column_values(criterion_columns.mean)):
        yield maps.draw_figure(
            f"settling_time{name_suffix}",
            f"Expected time until the heading stays {words}; where it never does, the length of the"
            " run counts.",
            criterion_columns.mean,
        )
    if not np.isin(within, (0.0, 100.0)).all():
        yield maps.draw_figure(
            f"within_band{name_suffix}",
            f"Probability that the heading is {words} at the end of the run.",
            criterion_columns.within,
        )


def _axis_curve_figure(
    source: Source,
    criterion_columns: _EstimateColumns,
    axis: str,
    values: Sequence[float],
    line_keys: Sequence[str],
) -> Picture:
    needed = [*line_keys, criterion_columns.mean, criterion_columns.error, _YAW, _SIGMA, _OWN, axis]
    table = source.rows(needed)
    lines = rows_by_line(table, line_keys)

    def panel(estimate: Callable[[Row], Estimate]) -> dict[str, list[Estimate]]:
        return {name: [estimate(row) for row in rows.to_pylist()] for name, rows in lines.items()}

    def exact(name: str) -> dict[str, list[Estimate]]:
        return panel(lambda row: _normal_estimate(row[name], 0.0))

    panels = {
        f"expected time (s) to {criterion_columns.criterion.description}": panel(
            criterion_columns.expected_settling
        ),
        "1 sigma of the true heading error at the end (arcmin)": exact(_SIGMA),
        "the filter's own 1 sigma at the end (arcmin)": exact(_OWN),
    }
    return Picture(
        "along_axis",
        "When the heading has entered the band for good [95 % interval over the sampled errors],"
        " and how far the true heading error spreads at the end beside what the filter believes."
        f"{describe_undrawn_lines(table, line_keys)}",
        plots.draw_along_axis(axis, values, panels, condition=not is_method_setting(axis)),
    )

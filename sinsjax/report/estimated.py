"""The report of a study that is estimated without draws: its best settings, and the axes."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis, columns, plots
from sinsjax.analysis import UNKNOWN, Estimate, format_estimate, format_number
from sinsjax.execution.source import Source
from sinsjax.messages import counted
from sinsjax.report.base import Block, Fact, Picture, Report, Table, Verdict, table_of
from sinsjax.report.choices import Choices
from sinsjax.report.groupings import lines_left, lines_of
from sinsjax.report.markup import said
from sinsjax.report.over_axes import Maps, repeats
from sinsjax.report.verdict import q_doubt, warnings_of
from sinsjax.study.keys import is_method_setting
from sinsjax.study.success import SuccessMeasure, success_criteria, success_measures

_MOST_BEST = 10
_NORMAL = 1.96  # 95 % interval, standard errors
_YAW, _SIGMA, _OWN = "phi_u_arcmin", "true_sigma_u_arcmin", "sigma_u_arcmin"
_CHECKED = ("nonlinearity", "filled_by_draws")
_TIMES = (
    "Mean time: where the heading never stays in the band, the length of the run counts [95 %"
    " interval over the sampled errors]."
)
_SIGMAS = "1 sigma: of the true heading error about its mean, and the filter's own, at the end."

Row = Mapping[str, Any]
Cell = tuple[str, Callable[[Row], str]]


class _Names(NamedTuple):
    """A yardstick, and its columns of the estimates."""

    yard: SuccessMeasure
    mean: str
    error: str
    q10: str
    median: str
    q90: str
    within: str

    def settling(self, row: Row) -> Estimate:
        """The expected settling time of a variant."""
        return _interval(row[self.mean], row[self.error])

    def quantiles(self, row: Row) -> str:
        """When 10, 50 and 90 % of the runs have settled."""
        times = (row[name] for name in (self.q10, self.median, self.q90))
        return ", ".join("never" if time is None else f"{time:.0f}" for time in times)

    @property
    def cells(self) -> list[Cell]:
        """What a table tells of a variant."""
        words = self.yard.description
        return [
            (f"mean time to {words} (s)", lambda row: format_estimate(self.settling(row))),
            ("10, 50, 90 % of runs by (s)", self.quantiles),
            (f"{words} at the end (%)", lambda row: format_number(row[self.within], 0, 100.0)),
        ]


def report(source: Source, *, full: bool = True, warned: bool = False) -> Report:
    """The verdict, figures over the axes, and all tables if they are wanted.

    Args:
        source: the estimates.
        full: whether to make the tables.
        warned: whether the user has seen the study's warnings.

    Raises:
        InputError: variants are missing.
    """
    assert source.draws  # of which none is missing, or that is told
    found = _yards(source)
    parts: dict[str, Sequence[Block]] = {
        "Figures": [block for one in found for block in _figures(source, one, found[0])]
    }
    if full:
        best = [block for one in found[:1] for block in _best(source, one)]
        parts["Tables"] = [*best, *repeats(source), _every_variant(source, found)]
    study = source.study
    variants = counted(study.n_variants, "variant")
    title = f"{study.name}: {variants} by covariance analysis, without draws"
    expected = _Expected.from_source(source, found[0])
    facts = [*_answer(expected, found[0].yard), *_linearity(source)]
    doubts = [*warnings_of(source, warned=warned), *q_doubt(source)]
    verdict = Verdict(title, [*facts, *doubts], _per_condition(expected))
    return Report.of(verdict, parts, f"{study.name}: {variants}, no Monte Carlo runs")


class _Expected(NamedTuple):
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
    def from_source(cls, source: Source, names: _Names) -> "_Expected":
        choices = Choices.from_study(source.study)
        columns = (names.mean, names.error, names.within, _YAW, _SIGMA)
        rows = source.rows(columns)
        mean, error, within, yaw, sigma = (
            choices.runs(analysis.numbers(rows, name))[..., 0] for name in columns
        )
        return cls(choices, mean, error, within, np.hypot(yaw, sigma))

    def best(
        self, options: Sequence[int] | None = None, conditions: Sequence[int] | slice = slice(None)
    ) -> int:
        """The option with the shortest expected settling time, averaged over the conditions."""
        wanted = list(range(len(self.mean_s)) if options is None else options)
        mean_s = self.mean_s[wanted][:, conditions].mean(axis=1)
        return wanted[int(np.argmin(np.nan_to_num(mean_s, nan=np.inf)))]

    def settling(self, option: int, conditions: Sequence[int] | slice = slice(None)) -> str:
        """The expected settling time of an option in some conditions, on average."""
        mean, error = self.mean_s[option, conditions], self.error_s[option, conditions]
        return format_estimate(_interval(float(mean.mean()), float(error.mean())), digits=0)


def _answer(expected: _Expected, yard: SuccessMeasure) -> Iterator[Fact]:
    """The best option, what it is compared with, and its accuracy."""
    words, best = expected.choices.options, expected.best()
    least = 100 * float(expected.within[best].min())
    share = "all settle" if least > 99.95 else f"at least {least:.0f} % settle"
    text = f"{expected.settling(best)} s expected, {share}"
    if len(words) == 1:
        yield Fact("Settling", text)
    else:
        yield Fact("Best", f"{words[best]}: {text}")
        rivals = map(expected.best, expected.choices.rivals(best))
        yield Fact("Others", "; ".join(f"{words[i]}: {expected.settling(i)} s" for i in rivals))
    heading = float(np.sqrt(np.mean(expected.heading[best] ** 2)))
    yield Fact("Accuracy", f"{heading:.1f}' rms expected from true north at the end")
    yield Fact("Settled", f"{yard.description}; never counts as the length of the run")


def _per_condition(expected: _Expected) -> Table | None:
    """The best option at each point of the condition that matters most."""
    choices, best = expected.choices, expected.best()
    axis = choices.axis_that_matters(expected.mean_s[best])
    if axis is None:
        return None

    def row(conditions: list[int]) -> list[str]:
        if len(choices.options) == 1:
            within = 100 * float(expected.within[0, conditions].min())
            error = float(np.sqrt(np.mean(expected.heading[0, conditions] ** 2)))
            return [f"{within:.0f}", expected.settling(0, conditions), f"{error:.1f}"]
        own = expected.best(conditions=conditions)
        none = choices.without_reset
        rival = expected.best(none, conditions) if none else best
        times = [expected.settling(option, conditions) for option in (own, rival)]
        return [choices.options[own], *times]

    return choices.table(axis, row, "expected after")


def _linearity(source: Source) -> Iterator[Fact]:
    """How far covariance analysis holds."""
    if source.study.checks_linearity:
        index, filled = (analysis.numbers(source.distinct_rows([name]), name) for name in _CHECKED)
        largest = f"{np.nanmax(index):.2f}" if np.isfinite(index).any() else "unknown"
        beyond = int(np.nansum(filled))
        text = said("linearity", largest=largest, beyond=beyond, variants=len(filled))
        yield Fact("Linearity", text, is_doubt=beyond > 0)


def _index(row: Row) -> str:
    return format_number(row["nonlinearity"], 2) + (
        ", from draws" if row["filled_by_draws"] else ""
    )


def _yards(source: Source) -> list[_Names]:
    """What a settling time can be told from, what the study is judged from first."""
    band, found = success_criteria(source.study).band_arcmin, []
    for yard in success_measures(source.study):
        settled = [c.name for c in columns.settle_estimates(band, truth=yard.truth)]
        within = f"within_{band:g}{'_truth' if yard.truth else ''}_share"
        found.append(_Names._make([yard, *settled, within]))
    table = source.rows([one.mean for one in found])
    return [one for one in found if table[one.mean].null_count < table.num_rows]


def _interval(value: float | None, error: float | None) -> Estimate:
    """An estimate with a standard error."""
    if value is None or error is None:
        return UNKNOWN
    return Estimate(value, value - _NORMAL * error, value + _NORMAL * error, 1)


def _best(source: Source, names: _Names) -> Iterator[Table]:
    """The settings with the shortest expected settling times, over all that is not chosen."""
    keys = source.study.keys_shown
    chosen = [key for key in keys if is_method_setting(key)]
    if not chosen:
        return
    given = [key for key in keys if key not in chosen]
    needed = (names.mean, names.error, names.within, _SIGMA)
    table = source.distinct_rows([*keys, *needed])
    points = []
    for point, rows in analysis.groups(table, chosen):
        time, error, share, sigma = (
            analysis.numbers(rows, name) for name in rows.column_names[-4:]
        )
        told = {
            "mean": _interval(time.mean(), error.mean()),
            "longest": time.max(),
            "least": 100 * share.min(),
            "sigma": np.sqrt(np.mean(sigma**2)),
        }
        points.append(point | told)
    points.sort(key=lambda one: (np.isnan(one["mean"].value), one["mean"].value))
    words, over = names.yard.description, f", mean over {' and '.join(given)}" if given else ""
    worst: list[Cell] = [
        ("longest (s)", lambda row: f"{row['longest']:.0f}"),
        ("least share within it at the end (%)", lambda row: f"{row['least']:.0f}"),
    ]
    yield table_of(
        f"The soonest {words}{over}",
        chosen,
        points,
        [
            (f"mean time to {words} (s)", lambda row: format_estimate(row["mean"])),
            *(worst if given else []),
            ("1 sigma at the end, rms (arcmin)", lambda row: f"{row['sigma']:.1f}"),
        ],
        _TIMES,
        most=_MOST_BEST,
        left="settings are not shown",
    )


def _every_variant(source: Source, found: Sequence[_Names]) -> Table:
    keys = source.study.keys_shown
    needed = [name for one in found for name in one[1:]]
    cells = [
        *(cell for one in found for cell in one.cells),
        ("phi_u, mean (arcmin)", lambda row: format_number(row[_YAW])),
        ("1 sigma (arcmin)", lambda row: format_number(row[_SIGMA])),
        ("the filter's own (arcmin)", lambda row: format_number(row[_OWN])),
    ]
    if source.study.checks_linearity:
        cells.append(("index of nonlinearity", _index))
        needed += _CHECKED
    rows = source.distinct_rows([*keys, *needed, _YAW, _SIGMA, _OWN]).to_pylist()
    left = "variants are in `estimates/`"
    return table_of("Every variant", keys, rows, cells, f"{_TIMES} {_SIGMAS}", left=left)


def _figures(source: Source, names: _Names, first: _Names) -> Iterator[Picture]:
    """Over the first two axes of numbers heat maps, along a single one curves."""
    axes, others = source.study.figure_axes
    if len(axes) == 2:
        yield from _heat_maps(source, names, names.yard.figure_suffix(first.yard))
    elif axes and names is first:
        yield _along_axis(source, names, *axes.popitem(), others)


def _heat_maps(source: Source, names: _Names, end: str) -> Iterator[Picture]:
    """The maps from one yardstick, and only those that show something."""
    words, of_floor = names.yard.description, names.within.replace("_truth", "")
    maps = Maps(source, (names.mean, names.within, of_floor, "phi_u_arcmin"))
    within = np.round(100 * maps.of(names.within))
    if not np.round(100 * np.fmin(maps.of(names.within), maps.of(of_floor))).any():
        return  # no cell is within the band, or those that are only pass through it
    if plots.differ(maps.of(names.mean)):
        yield maps.draw(
            f"settling_time{end}",
            f"Expected time until the heading stays {words}; where it never does, the length of the"
            " run counts.",
            names.mean,
        )
    if not np.isin(within, (0.0, 100.0)).all():
        yield maps.draw(
            f"within_band{end}",
            f"Probability that the heading is {words} at the end of the run.",
            names.within,
        )


def _along_axis(
    source: Source, names: _Names, axis: str, values: Sequence[float], others: Sequence[str]
) -> Picture:
    needed = [*others, names.mean, names.error, _YAW, _SIGMA, _OWN, axis]
    table = source.rows(needed)
    lines = lines_of(table, others)

    def panel(of: Callable[[Row], Estimate]) -> dict[str, list[Estimate]]:
        return {name: [of(row) for row in rows.to_pylist()] for name, rows in lines.items()}

    def exact(name: str) -> dict[str, list[Estimate]]:
        return panel(lambda row: _interval(row[name], 0.0))

    panels = {
        f"expected time (s) to {names.yard.description}": panel(names.settling),
        "1 sigma of the true heading error at the end (arcmin)": exact(_SIGMA),
        "the filter's own 1 sigma at the end (arcmin)": exact(_OWN),
    }
    return Picture(
        "along_axis",
        "When the heading has entered the band for good [95 % interval over the sampled errors],"
        " and how far the true heading error spreads at the end beside what the filter believes."
        f"{lines_left(table, others)}",
        plots.along_axis(axis, values, panels, condition=not is_method_setting(axis)),
    )

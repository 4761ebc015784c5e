"""The report of a study that is estimated without draws: its best settings, and the axes."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis, columns, plots
from sinsjax.analysis import Estimate, format_estimate
from sinsjax.execution.source import Source
from sinsjax.report.attitudes import MOST_ROWS
from sinsjax.report.base import Block, Chapter, Picture, Report, Table, name_of, value_text
from sinsjax.report.over_axes import MOST_LINES, MOST_PANELS, is_chosen, shown_axes
from sinsjax.study.acting import first_alike
from sinsjax.study.success import Yardstick, success_of, yardsticks
from sinsjax.study.swept import shown_keys

_MOST_BEST = 10
_NORMAL = 1.96  # 95 % interval, standard errors
_SIGMA = "true_sigma_u_arcmin"
_TIMES = (
    "Mean time: where the heading never stays in the band, the length of the run counts [95 %"
    " interval over the sampled errors]."
)
_SIGMAS = "1 sigma: of the true heading error about its mean, and the filter's own, at the end."


class _Names(NamedTuple):
    """A yardstick, and its columns of the estimates."""

    yard: Yardstick
    mean: str
    error: str
    q10: str
    median: str
    q90: str
    within: str


def report(source: Source) -> Report:
    """What is best, figures over the axes, and every variant.

    Raises:
        InputError: variants are missing.
    """
    assert source.draws  # of which none is missing, or that is told
    found = _yards(source)
    parts: dict[str, list[Block]] = {
        "What is best": [block for one in found[:1] for block in _best(source, one)],
        "Figures": [block for one in found for block in _figures(source, one, found[0])],
        "Tables": [_every_variant(source, found)],
    }
    study = source.study
    variants = f"{study.n_variants:,} variant{'s' if study.n_variants > 1 else ''}"
    how = "the covariance of the true error beside one noise-free run of each"
    return Report(
        [f"{variants}, estimated without draws: by {how}."],
        [Chapter(heading, blocks) for heading, blocks in parts.items() if blocks],
        f"{study.name}: {variants}, no draws",
    )


def _yards(source: Source) -> list[_Names]:
    """What a settling time can be told from, what the study is judged from first."""
    band, found = success_of(source.study).band_arcmin, []
    for yard in yardsticks(source.study):
        settled = [c.name for c in columns.settle_estimates(band, truth=yard.truth)]
        within = f"within_{band:g}{'_truth' if yard.truth else ''}_share"
        found.append(_Names._make([yard, *settled, within]))
    table = source.rows([one.mean for one in found])
    return [one for one in found if table[one.mean].null_count < table.num_rows]


def _settling(row: Mapping[str, Any], names: _Names) -> Estimate:
    """The expected settling time of a variant."""
    value, error = (np.nan if row[n] is None else row[n] for n in (names.mean, names.error))
    return _interval(value, error)


def _interval(value: float, error: float) -> Estimate:
    """An estimate with a standard error."""
    return Estimate(value, value - _NORMAL * error, value + _NORMAL * error, 1)


def _cells(row: Mapping[str, Any], names: _Names) -> list[str]:
    quantiles = (row[name] for name in (names.q10, names.median, names.q90))
    within = row[names.within]
    return [
        format_estimate(_settling(row, names)),
        ", ".join("never" if q is None else f"{q:.0f}" for q in quantiles),
        "unknown" if within is None else f"{100 * within:.0f}",
    ]


def _header(names: _Names) -> list[str]:
    words = names.yard.words
    quantiles = "10, 50, 90 % of runs by (s)"
    return [f"mean time to {words} (s)", quantiles, f"{words} at the end (%)"]


def _of_heading(row: Mapping[str, Any]) -> list[str]:
    names = ("phi_u_arcmin", _SIGMA, "sigma_u_arcmin")
    return ["unknown" if row[name] is None else f"{row[name]:.1f}" for name in names]


_OF_HEADING = ("phi_u, mean (arcmin)", "1 sigma (arcmin)", "the filter's own (arcmin)")


def _best(source: Source, names: _Names) -> Iterator[Table]:
    """The settings with the shortest expected settling times, over all that is not chosen."""
    keys = shown_keys(source.study)
    chosen = [key for key in keys if is_chosen(key)]
    if not chosen:
        return
    given = [key for key in keys if key not in chosen]
    table = source.distinct([*keys, names.mean, names.error, names.within, _SIGMA])
    points = []
    for point, rows in analysis.groups(table, chosen):
        numbers = {name: analysis.numbers(rows, name) for name in (names.mean, names.error)}
        time, error = numbers[names.mean], numbers[names.error].mean()
        share, sigma = (analysis.numbers(rows, name) for name in (names.within, _SIGMA))
        mean = _interval(time.mean(), error)
        points.append((mean, point, time.max(), 100 * share.min(), np.sqrt(np.mean(sigma**2))))
    points.sort(key=lambda one: (np.isnan(one[0].value), one[0].value))
    words = names.yard.words
    over = f", mean over {' and '.join(given)}" if given else ""
    worst = ["longest (s)", "least share within it at the end (%)"] if given else []
    rows_ = [
        [
            *(value_text(point[key]) for key in chosen),
            format_estimate(mean),
            *([f"{longest:.0f}", f"{least:.0f}"] if given else []),
            f"{sigma:.1f}",
        ]
        for mean, point, longest, least, sigma in points[:_MOST_BEST]
    ]
    left = len(points) - len(rows_)
    yield Table(
        f"The soonest {words}{over}",
        [*chosen, f"mean time to {words} (s)", *worst, "1 sigma at the end, rms (arcmin)"],
        rows_,
        f"{_TIMES}{f' {left} more settings are not shown.' if left > 0 else ''}",
    )


def _every_variant(source: Source, found: Sequence[_Names]) -> Table:
    keys = shown_keys(source.study)
    needed = [name for one in found for name in one[1:]]
    table = source.distinct([*keys, *needed, "phi_u_arcmin", _SIGMA, "sigma_u_arcmin"])
    rows = [
        [
            *(value_text(row[key]) for key in keys),
            *(cell for one in found for cell in _cells(row, one)),
            *_of_heading(row),
        ]
        for row in table.slice(0, MOST_ROWS).to_pylist()
    ]
    left = table.num_rows - len(rows)
    rest = f" {left} more variants are in `estimates/`." if left else ""
    header = [*keys, *(cell for one in found for cell in _header(one)), *_OF_HEADING]
    return Table("Every variant", header, rows, f"{_TIMES} {_SIGMAS}{rest}")


def _figures(source: Source, names: _Names, first: _Names) -> Iterator[Picture]:
    """Over the first two axes of numbers heat maps, along a single one curves."""
    axes, others = shown_axes(source.study)
    if len(axes) == 2:
        yield from _heat_maps(source, names, first, axes, others)
    elif names is first:
        for axis, values in axes.items():
            yield _along_axis(source, names, axis, values, others)


def _heat_maps(
    source: Source,
    names: _Names,
    first: _Names,
    axes: Mapping[str, Sequence[float]],
    others: Sequence[str],
) -> Iterator[Picture]:
    shape = tuple(map(len, axes.values()))
    table = source.rows([*others, names.mean, names.within, "variant_id"])
    kinds = first_alike(source.study)
    groups = list(analysis.groups(table, others))
    across = len({value_text(point[others[-1]]) for point, _ in groups}) if others else 1
    drawn = groups[: MOST_PANELS // across * across or MOST_PANELS]
    variants = (analysis.numbers(rows, "variant_id").astype(int) for _, rows in drawn)
    rest = f" The first {len(drawn)} of {len(groups)} panels." if len(drawn) < len(groups) else ""
    rows, across_ = (plots.Scale(key, values) for key, values in axes.items())
    draw = partial(
        plots.heat_maps,
        rows=rows,
        columns=across_,
        across=across,
        repeated=[(kinds[own] != own).reshape(shape) for own in variants],
    )
    end = "" if names is first else "_truth" if names.yard.truth else "_limit"
    words = names.yard.words

    def panels(column: str, factor: float = 1.0) -> list[tuple[str, NDArray]]:
        return [
            (name_of(point), factor * analysis.numbers(own, column).reshape(shape))
            for point, own in drawn
        ]

    times, shares = panels(names.mean), panels(names.within, 100.0)
    high = max(float(np.nanmax(values, initial=0.0)) for _, values in times)
    if _differ(times):
        yield Picture(
            f"settling_time{end}",
            f"Expected time until the heading stays {words}; where it never does, the length of the"
            f" run counts.{rest}",
            draw(
                times,
                f"How long until the heading stays {words}?",
                plots.Shown("expected settling time (s)", 0.0, high or 1.0, reverse=True),
            ),
        )
    if _differ(shares):
        yield Picture(
            f"within_band{end}",
            f"Probability that the heading is {words} at the end of the run.{rest}",
            draw(
                shares,
                f"How likely is the heading {words} at the end?",
                plots.Shown("probability (%)", 0.0, 100.0),
            ),
        )


def _differ(panels: Sequence[tuple[str, NDArray]]) -> bool:
    """Whether cells differ; a figure of equal ones says nothing."""
    return len(np.unique([values for _, values in panels])) > 1


def _along_axis(
    source: Source, names: _Names, axis: str, values: Sequence[float], others: Sequence[str]
) -> Picture:
    shown = [*others, names.mean, names.error, "phi_u_arcmin", _SIGMA, "sigma_u_arcmin"]
    groups = list(analysis.groups(source.rows([*shown, axis]), others))
    lines = {name_of(point): rows.to_pylist() for point, rows in groups[:MOST_LINES]}

    def exact(name: str) -> dict[str, list[Estimate]]:
        return {
            line: [
                Estimate(v, v, v, 1) for v in (np.nan if r[name] is None else r[name] for r in own)
            ]
            for line, own in lines.items()
        }

    panels = {
        f"expected time (s) to {names.yard.words}": {
            line: [_settling(row, names) for row in own] for line, own in lines.items()
        },
        "1 sigma of the true heading error at the end (arcmin)": exact(_SIGMA),
        "the filter's own 1 sigma at the end (arcmin)": exact("sigma_u_arcmin"),
    }
    left = len(groups) - len(lines)
    return Picture(
        "along_axis",
        "When the heading has entered the band for good [95 % interval over the sampled errors],"
        " and how far the true heading error spreads at the end beside what the filter believes."
        f"{f' {left} more lines are not drawn.' if left else ''}",
        plots.along_axis(axis, values, panels, title=f"What {axis} decides"),
    )

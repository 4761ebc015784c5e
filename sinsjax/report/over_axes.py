"""Tables and figures over a study's swept numbers: heat maps, and curves with intervals."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis, plots
from sinsjax.alignment.methods import SECTIONS_OF_METHODS
from sinsjax.analysis.summaries import NEEDED, estimate_of
from sinsjax.analysis.words import percent
from sinsjax.execution.source import Source
from sinsjax.report.base import Block, Picture, Table, intervals, name_of, value_text
from sinsjax.study.acting import first_alike
from sinsjax.study.keys import SECTION_OF
from sinsjax.study.study import Study
from sinsjax.study.success import Yardstick
from sinsjax.study.swept import shown_keys, swept

MOST_PANELS = 12
MOST_LINES = 7
_CHOSEN = tuple(SECTIONS_OF_METHODS)

Axes = Mapping[str, Sequence[float]]


def over_axes(source: Source) -> list[Block]:
    """What the swept numbers decide.

    With two numeric axes or more, heat maps over the first two as the study writes them, a panel
    for each point of all other keys; with one, curves with intervals; with none, nothing.
    """
    shown, others = shown_axes(source.study)
    if len(shown) == 2:
        return [b for yard in source.yardsticks for b in _heat_maps(source, yard, shown, others)]
    return [_along_axis(source, *axis, others) for axis in shown.items()]


def shown_axes(study: Study) -> tuple[dict[str, tuple[float, ...]], list[str]]:
    """The first two swept numbers with their values, and all other swept keys."""
    numeric = {
        keys[0]: tuple(map(float, values))
        for keys, values in swept(study).items()
        if _are_numbers(values)
    }
    shown = dict(list(numeric.items())[:2])
    return shown, [key for key in shown_keys(study) if key not in shown]


def is_chosen(key: str) -> bool:
    """Whether a user chooses the values of a key, so that one can be best."""
    return SECTION_OF.get(key) in _CHOSEN


def _are_numbers(values: Sequence[Any]) -> bool:
    return all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)


class _Map(NamedTuple):
    """One point of the other keys: settling times and success over the two axes.

    Attributes:
        name: of the point.
        point: the other keys' values.
        settle_s: (draws, rows, columns), infinite where a run never settled.
        ok: (draws, rows, columns) bool.
        cluster: (draws,), see `analysis.clusters_of`.
        repeated: (rows, columns) cells whose runs are those of an earlier one: there a key does not
            act.
    """

    name: str
    point: dict[str, Any]
    settle_s: NDArray
    ok: NDArray
    cluster: NDArray
    repeated: NDArray


def _maps(source: Source, yard: Yardstick, axes: Axes, others: Sequence[str]) -> list[_Map]:
    shape = (source.draws, *map(len, axes.values()))
    maps = []
    columns = (*others, yard.settle, yard.ok, "draw_id", "start_s", "variant_id")
    first = first_alike(source.study)
    for point, rows in analysis.groups(source.rows(columns), others):
        # In run order the draws are outermost; among the variants of a point, the first axis.
        settle = np.nan_to_num(analysis.numbers(rows, yard.settle), nan=np.inf)
        ok = rows[yard.ok].fill_null(False).to_numpy()
        cluster = np.asarray(analysis.clusters_of(rows)).reshape(shape)[:, 0, 0]
        settle, ok = settle.reshape(shape), ok.reshape(shape)
        variant = analysis.numbers(rows, "variant_id").astype(int).reshape(shape)[0]
        repeated = first[variant] != variant
        maps.append(_Map(name_of(point), point, settle, ok, cluster, repeated))
    return maps


def _median(settle_s: NDArray) -> NDArray:
    """Median over the draws; infinite where fewer than half of them settled."""
    return np.quantile(settle_s, 0.5, axis=0, method="inverted_cdf")


def _heat_maps(
    source: Source, yard: Yardstick, axes: Axes, others: Sequence[str]
) -> Iterator[Block]:
    """The maps from one yardstick; the names of the files are those of the first."""
    end = "" if yard == source.yardsticks[0] else "_truth" if yard.truth else "_limit"
    maps = _maps(source, yard, axes, others)
    if all(map(is_chosen, axes)):
        yield _best(yard, axes, maps)
    # A line of panels for each value of the other keys but the last, if it is short enough.
    across = len({value_text(m.point[others[-1]]) for m in maps}) if others else 1
    drawn = maps[: MOST_PANELS // across * across or MOST_PANELS]
    rest = f" The first {len(drawn)} of {len(maps)} panels." if len(drawn) < len(maps) else ""
    if any(m.repeated.any() for m in drawn):
        rest += " Cells without a number repeat the one beside them: there a key does not act."
    rows, columns = (plots.Scale(key, values) for key, values in axes.items())
    draw = partial(
        plots.heat_maps,
        rows=rows,
        columns=columns,
        across=across,
        repeated=[m.repeated for m in drawn],
    )
    medians = [(m.name, _median(m.settle_s)) for m in drawn]
    high = max((v.max() for _, m in medians if (v := m[np.isfinite(m)]).size), default=1.0)
    yield Picture(
        f"settling_time{end}",
        f"Median time over {source.draws} draws until the heading stays {yard.words}; hatched where"
        f" at least half of the runs never do.{rest}",
        draw(
            medians,
            f"How long until the heading stays {yard.words}?",
            plots.Shown("median settling time (s)", 0.0, float(high), reverse=True),
        ),
    )
    shares = [(m.name, 100 * m.ok.mean(axis=0)) for m in drawn]
    if len(np.unique([values for _, values in shares])) == 1:
        return  # such a figure says nothing
    yield Picture(
        f"success_rate{end}",
        f"Share of the {source.draws} draws that are ok, {yard.words}.{rest}",
        draw(
            shares,
            f"How many runs are ok, {yard.words}?",
            plots.Shown("runs that are ok (%)", 0.0, 100.0),
        ),
    )


def _best(yard: Yardstick, axes: Axes, maps: Sequence[_Map]) -> Table:
    """At each point of the other keys, where most runs settle, and among those the fastest."""
    rows = []
    for here in maps[: 2 * MOST_PANELS]:
        median = _median(here.settle_s)
        share = here.ok.mean(axis=0)
        best = min(np.ndindex(share.shape), key=lambda at, s=share, m=median: (-s[at], m[at]))  # type: ignore[misc]
        place = (slice(None), *best)
        rows.append(
            [
                *(value_text(value) for value in here.point.values()),
                *(value_text(values[at]) for values, at in zip(axes.values(), best, strict=True)),
                percent(analysis.share(here.ok[place], here.cluster)),
                analysis.format_estimate(
                    analysis.quantile(here.settle_s[place], cluster=here.cluster), digits=0
                ),
                percent(analysis.share(here.ok[:, 0, 0], here.cluster)),
            ]
        )
    first = ", ".join(f"{key} {value_text(values[0])}" for key, values in axes.items())
    others = list(maps[0].point)
    header = [
        *others,
        *(f"best {key}" for key in axes),
        f"ok: {yard.words} (%)",
        "from when on, median (s)",
    ]
    return Table(
        f"Where most runs are ok, {yard.words}, and settle first, over {' and '.join(axes)}",
        [*header, f"at {first} (%)"],
        rows,
        "Equals: the first in the study's order.",
    )


def _along_axis(
    source: Source, axis: str, values: Sequence[float], others: Sequence[str]
) -> Picture:
    yards = source.yardsticks
    shown = {y.rate: f"share of runs that are ok, {y.words}" for y in yards}
    shown |= {f"{y.settle}_median": f"median time (s) to {y.words}" for y in yards}
    shown["phi_u_from_floor_arcmin_mean"] = "phi_u from its limit (arcmin)"
    judged = (name for yard in yards for name in (yard.ok, yard.settle))
    table = source.rows((*others, axis, *judged, *NEEDED))
    groups = list(analysis.groups(table, others))
    found = {
        name_of(point): analysis.summarise(rows, [axis], list(shown)).to_pylist()
        for point, rows in groups[:MOST_LINES]
    }
    panels = {
        words: {name: [estimate_of(row, statistic) for row in rows] for name, rows in found.items()}
        for statistic, words in shown.items()
    }
    *_, last = panels
    if not any(np.isfinite(e.value) for line in panels[last].values() for e in line):
        del panels[last]
    left = len(groups) - len(found)
    rest = f" {left} more lines are not drawn." if left else ""
    return Picture(
        "along_axis",
        "How many runs are ok, when their heading has entered the band for good, and how far the"
        f" mean heading error at the end lies from its limit. {intervals(source, what='Estimate')}"
        f"{rest}",
        plots.along_axis(axis, values, panels, title=f"What {axis} decides"),
    )

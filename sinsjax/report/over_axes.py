"""Tables and figures over a study's swept numbers: heat maps, and curves with intervals."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis, plots
from sinsjax.report.base import (
    Block,
    Picture,
    Source,
    Table,
    name_of,
    percent,
    shown_keys,
    swept,
    value_text,
    yardstick,
)
from sinsjax.studies import SECTION_OF

_MOST_PANELS = 12
_MOST_LINES = 7
_SETTLED = "settle_10_s"
_CHOSEN = ("filter", "resets")  # sections whose values a user chooses, so that one can be best

Axes = Mapping[str, Sequence[float]]


def over_axes(source: Source) -> list[Block]:
    """What the swept numbers decide.

    With two numeric axes or more, heat maps over the first two as the study writes them, a panel
    for each point of all other keys; with one, curves with intervals; with none, nothing.
    """
    numeric = {
        keys[0]: tuple(map(float, values))
        for keys, values in swept(source.study).items()
        if _are_numbers(values)
    }
    shown = dict(list(numeric.items())[:2])
    others = [key for key in shown_keys(source.study) if key not in shown]
    if len(shown) == 2:
        return list(_heat_maps(source, shown, others))
    return [_along_axis(source, *axis, others) for axis in shown.items()]


def _are_numbers(values: Sequence[Any]) -> bool:
    return all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)


class _Map(NamedTuple):
    """One point of the other keys: settling times and success over the two axes.

    Attributes:
        name: of the point.
        point: the other keys' values.
        settle_s: (draws, rows, columns), infinite where a run never settled.
        ok: (draws, rows, columns) bool.
    """

    name: str
    point: dict[str, Any]
    settle_s: NDArray
    ok: NDArray


def _maps(source: Source, axes: Axes, others: Sequence[str]) -> list[_Map]:
    shape = (source.draws, *map(len, axes.values()))
    maps = []
    for point, rows in analysis.groups(source.rows([*others, _SETTLED, "status"]), others):
        # In run order the draws are outermost; among the variants of a point, the first axis.
        settle = np.nan_to_num(analysis.numbers(rows, _SETTLED), nan=np.inf)
        ok = analysis.has_status(rows, "ok")
        maps.append(_Map(name_of(point), point, settle.reshape(shape), ok.reshape(shape)))
    return maps


def _median(settle_s: NDArray) -> NDArray:
    """Median over the draws; infinite where fewer than half of them settled."""
    return np.quantile(settle_s, 0.5, axis=0, method="inverted_cdf")


def _heat_maps(source: Source, axes: Axes, others: Sequence[str]) -> Iterator[Block]:
    maps = _maps(source, axes, others)
    if all(SECTION_OF[key] in _CHOSEN for key in axes):
        yield _best(axes, maps)
    rows, columns = (plots.Scale(key, values) for key, values in axes.items())
    # A line of panels for each value of the other keys but the last, if it is short enough.
    across = len({value_text(m.point[others[-1]]) for m in maps}) if others else 1
    drawn = maps[: _MOST_PANELS // across * across or _MOST_PANELS]
    left = len(maps) - len(drawn)
    rest = f" The first {len(drawn)} of {len(maps)} panels." if left else ""
    medians = [(m.name, _median(m.settle_s)) for m in drawn]
    finite = np.concatenate([values[np.isfinite(values)] for _, values in medians])
    high = float(finite.max()) if finite.size else 1.0
    yield Picture(
        "settling_time",
        f"Median time over {source.draws} draws until the heading has settled to 10 arcmin;"
        f" hatched where at least half of the runs never do.{rest} {yardstick(source.study)}",
        plots.heat_maps(
            medians,
            "How long until the heading error stays within 10 arcmin?",
            plots.Shown("median settling time (s)", 0.0, high, reverse=True),
            rows=rows,
            columns=columns,
            across=across,
        ),
    )
    yield Picture(
        "success_rate",
        f"Share of the {source.draws} draws that are ok at the end.{rest}"
        f" {yardstick(source.study)}",
        plots.heat_maps(
            [(m.name, 100 * m.ok.mean(axis=0)) for m in drawn],
            "How many runs settle at all?",
            plots.Shown("runs that settle (%)", 0.0, 100.0),
            rows=rows,
            columns=columns,
            across=across,
        ),
    )


def _best(axes: Axes, maps: Sequence[_Map]) -> Table:
    """At each point of the other keys, where most runs settle, and among those the fastest."""
    rows = []
    for here in maps[: 2 * _MOST_PANELS]:
        median = _median(here.settle_s)
        share = here.ok.mean(axis=0)
        best = min(np.ndindex(share.shape), key=lambda at, s=share, m=median: (-s[at], m[at]))  # type: ignore[misc]
        place = (slice(None), *best)
        rows.append(
            [
                *(value_text(value) for value in here.point.values()),
                *(value_text(values[at]) for values, at in zip(axes.values(), best, strict=True)),
                percent(analysis.proportion(int(here.ok[place].sum()), here.ok.shape[0])),
                analysis.format_estimate(analysis.quantile(here.settle_s[place]), digits=0),
                percent(analysis.proportion(int(here.ok[:, 0, 0].sum()), here.ok.shape[0])),
            ]
        )
    first = ", ".join(f"{key} {value_text(values[0])}" for key, values in axes.items())
    others = list(maps[0].point)
    header = [*others, *(f"best {key}" for key in axes), "ok (%)", "median settling time (s)"]
    return Table(
        f"Where most runs settle, and settle first, over {' and '.join(axes)}",
        [*header, f"ok at {first} (%)"],
        rows,
        "Equals: the first in the study's order.",
    )


def _along_axis(
    source: Source, axis: str, values: Sequence[float], others: Sequence[str]
) -> Picture:
    panels: dict[str, dict[str, list[analysis.Estimate]]] = {
        "runs that settle (share)": {},
        "median settling time (s)": {},
        "phi_u from its limit (arcmin)": {},
    }
    settling, time, error = panels.values()
    columns = (*others, axis, "status", _SETTLED, "phi_u_mean_arcmin", "floor_arcmin")
    groups = list(analysis.groups(source.rows(columns), others))
    for point, rows in groups[:_MOST_LINES]:
        name = name_of(point)
        by_value = [group for _, group in analysis.groups(rows, [axis])]
        settling[name] = [_success(group) for group in by_value]
        time[name] = [analysis.quantile(analysis.numbers(group, _SETTLED)) for group in by_value]
        error[name] = [
            analysis.difference(
                *(analysis.numbers(group, c) for c in ("phi_u_mean_arcmin", "floor_arcmin"))
            )
            for group in by_value
        ]
    left = len(groups) - len(settling)
    rest = f" {left} more lines are not drawn." if left else ""
    return Picture(
        "along_axis",
        "Share of the draws that are ok, their median settling time to 10 arcmin, and how far the"
        " mean heading error at the end lies from what it is judged against; with 95 % intervals"
        f" over the draws.{rest} {yardstick(source.study)}",
        plots.along_axis(axis, values, panels, title=f"What {axis} decides"),
    )


def _success(rows: Any) -> analysis.Estimate:
    return analysis.proportion(int(analysis.has_status(rows, "ok").sum()), rows.num_rows)

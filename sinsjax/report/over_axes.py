"""Tables and figures over a study's swept numbers: heat maps, curves with intervals, spreads."""

import math
from collections.abc import Iterator, Sequence
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
    value_text,
)
from sinsjax.studies import SECTION_OF
from sinsjax.types import InputError

_MOST_PANELS = 12
_MOST_LINES = 7
_SETTLED = "settle_10_s"
_CHOSEN = ("filter", "resets")  # sections whose values a user chooses, so that one can be best


def over_axes(source: Source) -> list[Block]:
    """What the swept numbers decide.

    With two numeric axes or more, heat maps over the first two as the study writes them, a panel
    for each point of all other keys; with one, curves with intervals; with none, distributions.
    """
    numeric = [key for key, values in source.study.axes.items() if all(map(_is_number, values))]
    others = [key for key in shown_keys(source.study) if key not in numeric[:2]]
    if len(numeric) >= 2:
        return list(_heat_maps(source, (numeric[0], numeric[1]), others))
    if numeric:
        return list(_along_axis(source, numeric[0], others))
    return list(_distributions(source))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


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


def _maps(source: Source, axes: tuple[str, str], others: Sequence[str]) -> list[_Map]:
    shape = (source.study.n_draws, *(len(source.study.axes[key]) for key in axes))
    maps = []
    for point, rows in analysis.groups(source.summary, others):
        if rows.num_rows != math.prod(shape):
            raise InputError(
                f"{source.directory}: {rows.num_rows} runs where the study has {math.prod(shape)}"
                f" ({name_of(point)}): are the results complete?"
            )
        # In run order the draws are outermost; among the variants of a point, the first axis.
        settle = np.nan_to_num(analysis.numbers(rows, _SETTLED), nan=np.inf)
        ok = np.asarray(rows["status"]) == "ok"
        maps.append(_Map(name_of(point), point, settle.reshape(shape), ok.reshape(shape)))
    return maps


def _median(settle_s: NDArray) -> NDArray:
    """Median over the draws; infinite where fewer than half of them settled."""
    return np.quantile(settle_s, 0.5, axis=0, method="inverted_cdf")


def _heat_maps(source: Source, axes: tuple[str, str], others: Sequence[str]) -> Iterator[Block]:
    maps = _maps(source, axes, others)
    if all(SECTION_OF[key] in _CHOSEN for key in axes):
        yield _best(source, axes, maps)
    rows, columns = (plots.Scale(key, source.study.axes[key]) for key in axes)
    drawn = maps[:_MOST_PANELS]
    left = len(maps) - len(drawn)
    rest = f" The first {len(drawn)} of {len(maps)} panels." if left else ""
    medians = [(m.name, _median(m.settle_s)) for m in drawn]
    finite = np.concatenate([values[np.isfinite(values)] for _, values in medians])
    high = float(finite.max()) if finite.size else 1.0
    yield Picture(
        "settling_time",
        f"Median settling time to 10 arcmin over {source.study.n_draws} draws; hatched where at"
        f" least half of the runs never settle.{rest}",
        plots.heat_maps(
            medians,
            "How long until the heading error stays within 10 arcmin?",
            plots.Shown("median settling time (s)", 0.0, high, reverse=True),
            rows=rows,
            columns=columns,
        ),
    )
    yield Picture(
        "success_rate",
        f"Share of the {source.study.n_draws} draws that end settled (status ok).{rest}",
        plots.heat_maps(
            [(m.name, 100 * m.ok.mean(axis=0)) for m in drawn],
            "How many runs settle at all?",
            plots.Shown("runs that settle (%)", 0.0, 100.0),
            rows=rows,
            columns=columns,
        ),
    )


def _best(source: Source, axes: tuple[str, str], maps: Sequence[_Map]) -> Table:
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
                *(
                    value_text(source.study.axes[key][at])
                    for key, at in zip(axes, best, strict=True)
                ),
                percent(analysis.proportion(int(here.ok[place].sum()), here.ok.shape[0])),
                analysis.format_estimate(analysis.quantile(here.settle_s[place]), digits=0),
                percent(analysis.proportion(int(here.ok[:, 0, 0].sum()), here.ok.shape[0])),
            ]
        )
    first = ", ".join(f"{key} {value_text(source.study.axes[key][0])}" for key in axes)
    others = list(maps[0].point)
    header = [*others, *(f"best {key}" for key in axes), "ok (%)", "median settling time (s)"]
    return Table(
        f"Where most runs settle, and settle first, over {axes[0]} and {axes[1]}",
        [*header, f"ok at {first} (%)"],
        rows,
        "Equals: the first in the study's order.",
    )


def _along_axis(source: Source, axis: str, others: Sequence[str]) -> Iterator[Block]:
    values = source.study.axes[axis]
    panels: dict[str, dict[str, list[analysis.Estimate]]] = {
        "runs that settle (share)": {},
        "median settling time (s)": {},
        "phi_u from its limit (arcmin)": {},
    }
    settling, time, error = panels.values()
    groups = list(analysis.groups(source.summary, others))
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
    yield Picture(
        "along_axis",
        f"Estimates with 95 % intervals over the draws; settled: within 10 arcmin.{rest}",
        plots.along_axis(axis, values, panels, title=f"What {axis} decides"),
    )


def _success(rows: Any) -> analysis.Estimate:
    return analysis.proportion(rows["status"].to_pylist().count("ok"), rows.num_rows)


def _distributions(source: Source) -> Iterator[Block]:
    groups = list(analysis.groups(source.summary, shown_keys(source.study)))
    settle: dict[str, NDArray] = {}
    error: dict[str, NDArray] = {}
    for key, rows in groups[:_MOST_LINES]:
        name = name_of(key)
        settle[name] = analysis.numbers(rows, _SETTLED)
        error[name] = analysis.numbers(rows, "phi_u_mean_arcmin") - analysis.numbers(
            rows, "floor_arcmin"
        )
    left = len(groups) - len(settle)
    rest = f" {left} more variants are not drawn." if left else ""
    panels = {"settling time to 10 arcmin (s)": settle, "phi_u from its limit (arcmin)": error}
    figure = plots.distributions(panels, "Settling time and remaining heading error over the runs")
    yield Picture(
        "distribution", f"A line that ends below 1: the rest never settles.{rest}", figure
    )

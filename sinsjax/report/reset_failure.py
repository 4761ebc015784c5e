"""What governs failure: level or yaw, with the measured force in A(t) and with gravity."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis, plots
from sinsjax.plots import Scale, Shown
from sinsjax.report.base import Block, Picture, Table, percent, yardstick
from sinsjax.report.reset_grid import (
    FORCES,
    LEVEL,
    NONE,
    PAPER_READING,
    READING_CELLS,
    YAW,
    Answer,
    Grid,
    percent_mean,
    shared,
)

_NOTE = (
    "Number [95 % interval] over the noise, the misalignments being given: where no draw differs,"
    " that of a difference and of a part of the variance has no width."
)


class Governed(NamedTuple):
    """What the failures over level and yaw vary with: shares of their variance, by draw.

    Attributes:
        level: of the means over the yaws.
        yaw: of the means over the levels.
        both: of what is left, where the one decides what the other does.
    """

    level: NDArray
    yaw: NDArray
    both: NDArray


def governed(failed: NDArray) -> Governed:
    """Splits the variance of failure over a full grid of level and yaw.

    Sums of squares of a two-way layout with one value a cell: main effects, and their interaction.

    Args:
        failed: (levels, yaws, draws) bool.

    Returns:
        (draws,) each, 1 together; NaN where all or none fail.
    """
    values = failed - failed.mean(axis=(0, 1))
    level, yaw = values.mean(axis=1, keepdims=True), values.mean(axis=0, keepdims=True)
    whole = (values**2).mean(axis=(0, 1))
    with np.errstate(invalid="ignore"):  # nothing varies: unknown
        parts = ((p**2).mean(axis=(0, 1)) / whole for p in (level, yaw, values - level - yaw))
        return Governed(*parts)


def answer(grid: Grid) -> Answer:
    """Question 3."""
    failed = np.isinf(grid.settle_s[:, :, :, grid.schedule(NONE)])
    blocks: list[Block] = [_picture(grid, failed), _shares(grid, failed), _variances(grid, failed)]
    return Answer(_headline(grid, failed), "What governs failure, level or yaw?", blocks)


def _headline(grid: Grid, failed: NDArray) -> str:
    here = failed[grid.paper_reading]
    other = failed[grid.reading("gravity", *PAPER_READING[1:])]
    parts = governed(here)
    kinds = [failed[i] for i in (grid.measured, grid.gravity)]
    everywhere, ablated = map(_share, kinds)
    less = percent(analysis.difference(_of_all(kinds[1]), _of_all(kinds[0])))
    return (
        f"What governs failure? Without reset {everywhere} % of the runs of all readings never"
        f" settle, with gravity in A(t) {ablated} %, a difference of {less} % on the same noise."
        f" {PAPER_READING.name}: {_share(here)} % against {_share(other)} %; at level"
        f" {grid.levels[0]:g} deg {_share(here[:1])} %, at yaw {grid.yaws[0]:g} deg"
        f" {_share(here[:, :1])} %. Of the variance of failure over the misalignments there, level"
        f" explains {_part(parts.level)} %, yaw {_part(parts.yaw)} %, both together"
        f" {_part(parts.both)} %."
    )


def _of_all(failed: NDArray) -> NDArray:
    """Share that fails of all but the last axis, by draw."""
    return failed.reshape(-1, failed.shape[-1]).mean(axis=0)


def _share(failed: NDArray) -> str:
    return percent(shared(failed))


def _part(share: NDArray) -> str:
    return percent_mean(analysis.mean(share))


def _picture(grid: Grid, failed: NDArray) -> Picture:
    here = [r for r in grid.readings if r.q == PAPER_READING.q]
    panels = [
        (
            f"{reading.force}, {reading.feedback_s:g} s",
            100 * failed[grid.readings.index(reading)].mean(axis=-1),
        )
        for force in FORCES
        for reading in here
        if reading.force == force
    ]
    return Picture(
        "failure",
        f"Share of {grid.draws} draws that never settle without reset, Q `{PAPER_READING.q}`: above"
        " with the measured specific force in A(t), below with gravity; a column for each feedback"
        f" interval. {yardstick(grid.study)}",
        plots.heat_maps(
            panels,
            f"Which fail without reset? By feedback interval, Q {PAPER_READING.q}",
            Shown("runs that never settle (%)", 0.0, 100.0, reverse=True),
            rows=Scale(LEVEL, grid.levels),
            columns=Scale(YAW, grid.yaws),
            across=len(panels) // 2,
        ),
    )


def _shares(grid: Grid, failed: NDArray) -> Table:
    level, yaw = grid.levels[0], grid.yaws[0]
    rows = []
    for i, reading in enumerate(grid.readings):
        base = grid.reading("measured", *reading[1:])
        less = analysis.difference(_of_all(failed[i]), _of_all(failed[base]))
        cells = [_share(part) for part in (failed[i], failed[i, :1], failed[i, :, :1])]
        rows.append([*reading.cells, *cells, "-" if i == base else percent(less)])
    header = [
        *READING_CELLS,
        "all (%)",
        f"level {level:g} deg, all yaws (%)",
        f"yaw {yaw:g} deg, all levels (%)",
        "all, minus measured (%)",
    ]
    return Table(f"Runs that never settle without reset, of {_sizes(grid)}", header, rows, _NOTE)


def _sizes(grid: Grid) -> str:
    return f"{len(grid.levels)} levels x {len(grid.yaws)} yaws x {grid.draws} draws"


def _variances(grid: Grid, failed: NDArray) -> Table:
    rows = []
    for i, reading in enumerate(grid.readings):
        parts = governed(failed[i])
        varies = np.isfinite(parts.both).any()
        rows.append([*reading.cells, *(_part(part) if varies else "-" for part in parts)])
    header = [*READING_CELLS, "level (%)", "yaw (%)", "both together (%)"]
    note = (
        "Failure, 0 or 1, over the full grid of level and yaw: variance of its means over the yaws,"
        " over the levels, and the rest; for the levels and yaws of this grid. -: all or none fail."
        f" {_NOTE}"
    )
    return Table("What the variance of failure without reset comes from", header, rows, note)

"""Figures over a grid of settings: heat maps over two axes, and matrices of verdicts."""

import math
from collections.abc import Iterator, Mapping, Sequence
from textwrap import fill
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray

from sinsjax.plots.digits import Number
from sinsjax.plots.labels import axis_label, format_value
from sinsjax.plots.style import ABOVE_SCALE, COLOURS, LETTERS, with_style

_NEVER, _NEVER_EDGE = "#dcdcdc", "#b5b5b5"
_HATCH, _MARKED = "////", "xx"
_ROOMY = 6  # most cells side by side in a panel with full-size numbers
_LEGIBLE = 10  # most cells side by side with small numbers
_LETTERS = 9  # characters per inch in a panel's title
_LEAST, _PANEL, _BETWEEN = 2.3, 2.5, 0.14  # in: least width and height of a panel, and the gap
_LINE, _LETTER = 0.21, 0.085  # in: a line of text, and a letter
_BAR = 11  # characters per inch along the colour bar
_FRAMES = ((COLOURS[1], 3.5), ("black", 1.2))  # colour and width, pt
_GAP = 7.0  # pt between the grid and a bar next to it
_LIGHT = 0.5  # position in the colour map beyond which cells are light and have dark numbers


class GridAxis(NamedTuple):
    """A swept key along one axis of a heat map.

    Attributes:
        key: leaf key, with the unit in its name.
        values: in the order of the grid.
    """

    key: str
    values: Sequence[Any]


class MapQuantity(NamedTuple):
    """The quantity shown by a heat map.

    Attributes:
        name: label of the colour bar, with the unit.
        low: value at the dark end of the colours.
        high: value at the light end.
        reverse: whether low values are light instead.
        digits: decimals of the number in a cell.
        log: whether the colour scale is logarithmic, with two significant digits in cells.
    """

    name: str
    low: float
    high: float
    reverse: bool = False
    digits: int = 0
    log: bool = False

    @property
    def norm(self) -> Normalize:
        """Normalisation of a value to its position on the colour map, 0 to 1."""
        return (LogNorm if self.log else Normalize)(self.low, self.high, clip=True)

    def format_number(self, value: float) -> str:
        """The number in a cell."""
        digits = self.digits
        if self.log:
            digits = max(0, 1 - math.floor(math.log10(value))) if value > 0 else 0
        return f"{value:.{digits}f}"


class CellMarks(NamedTuple):
    """Marks of the cells of heat maps in addition to their colour.

    Attributes:
        same_runs: for each panel, a number for each of its cells (rows, columns); cells that share
            it have the same runs, and their value is written once.
        hatched: for each panel, the cells (rows, columns) to hatch; empty for none.
        hatch_name: meaning of the hatch, for the legend.
        frames: the cell (row, column) to frame in each panel, or None, by the meaning of the frame
            for the legend; at most two meanings, the first one bold.
    """

    same_runs: Sequence[NDArray]
    hatched: Sequence[NDArray] = ()
    hatch_name: str = ""
    frames: Mapping[str, Sequence[tuple[int, int] | None]] = {}


def values_differ(values: NDArray | Sequence[NDArray]) -> bool:
    """Return whether cells of `draw_heat_maps` differ; a figure of equal cells shows nothing."""
    return len(np.unique(values)) > 1


def _tick_label(key: str, value: Any) -> str:
    """Return the label of a row or column."""
    return "none" if key == "reset_count" and value == 0 else format_value(value)


@with_style
def draw_heat_maps(
    panels: Sequence[tuple[str, NDArray]],
    title: str,
    quantity: MapQuantity,
    *,
    rows: GridAxis,
    columns: GridAxis,
    panels_per_row: int | None = None,
    marks: CellMarks | None = None,
) -> Figure:
    """Heat maps of one quantity over two swept keys, side by side.

    Args:
        panels: title and values (rows, columns) of each; a non-finite value means *never* and is
            hatched in grey.
        title: title of the figure.
        quantity: quantity to show.
        rows: key from bottom to top.
        columns: key from left to right.
        panels_per_row: panels per row, such as the values of a third key; at most 4.
        marks: cells to hatch, and cells whose value is written once.
    """
    width = min(4, panels_per_row or 4, len(panels))
    height = -(-len(panels) // width)
    side = max(_LEAST, 7.2 / width)  # width of a panel, in; together as wide as the title
    names = [fill(name, int(_LETTERS * side)) for name, _ in panels]
    ticks = [[_tick_label(scale.key, value) for value in scale.values] for scale in (rows, columns)]
    finite = np.concatenate([values[np.isfinite(values)] for _, values in panels])
    below, above = bool(np.any(finite < quantity.low)), bool(np.any(finite > quantity.high))
    bar = fill(
        f"{quantity.name}{ABOVE_SCALE if above else ''}", int(_BAR * (_PANEL + 0.5) * height)
    )
    handles = [*_legend_handles(panels, marks)]
    # Laid out from the sizes of the texts: measuring each takes longer than drawing them.
    turned = _LETTER * sum(map(len, ticks[1])) > 0.8 * side
    lines = [
        max(name.count("\n") + 1 for name in row)
        for row in (names[i : i + width] for i in range(0, len(names), width))
    ]
    above_in = [_LINE * count + 0.1 for count in lines]  # of each row of panels
    below_in = 0.62 + (_LETTER * max(map(len, ticks[1])) if turned else 0.0)
    left_in = 0.5 + _LETTER * max(map(len, ticks[0]))
    right_in = 1.0 + _LINE * (bar.count("\n") + 1)
    wide = left_in + side * width + right_in
    heading = fill(title, int(LETTERS * wide))
    top_in = 0.25 * (heading.count("\n") + 1) + 0.1
    foot_in = below_in + (0.4 if handles else 0.05)
    tall = top_in + sum(above_in) + (_PANEL + _BETWEEN) * height - _BETWEEN + foot_in
    figure = Figure(figsize=(wide, tall))
    figure.set_layout_engine("none")
    figure.suptitle(heading, y=1 - 0.06 / tall, va="top")
    # Set before the axes are created: later, every tick would be created twice.
    tick = 10.5 if len(columns.values) <= _ROOMY else 9
    mpl.rcParams.update({"axes.grid": False, "xtick.labelsize": tick})
    grid = figure.subplots(height, width, sharex=True, sharey=True, squeeze=False)
    grid[0, 0].set_xticks(range(len(ticks[1])), ticks[1])
    grid[0, 0].set_yticks(range(len(ticks[0])), ticks[0])
    upper = tall - top_in
    for line, row in zip(above_in, grid, strict=True):
        upper -= line + _PANEL
        for number, axes in enumerate(row):
            place = (left_in + side * number, upper, side - _BETWEEN, _PANEL)
            axes.set_position([x / size for x, size in zip(place, (wide, tall) * 2, strict=True)])
            if turned:
                axes.tick_params(axis="x", labelrotation=90)
        upper -= _BETWEEN
    for number, (axes, (_, values)) in enumerate(zip(grid.flat, panels, strict=False)):
        image = _draw_heat_map(axes, values, quantity, marks.same_runs[number] if marks else None)
        if marks and marks.hatched:
            _hatch_cells(axes, np.isfinite(values) & marks.hatched[number], values, quantity)
        if marks:
            _separate_bars(axes, marks.same_runs[number])
            _frame_cells(axes, marks.same_runs[number], [c[number] for c in marks.frames.values()])
        axes.set_title(names[number])
    label_outer_axes(grid, len(panels), rows=rows, columns=columns)
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get((below, above))
    low, high = foot_in / tall, 1 - (top_in + above_in[0]) / tall
    at = (left_in + side * width + 0.1) / wide, low + 0.1 * (high - low)
    side_bar = figure.add_axes((*at, 0.16 / wide, 0.8 * (high - low)))
    figure.colorbar(image, cax=side_bar, label=bar, extend=extend or "neither")
    if handles:
        figure.legend(handles=handles, loc="lower center", ncols=len(handles))
    return figure


def _legend_handles(
    panels: Sequence[tuple[str, NDArray]], marks: CellMarks | None
) -> Iterator[Patch]:
    """The entries of the legend."""
    if any(not np.isfinite(values).all() for _, values in panels):
        yield Patch(facecolor=_NEVER, edgecolor=_NEVER_EDGE, hatch=_HATCH, label="never (median)")
    if marks and np.any(marks.hatched):
        yield Patch(facecolor="none", edgecolor="black", hatch=_MARKED, label=marks.hatch_name)
    frames = marks.frames.items() if marks else ()
    for (colour, line), (name, cells) in zip(_FRAMES, frames, strict=False):
        if any(cell is not None for cell in cells):
            yield Patch(fill=False, edgecolor=colour, linewidth=line, label=name)


def label_outer_axes(grid: NDArray, n_panels: int, *, rows: GridAxis, columns: GridAxis) -> None:
    """Label the left and lower edge of a grid of axes, and hide the unused axes.

    Args:
        grid: two-dimensional array of axes.
        n_panels: number of axes used, row by row.
        rows: scale of the y axes.
        columns: scale of the x axes.
    """
    height, width = grid.shape
    lowest = [max(i for i in range(height) if i * width + j < n_panels) for j in range(width)]
    for axes in list(grid.flat)[n_panels:]:
        axes.set_visible(False)
    for axes in grid[:, 0]:
        axes.set_ylabel(axis_label(rows.key))
    for axes in grid[:, 1:].flat:
        axes.yaxis.set_visible(False)
    for row, axes in zip(lowest, grid.T, strict=True):
        for upper in axes[:row]:
            upper.xaxis.set_visible(False)
        axes[row].set_xlabel(axis_label(columns.key))
        if row < height - 1:
            axes[row].tick_params(labelbottom=True)


def _draw_heat_map(
    axes: Axes, values: NDArray, quantity: MapQuantity, same_runs: NDArray | None = None
) -> AxesImage:
    image = axes.imshow(
        np.ma.masked_invalid(values),
        cmap="viridis_r" if quantity.reverse else "viridis",
        norm=quantity.norm,
        aspect="auto",
        origin="lower",
    )
    axes.patch.set(facecolor=_NEVER, edgecolor=_NEVER_EDGE, hatch=_HATCH)  # behind masked cells
    size = 9.0 if values.shape[1] <= _ROOMY else 7.5
    if values.shape[1] <= _LEGIBLE:
        cell_numbers = np.arange(values.size).reshape(values.shape)
        shades = _number_colours(values, quantity)
        for cell, (row, column) in _number_positions(
            cell_numbers if same_runs is None else same_runs
        ):
            if np.isfinite(values[cell]):
                style: Any = {"ha": "center", "va": "center", "size": size, "color": shades[cell]}
                number = Number(column, row, quantity.format_number(values[cell]), **style)
                number.set_transform(axes.transData)
                axes.add_artist(number)
    return image


def _number_positions(same_runs: NDArray) -> Iterator[tuple[tuple[int, int], tuple[float, float]]]:
    """A cell of each kind, and where its value is written: mid-way if they make a rectangle."""
    for kind in np.unique(same_runs):
        (low, high), first = _cell_extent(same_runs, int(kind))
        row, column = (low + high) / 2
        yield first, (float(row), float(column))


def _cell_extent(same_runs: NDArray, kind: int) -> tuple[NDArray, tuple[int, int]]:
    """The lower and upper corner (2, 2) of the cells of a kind, and the first of these cells.

    The corners are those of the first cell alone if the cells do not make a rectangle.
    """
    cells = np.argwhere(same_runs == kind)
    low, high = cells.min(axis=0), cells.max(axis=0)
    is_whole = np.prod(high - low + 1) == len(cells)
    first = (int(cells[0][0]), int(cells[0][1]))
    return np.array([low, high] if is_whole else [cells[0], cells[0]]), first


def find_bars(same_runs: NDArray) -> NDArray:
    """Return whether each row of a panel is a single bar: cells with the same runs and no others.

    Args:
        same_runs: (rows, columns) number of each cell, as in `CellMarks`; transposed for columns.
    """
    shared = same_runs[:, :1]
    counts = (same_runs == shared[..., None]).sum(axis=(1, 2))
    width = same_runs.shape[1]
    return np.asarray((same_runs == shared).all(axis=1) & (counts == width) & (width > 1))


def _separate_bars(axes: Axes, same_runs: NDArray) -> None:
    """Leave a gap between the grid and its bars, in which one of the two keys has no effect."""
    for kinds, draw_line in ((same_runs, axes.axhline), (same_runs.T, axes.axvline)):
        last = len(kinds) - 1
        for bar in np.flatnonzero(find_bars(kinds)):
            for edge in {bar - 0.5, bar + 0.5} - {-0.5, last + 0.5}:
                draw_line(edge, color="white", linewidth=_GAP, solid_capstyle="butt")


def _frame_cells(axes: Axes, same_runs: NDArray, cells: Sequence[tuple[int, int] | None]) -> None:
    """Frame a cell in each of `_FRAMES`, with the cells that have the same runs."""
    style: dict[str, Any] = {"fill": False, "clip_on": False, "zorder": 3}
    for cell, (colour, width) in reversed([*zip(cells, _FRAMES, strict=False)]):  # bold on top
        if cell is None:
            continue
        (low, high), _ = _cell_extent(same_runs, int(same_runs[cell]))
        corner, (rows, columns) = (low[1] - 0.5, low[0] - 0.5), high - low + 1
        for shade, line in (("white", width + 1.5), (colour, width)):
            frame = Rectangle(corner, columns, rows, edgecolor=shade, linewidth=line, **style)
            axes.add_patch(frame)


def _hatch_cells(axes: Axes, hatched: NDArray, values: NDArray, quantity: MapQuantity) -> None:
    shades = _number_colours(values, quantity)
    for row, column in np.argwhere(hatched):
        shade, corner = shades[row, column], (column - 0.5, row - 0.5)
        patch = Rectangle(corner, 1, 1, fill=False, edgecolor=shade, hatch=_MARKED, linewidth=0)
        axes.add_patch(patch)
    (image,) = axes.get_images()
    for text in axes.texts if hatched.any() else ():  # a hatch leaves room for the numbers
        column, row = map(int, text.get_position())
        colour = image.to_rgba(values[row, column])
        text.set_bbox({"facecolor": colour, "linewidth": 0, "pad": 1.0})


def _number_colours(values: NDArray, quantity: MapQuantity) -> NDArray:
    """Return the colour that is legible on each cell."""
    light = np.ma.filled(quantity.norm(np.ma.masked_invalid(values)), 0.0) > _LIGHT
    return np.where(light != quantity.reverse, "black", "white")

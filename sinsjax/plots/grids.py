"""Figures over a grid of settings: heat maps over two axes, and matrices of verdicts."""

import math
from collections.abc import Iterator, Sequence
from textwrap import fill
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from sinsjax.plots.style import AND_MORE, COLOURS, LETTERS, styled
from sinsjax.plots.words import label, value_text

_NEVER, _NEVER_EDGE = "#dcdcdc", "#b5b5b5"
_HATCH, _MARKED = "////", "xx"
_CONTOUR = COLOURS[1]
_ROOMY = 6  # most cells side by side in a panel with full-size numbers
_LEGIBLE = 10  # most cells side by side with small numbers
_LETTERS = 9  # characters per inch in a panel's title
_BEST = COLOURS[1]  # frame of the best cell
_LIGHT = 0.5  # position in the colour map beyond which cells are light and have dark numbers


class Scale(NamedTuple):
    """A swept key along one axis of a heat map.

    Attributes:
        key: leaf key, with the unit in its name.
        values: in the order of the grid.
    """

    key: str
    values: Sequence[Any]


class Shown(NamedTuple):
    """The quantity shown by a heat map.

    Attributes:
        name: label of the colour bar, with the unit.
        low: value at the dark end of the colours.
        high: value at the light end.
        reverse: whether low values are light instead.
        digits: decimals of the number in a cell.
        log: whether the colour scale is logarithmic, with two significant digits in cells.
        numbers: whether cells show their value.
    """

    name: str
    low: float
    high: float
    reverse: bool = False
    digits: int = 0
    log: bool = False
    numbers: bool = True

    @property
    def norm(self) -> Normalize:
        """Normalisation of a value to its position on the colour map, 0 to 1."""
        return (LogNorm if self.log else Normalize)(self.low, self.high, clip=True)

    def text(self, value: float) -> str:
        """The number in a cell."""
        digits = self.digits
        if self.log:
            digits = max(0, 1 - math.floor(math.log10(value))) if value > 0 else 0
        return f"{value:.{digits}f}"


class Contours(NamedTuple):
    """Contour lines over heat maps.

    Attributes:
        name: name of the quantity in the legend.
        levels: ascending levels.
        values: (n, m) values for each panel, evenly spaced from edge to edge, see `spread`.
    """

    name: str
    levels: Sequence[float]
    values: Sequence[NDArray]


class Marks(NamedTuple):
    """What cells of heat maps show besides their colour.

    Attributes:
        alike: for each panel, a number for each of its cells (rows, columns); cells that share it
            have the same runs, and their value is written once.
        hatched: for each panel, the cells (rows, columns) to hatch; empty for none.
        name: meaning of the hatch, for the legend.
        best: for each panel, the cell (row, column) to outline, or None; empty for none.
        best_name: meaning of the outline, for the legend.
    """

    alike: Sequence[NDArray]
    hatched: Sequence[NDArray] = ()
    name: str = ""
    best: Sequence[tuple[int, int] | None] = ()
    best_name: str = ""


def spread(values: Sequence[float], count: int) -> NDArray:
    """Positive values of an axis, evenly spaced on the figure from edge to edge of its cells.

    Args:
        values: values at the centres of two or more cells, ascending.
        count: number of values.

    Returns:
        (count,) values, geometric between the centres and beyond the outer ones.
    """
    logs, last = np.log(values), len(values) - 1
    middles = np.arange(-1, last + 2)
    ends = (2 * logs[0] - logs[1], 2 * logs[-1] - logs[-2])
    places = np.linspace(-0.5, last + 0.5, count)
    return np.exp(np.interp(places, middles, [ends[0], *logs, ends[1]]))


def differ(values: NDArray | Sequence[NDArray]) -> bool:
    """Whether cells of `heat_maps` differ; a figure of equal ones says nothing."""
    return len(np.unique(values)) > 1


@styled
def heat_maps(
    panels: Sequence[tuple[str, NDArray]],
    title: str,
    shown: Shown,
    *,
    rows: Scale,
    columns: Scale,
    contours: Contours | None = None,
    across: int | None = None,
    marks: Marks | None = None,
) -> Figure:
    """Heat maps of one quantity over two swept keys, side by side.

    Args:
        panels: title and values (rows, columns) of each; a non-finite value means *never* and is
            hatched in grey.
        title: title of the figure.
        shown: quantity to show.
        rows: key from bottom to top.
        columns: key from left to right.
        contours: contour lines over the panels.
        across: panels per row, such as the values of a third key; at most 4.
        marks: cells to hatch, and cells whose value is written once.
    """
    width = min(4, across or 4, len(panels))
    height = -(-len(panels) // width)
    side = max(2.2, 7.2 / width)  # width of a panel, in; together as wide as the title
    names = [fill(name, int(_LETTERS * side)) for name, _ in panels]
    line = 0.2 * max(name.count("\n") for name in names)
    figure = Figure(figsize=(1.2 + side * width, 1.4 + (2.5 + line) * height))
    figure.suptitle(fill(title, int(LETTERS * figure.get_figwidth())))
    # Set before the axes are made: later, every tick would be made twice.
    tick = 10.5 if len(columns.values) <= _ROOMY else 9
    mpl.rcParams.update({"axes.grid": False, "xtick.labelsize": tick})
    grid = figure.subplots(height, width, sharex=True, sharey=True, squeeze=False)
    grid[0, 0].set_xticks(range(len(columns.values)), map(value_text, columns.values))
    grid[0, 0].set_yticks(range(len(rows.values)), map(value_text, rows.values))
    for number, (axes, (_, values)) in enumerate(zip(grid.flat, panels, strict=False)):
        image = _heat_map(axes, values, shown, marks.alike[number] if marks else None)
        if marks and marks.hatched:
            _mark(axes, np.isfinite(values) & marks.hatched[number], values, shown)
        if marks and marks.best and (best := marks.best[number]) is not None:
            _outline(axes, marks.alike[number], best)
        axes.set_title(names[number])
        if contours:
            _contour(axes, contours.levels, contours.values[number])
    label_rim(grid, len(panels), rows=rows, columns=columns)
    finite = np.concatenate([values[np.isfinite(values)] for _, values in panels])
    below, above = bool(np.any(finite < shown.low)), bool(np.any(finite > shown.high))
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get((below, above))
    name = f"{shown.name}{AND_MORE if above else ''}"
    figure.colorbar(image, ax=grid, label=name, shrink=0.8, aspect=30, extend=extend or "neither")
    handles: list[Patch | Line2D] = []
    if contours:
        styles = zip(contours.levels, _level_styles(contours.levels), strict=True)
        for i, (level, style) in enumerate(styles):
            name = f"{contours.name} {level:g}" if i == 0 else f"{level:g}"
            handles.append(Line2D([], [], color=_CONTOUR, linestyle=style, label=name))
    if any(not np.isfinite(values).all() for _, values in panels):
        never = Patch(facecolor=_NEVER, edgecolor=_NEVER_EDGE, hatch=_HATCH, label="never (median)")
        handles.append(never)
    if marks and np.any(marks.hatched):
        handles.append(Patch(facecolor="none", edgecolor="black", hatch=_MARKED, label=marks.name))
    if marks and any(best is not None for best in marks.best):
        handles.append(Patch(fill=False, edgecolor=_BEST, linewidth=2.5, label=marks.best_name))
    if handles:
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


def _contour(axes: Axes, levels: Sequence[float], values: NDArray) -> None:
    sides = zip((axes.get_ylim(), axes.get_xlim()), values.shape, strict=True)
    down, right = (np.linspace(min(side), max(side), count) for side, count in sides)
    styles = _level_styles(levels)
    lines = axes.contour(
        right, down, values, levels, colors=_CONTOUR, linewidths=1.3, linestyles=styles
    )
    lines.set_path_effects([withStroke(linewidth=2.2, foreground="white", alpha=0.6)])


def _level_styles(levels: Sequence[float]) -> list[Any]:
    """A line style for each level, from the sparsest to solid."""
    return [*((0, (1 + 2 * i, 1.5)) for i in range(len(levels) - 1)), "-"]


def label_rim(grid: NDArray, panels: int, *, rows: Scale, columns: Scale) -> None:
    """Label the left and lower edge of a grid of axes, and hide the unused axes.

    Args:
        grid: two-dimensional array of axes.
        panels: number of axes used, row by row.
        rows: scale of the y axes.
        columns: scale of the x axes.
    """
    height, width = grid.shape
    lowest = [max(i for i in range(height) if i * width + j < panels) for j in range(width)]
    for number, axes in enumerate(grid.flat):
        row, column = divmod(number, width)
        axes.set_visible(number < panels)
        axes.set_in_layout(column == 0 or row == lowest[column])  # the others have no labels
    for axes in grid[:, 0]:
        axes.set_ylabel(label(rows.key))
    for row, axes in zip(lowest, grid.T, strict=True):
        axes[row].set_xlabel(label(columns.key))
        if row < height - 1:
            axes[row].tick_params(labelbottom=True)


def _heat_map(axes: Axes, values: NDArray, shown: Shown, alike: NDArray | None = None) -> AxesImage:
    image = axes.imshow(
        np.ma.masked_invalid(values),
        cmap="viridis_r" if shown.reverse else "viridis",
        norm=shown.norm,
        aspect="auto",
        origin="lower",
    )
    axes.patch.set(facecolor=_NEVER, edgecolor=_NEVER_EDGE, hatch=_HATCH)  # behind masked cells
    size = 9.0 if values.shape[1] <= _ROOMY else 7.5
    if shown.numbers and values.shape[1] <= _LEGIBLE:
        own = np.arange(values.size).reshape(values.shape)
        shades = _shades(values, shown)
        for cell, (row, column) in _places(own if alike is None else alike):
            if np.isfinite(values[cell]):
                style: Any = {"ha": "center", "va": "center", "size": size, "color": shades[cell]}
                text = axes.text(column, row, shown.text(values[cell]), **style)
                text.set_in_layout(False)  # it is within its axes
    return image


def _places(alike: NDArray) -> Iterator[tuple[tuple[int, int], tuple[float, float]]]:
    """A cell of each kind, and where its value is written: mid-way if they make a rectangle."""
    for kind in np.unique(alike):
        (low, high), first = _extent(alike, int(kind))
        row, column = (low + high) / 2
        yield first, (float(row), float(column))


def _extent(alike: NDArray, kind: int) -> tuple[NDArray, tuple[int, int]]:
    """The lower and upper corner (2, 2) of the cells of a kind, and the first of these cells.

    The corners are those of the first cell alone if the cells do not make a rectangle.
    """
    cells = np.argwhere(alike == kind)
    low, high = cells.min(axis=0), cells.max(axis=0)
    is_whole = np.prod(high - low + 1) == len(cells)
    first = (int(cells[0][0]), int(cells[0][1]))
    return np.array([low, high] if is_whole else [cells[0], cells[0]]), first


def _outline(axes: Axes, alike: NDArray, cell: tuple[int, int]) -> None:
    """Frame a cell, with the cells that have the same runs."""
    (low, high), _ = _extent(alike, int(alike[cell]))
    height, width = high - low + 1
    frame: dict[str, Any] = {"fill": False, "clip_on": False, "zorder": 3}
    for colour, line in (("white", 4.0), (_BEST, 2.5)):
        corner = (low[1] - 0.5, low[0] - 0.5)
        axes.add_patch(Rectangle(corner, width, height, edgecolor=colour, linewidth=line, **frame))


def _mark(axes: Axes, hatched: NDArray, values: NDArray, shown: Shown) -> None:
    shades = _shades(values, shown)
    for row, column in np.argwhere(hatched):
        shade, corner = shades[row, column], (column - 0.5, row - 0.5)
        patch = Rectangle(corner, 1, 1, fill=False, edgecolor=shade, hatch=_MARKED, linewidth=0)
        axes.add_patch(patch)
    (image,) = axes.get_images()
    for text in axes.texts if hatched.any() else ():  # a hatch leaves room for the numbers
        column, row = map(int, text.get_position())
        colour = image.to_rgba(values[row, column])
        text.set_bbox({"facecolor": colour, "linewidth": 0, "pad": 1.0})


def _shades(values: NDArray, shown: Shown) -> NDArray:
    """What is legible on the colour of each cell."""
    light = np.ma.filled(shown.norm(np.ma.masked_invalid(values)), 0.0) > _LIGHT
    return np.where(light != shown.reverse, "black", "white")


class Verdicts(NamedTuple):
    """Statements tested under several readings of a paper.

    Attributes:
        readings: names of the rows.
        statements: names of the columns.
        holds: (readings, statements) bool.
        straddles: (readings, statements) bool, whether the interval includes the threshold.
        best: row to highlight.
    """

    readings: Sequence[str]
    statements: Sequence[str]
    holds: NDArray
    straddles: NDArray
    best: int


@styled
def verdict_matrix(verdicts: Verdicts, title: str) -> Figure:
    """Matrix of which statement holds under which reading.

    Args:
        verdicts: rows in drawing order, from the top.
        title: title of the figure.
    """
    rows, columns = verdicts.holds.shape
    figure = Figure(figsize=(9.2, 3.2 + 0.17 * rows))
    figure.suptitle(title)
    axes = figure.subplots()
    no, yes = COLOURS[1], COLOURS[0]
    axes.imshow(verdicts.holds, cmap=ListedColormap([no, yes]), vmin=0, vmax=1, aspect="auto")
    axes.set_xticks(range(columns), verdicts.statements, fontsize=9, rotation=60, ha="right")
    held = verdicts.holds.sum(axis=1)
    names = [f"{name}   {n:2d}" for name, n in zip(verdicts.readings, held, strict=True)]
    axes.set_yticks(range(rows), names, fontsize=7.5)
    axes.get_yticklabels()[verdicts.best].set_fontweight("bold")
    axes.set_xticks(np.arange(columns + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(rows + 1) - 0.5, minor=True)
    axes.grid(visible=False, which="major")
    axes.grid(which="minor", color="white", linewidth=1)
    axes.tick_params(which="both", length=0)
    for row, column in np.argwhere(verdicts.straddles):
        axes.text(column, row, "~", ha="center", va="center", color="white", fontsize=9)
    axes.set_ylabel("interpretation of Q, of R, feedback; how many hold")
    handles = [
        Patch(color=yes, label="holds"),
        Patch(color=no, label="does not hold"),
        Patch(facecolor="none", label="~  the interval reaches across"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure

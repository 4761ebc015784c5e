"""Figures over a grid of settings: heat maps over two axes, and matrices of verdicts."""

from collections.abc import Iterator, Sequence
from textwrap import fill
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray

from sinsjax.plots.labels import axis_label, format_value
from sinsjax.plots.style import ABOVE_SCALE, COLOURS, LETTERS, with_style

_NEVER, _NEVER_EDGE = "#dcdcdc", "#b5b5b5"
_HATCH, _MARKED = "////", "xx"
_ROOMY = 6  # most cells side by side in a panel with full-size numbers
_LEGIBLE = 10  # most cells side by side with small numbers
_LETTERS = 9  # characters per inch in a panel's title
_LEAST, _PANEL = 2.3, 3.0  # in: least width, and height, of a panel with its title
_LETTER = 0.085  # in: a letter
_BAR = 8  # characters per inch along the colour bar
_FRAME, _FRAME_WIDTH = COLOURS[1], 3.5  # colour and width, pt
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
    """

    name: str
    low: float
    high: float
    reverse: bool = False
    digits: int = 0

    @property
    def norm(self) -> Normalize:
        """Normalisation of a value to its position on the colour map, 0 to 1."""
        return Normalize(self.low, self.high, clip=True)


class CellMarks(NamedTuple):
    """Marks of the cells of heat maps in addition to their colour.

    Attributes:
        hatched: for each panel, the cells (rows, columns) to hatch; empty for none.
        hatch_name: meaning of the hatch, for the legend.
        framed: for each panel, the cell (row, column) to frame, or None; empty for none.
        frame_name: meaning of the frame, for the legend.
    """

    hatched: Sequence[NDArray] = ()
    hatch_name: str = ""
    framed: Sequence[tuple[int, int] | None] = ()
    frame_name: str = ""


_NO_MARKS = CellMarks()


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
    marks: CellMarks = _NO_MARKS,
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
        marks: cells to hatch and to frame.
    """
    width = min(4, panels_per_row or 4, len(panels))
    height = -(-len(panels) // width)
    side = max(_LEAST, 7.2 / width)  # width of a panel, in; together as wide as the title
    wide, tall = side * width + 2.0, _PANEL * height + 1.3
    figure = Figure(figsize=(wide, tall))
    figure.suptitle(fill(title, int(LETTERS * wide)))
    # Set before the axes are created: later, every tick would be created twice.
    tick = 10.5 if len(columns.values) <= _ROOMY else 9
    mpl.rcParams.update({"axes.grid": False, "xtick.labelsize": tick})
    grid = figure.subplots(height, width, sharex=True, sharey=True, squeeze=False)
    across, up = ([_tick_label(axis.key, v) for v in axis.values] for axis in (columns, rows))
    grid[0, 0].set_xticks(range(len(across)), across)
    grid[0, 0].set_yticks(range(len(up)), up)
    for number, (axes, (name, values)) in enumerate(zip(grid.flat, panels, strict=False)):
        image = _draw_heat_map(axes, values, quantity)
        if marks.hatched:
            _hatch_cells(axes, np.isfinite(values) & marks.hatched[number], values, quantity)
        if marks.framed and (cell := marks.framed[number]) is not None:
            _frame_cell(axes, cell)
        axes.set_title(fill(name, int(_LETTERS * side)))
    for axes in list(grid.flat)[len(panels) :]:
        axes.set_visible(False)
    for axes in grid[:, 0]:
        axes.set_ylabel(axis_label(rows.key))
    for axes in list(grid.flat)[max(len(panels) - width, 0) : len(panels)]:
        axes.set_xlabel(axis_label(columns.key))
        turned = _LETTER * sum(map(len, across)) > 0.8 * side
        axes.tick_params(axis="x", labelbottom=True, labelrotation=90 if turned else 0)
    finite = np.concatenate([values[np.isfinite(values)] for _, values in panels])
    below, above = bool(np.any(finite < quantity.low)), bool(np.any(finite > quantity.high))
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get((below, above))
    bar = fill(f"{quantity.name}{ABOVE_SCALE if above else ''}", int(_BAR * tall))
    figure.colorbar(image, ax=grid, label=bar, aspect=30, extend=extend or "neither")
    if handles := [*_legend_handles(panels, marks)]:
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


def _legend_handles(panels: Sequence[tuple[str, NDArray]], marks: CellMarks) -> Iterator[Patch]:
    """The entries of the legend."""
    if any(not np.isfinite(values).all() for _, values in panels):
        yield Patch(facecolor=_NEVER, edgecolor=_NEVER_EDGE, hatch=_HATCH, label="never (median)")
    if np.any(marks.hatched):
        yield Patch(facecolor="none", edgecolor="black", hatch=_MARKED, label=marks.hatch_name)
    if any(cell is not None for cell in marks.framed):
        yield Patch(fill=False, edgecolor=_FRAME, linewidth=_FRAME_WIDTH, label=marks.frame_name)


def _draw_heat_map(axes: Axes, values: NDArray, quantity: MapQuantity) -> AxesImage:
    image = axes.imshow(
        np.ma.masked_invalid(values),
        cmap="viridis_r" if quantity.reverse else "viridis",
        norm=quantity.norm,
        aspect="auto",
        origin="lower",
    )
    axes.patch.set(facecolor=_NEVER, edgecolor=_NEVER_EDGE, hatch=_HATCH)  # behind masked cells
    if values.shape[1] > _LEGIBLE:
        return image
    size = 9.0 if values.shape[1] <= _ROOMY else 7.5
    shades = _number_colours(values, quantity)
    for row, column in np.argwhere(np.isfinite(values)):
        style: Any = {"ha": "center", "va": "center", "size": size, "color": shades[row, column]}
        text = axes.text(column, row, f"{values[row, column]:.{quantity.digits}f}", **style)
        text.set_in_layout(False)
    return image


def _frame_cell(axes: Axes, cell: tuple[int, int]) -> None:
    row, column = cell
    style: dict[str, Any] = {"fill": False, "clip_on": False, "zorder": 3}
    for shade, width in (("white", _FRAME_WIDTH + 1.5), (_FRAME, _FRAME_WIDTH)):
        corner = (column - 0.5, row - 0.5)
        axes.add_patch(Rectangle(corner, 1, 1, edgecolor=shade, linewidth=width, **style))


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

"""Common style of all figures: sizes, a colour-blind-safe palette, and PNG output."""

import io
import math
import re
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis, XAxis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imsave
from matplotlib.ticker import (
    FixedLocator,
    Formatter,
    LogFormatterMathtext,
    NullLocator,
    StrMethodFormatter,
)
from numpy.typing import NDArray

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#555555")
"""Okabe and Ito's palette, repeated for more lines than it has colours."""

GREY = "#8a8a8a"
"""Colour of annotations: reset times, limits, cells without a number."""

_SMALL = "#555555"
_RAISED = str.maketrans("0123456789-\N{MINUS SIGN}.", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁻˙")
_STRIP = 0.28  # height of the strip with the footer, in

STYLE: Any = {
    "text.parse_math": False,  # names of studies may contain dollar signs
    "figure.dpi": 130,
    "figure.facecolor": "white",
    "figure.constrained_layout.use": True,
    # On a slide a figure is 1.5 times as wide, so these become at least 16 points.
    "font.size": 11.5,
    "axes.titlesize": 12,
    "axes.titlelocation": "left",
    "axes.labelsize": 11.5,
    "figure.titlesize": 14,
    "figure.titleweight": "bold",
    "xtick.labelsize": 10.5,
    "ytick.labelsize": 10.5,
    "legend.fontsize": 11,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.7,
    "hatch.linewidth": 0.6,
}

P = ParamSpec("P")
R = TypeVar("R")


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Make a function draw in the common style, whatever the caller's settings are."""

    @wraps(draw)
    def inside(*args: P.args, **kwargs: P.kwargs) -> R:
        with mpl.rc_context():
            mpl.rcdefaults()
            mpl.rcParams.update(STYLE)
            return draw(*args, **kwargs)

    return inside


def colour(index: int) -> str:
    """Colour of the line with this number."""
    return COLOURS[index % len(COLOURS)]


def both_sides(axis: Axis, linear: float, first: float | None = None) -> str:
    """Make an axis logarithmic on both sides of 0, so that a wide range is legible.

    Args:
        axis: axis of values of either sign.
        linear: magnitude up to which the axis is nearly linear.
        first: first tick on either side of 0, a power of 10; None for ``linear`` rounded to one.

    Returns:
        A note for the end of the axis label.
    """
    decades = 10.0 ** np.arange(math.floor(math.log10(first or linear) + 0.5), 7)
    set_scale = axis.axes.set_xscale if isinstance(axis, XAxis) else axis.axes.set_yscale
    set_scale("asinh", linear_width=linear)
    axis.set_major_locator(FixedLocator([*-decades[::-1], 0.0, *decades]))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_locator(NullLocator())
    return "\nlogarithmic far from 0"


def legend_outside(figure: Figure, axes: Axes) -> None:
    """Put the legend of some axes below the whole figure, clear of the data."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        room = 12 * figure.get_figwidth()  # characters per line
        columns = max(1, min(len(labels), int(room / (max(map(len, labels)) + 6))))
        figure.legend(handles, labels, loc="outside lower center", ncols=columns)


@styled
def png(figure: Figure, footer: str = "") -> bytes:
    """The figure as a PNG file; the same figure and footer give the same bytes.

    Args:
        figure: figure to draw.
        footer: source of the data, in small print on a strip below the figure.
    """
    drawn = [_pixels(figure)]
    if footer:
        # A separate figure, unaffected by the layout, legend or title of the other one.
        strip = Figure(figsize=(figure.get_figwidth(), _STRIP))
        strip.text(0.1 / figure.get_figwidth(), 0.5, footer, va="center", size=9, color=_SMALL)
        drawn.append(_pixels(strip))
    buffer = io.BytesIO()
    pixels = np.vstack(drawn)
    anonymous: Any = {"Software": None}
    imsave(buffer, pixels, format="png", dpi=figure.dpi, metadata=anonymous)
    return buffer.getvalue()


class _Unicode(Formatter):
    """Labels of a logarithmic axis in Unicode instead of mathematical text."""

    def __init__(self, marked: LogFormatterMathtext) -> None:
        self._marked = marked

    def set_axis(self, axis: Any) -> None:
        super().set_axis(axis)
        self._marked.set_axis(axis)

    def set_locs(self, locs: Any) -> None:
        self._marked.set_locs(locs)

    def __call__(self, x: float, pos: int | None = None) -> str:
        inside = re.sub(r"^\$\\mathdefault\{(.*)\}\$$", r"\1", self._marked(x, pos))
        raised = re.sub(r"\^\{(.*?)\}", lambda found: found[1].translate(_RAISED), inside)
        return raised.replace(r"\times", "×").replace("-", "\N{MINUS SIGN}")


def _pixels(figure: Figure) -> NDArray:
    for axes in figure.findobj(Axes):
        for axis in (axes.xaxis, axes.yaxis):
            if isinstance(formatter := axis.get_major_formatter(), LogFormatterMathtext):
                axis.set_major_formatter(_Unicode(formatter))
            if isinstance(formatter := axis.get_minor_formatter(), LogFormatterMathtext):
                axis.set_minor_formatter(_Unicode(formatter))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]

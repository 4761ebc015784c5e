"""Common style of all figures: sizes, a colour-blind-safe palette, and PNG output."""

import io
from collections.abc import Callable
from functools import wraps
from textwrap import fill
from typing import Any, ParamSpec, TypeVar

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis, XAxis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.image import imsave
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#555555")
"""Okabe and Ito's palette, repeated for more lines than it has colours."""

GREY = "#8a8a8a"
"""Colour of annotations: reset times, bias floors, cells without a number."""

_LETTERS = 7  # characters per inch in the title of a figure
_CAP = 0.95  # quantile at which a colour scale ends, if the rest is far beyond it
_FAR = 1.5  # times the range up to that quantile
_LEVEL = 3  # of zlib; the default takes twice the time for 2 % less
_STRIP = 0.28  # height of the strip with the footer, in

STYLE: Any = {
    "text.parse_math": False,  # names of studies may contain dollar signs
    "figure.dpi": 130,
    "figure.constrained_layout.use": True,
    # On a slide a figure is 1.5 times as wide, so these become at least 16 points.
    "font.size": 11,
    "axes.titlesize": 12,
    "axes.titlelocation": "left",
    "figure.titlesize": 14,
    "figure.titleweight": "bold",
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


def with_style(draw: Callable[P, R]) -> Callable[P, R]:
    """Make a function draw in the common style, whatever the caller's settings are."""

    @wraps(draw)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        with mpl.rc_context():
            mpl.rcdefaults()
            mpl.rcParams.update(STYLE)
            return draw(*args, **kwargs)

    return wrapper


def line_colour(index: int) -> str:
    """Colour of the line with this number."""
    return COLOURS[index % len(COLOURS)]


def colour_range(values: NDArray) -> Normalize:
    """Return a colour scale of the finite values that a few far above the others do not stretch."""
    known = values[np.isfinite(values)]
    if not known.size:
        return Normalize(0.0, 1.0)
    low, high, cap = known.min(), known.max(), np.quantile(known, _CAP, method="higher")
    high = cap if high - low > _FAR * (cap - low) > 0 else high
    return Normalize(low, high if high > low else low + 1, clip=True)


def set_log_scale(axis: Axis, low: float, high: float) -> None:
    """Make an x or y axis logarithmic, with plain numbers at its ticks.

    A range from ``low`` (positive) to ``high`` below two decades has ticks within decades too.
    """
    (axis.axes.set_xscale if isinstance(axis, XAxis) else axis.axes.set_yscale)("log")
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 100 * low else (1.0,)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def add_title(figure: Figure, title: str) -> None:
    """Add the title of a figure, wrapped to its width."""
    figure.suptitle(fill(title, int(_LETTERS * figure.get_figwidth())))


def add_colour_bar(
    figure: Figure, axes: Any, image: ScalarMappable, label: str, values: NDArray
) -> None:
    """Add the colour bar of some axes; it has a tip if some of the values lie above its scale."""
    tip = "max" if (values[np.isfinite(values)] > image.norm.vmax).any() else "neither"
    label = fill(label, int(8 * figure.get_figheight()))
    figure.colorbar(image, ax=axes, label=label, aspect=30, extend=tip)


def add_legend_below(figure: Figure, axes: Axes) -> None:
    """Put the legend of some axes below the whole figure, clear of the data."""
    handles, labels = axes.get_legend_handles_labels()
    if labels:
        room = 12 * figure.get_figwidth()  # characters per line
        columns = max(1, min(len(labels), int(room / (max(map(len, labels)) + 6))))
        figure.legend(handles, labels, loc="outside lower center", ncols=columns)


@with_style
def render_png(figure: Figure, footer: str = "") -> bytes:
    """Return the figure as a PNG file; the same figure and footer give the same bytes.

    The footer, the source of the data, is in small print on a strip below the figure.
    """
    # A separate figure, unaffected by the layout, legend or title of the other one.
    strip = Figure(figsize=(figure.get_figwidth(), _STRIP))
    strip.text(0.1 / figure.get_figwidth(), 0.5, footer, va="center", size=9, color=COLOURS[-1])
    canvases = [FigureCanvasAgg(part) for part in ([figure, strip] if footer else [figure])]
    for canvas in canvases:
        canvas.draw()
    pixels = np.vstack([np.asarray(canvas.buffer_rgba())[..., :3] for canvas in canvases])
    buffer, mark = io.BytesIO(), {"Software": "sinsjax"}  # its figures, for `sweep --overwrite`
    fast: Any = {"metadata": mark, "pil_kwargs": {"compress_level": _LEVEL}}
    imsave(buffer, pixels, format="png", dpi=figure.dpi, **fast)
    return buffer.getvalue()

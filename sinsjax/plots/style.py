"""One look for every figure: sizes, a palette that colour-blind readers can tell apart, PNG out."""

import io
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#555555")
"""Okabe and Ito's palette; lines beyond its length repeat it."""

GREY = "#8a8a8a"
"""Of what is marked but not measured: reset moments, limits, cells without a number."""

STYLE: Any = {
    "figure.dpi": 110,
    "figure.facecolor": "white",
    "figure.constrained_layout.use": True,
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.labelsize": 9.5,
    "figure.titlesize": 12,
    "figure.titleweight": "bold",
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.5,
    "hatch.linewidth": 0.6,
}

UNITS = {
    "arcmin": "arcmin",
    "deg": "deg",
    "deg_per_h": "deg/h",
    "ug": "µg",
    "m_per_s": "m/s",
    "per_s": "1/s",
    "s": "s",
}
"""How a unit at the end of a column's name is printed."""

P = ParamSpec("P")
R = TypeVar("R")


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Makes a function draw in the one style, whatever the caller's settings are."""

    @wraps(draw)
    def inside(*args: P.args, **kwargs: P.kwargs) -> R:
        with mpl.rc_context():
            mpl.rcdefaults()
            mpl.rcParams.update(STYLE)
            return draw(*args, **kwargs)

    return inside


def colour(index: int) -> str:
    """The palette's colour of the line with this number."""
    return COLOURS[index % len(COLOURS)]


def label(column: str) -> str:
    """A column or key as an axis label: ``phi_u0_deg`` becomes ``phi_u0 (deg)``."""
    name, unit = _split(column)
    return f"{name} ({unit})" if unit else name


def setting(key: str, value: str) -> str:
    """A key with its value in words: ``phi_u0_deg`` at 30 becomes ``phi_u0 30 deg``."""
    name, unit = _split(key)
    return f"{name} {value} {unit}" if unit and value[-1:].isdigit() else f"{name} {value}"


def _split(column: str) -> tuple[str, str]:
    """A column's name without its unit, and the unit as it is printed."""
    unit = max((u for u in UNITS if column.endswith(f"_{u}")), key=len, default="")
    return (column.removesuffix(f"_{unit}"), UNITS[unit]) if unit else (column, "")


def legend_outside(figure: Figure, axes: Axes) -> None:
    """Puts the legend of some axes below the whole figure, clear of the data."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        room = 15 * figure.get_figwidth()  # letters in a line
        columns = max(1, min(len(labels), int(room / (max(map(len, labels)) + 6))))
        figure.legend(handles, labels, loc="outside lower center", ncols=columns)


@styled
def png(figure: Figure) -> bytes:
    """The figure as a PNG file; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()

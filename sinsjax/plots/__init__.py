"""Figures from tables, in one style; each module holds one kind of figure.

Every function returns a new matplotlib `Figure`; `png` converts it to bytes that depend only on the
figure. Nothing here changes matplotlib's global state.
"""

from sinsjax.plots.beliefs import BeliefPanel, beliefs, plot_belief
from sinsjax.plots.believed import Course, believed
from sinsjax.plots.curves import (
    Ensemble,
    Line,
    attitude,
    draw,
    ensembles,
    misalignment,
    plot_curves,
    squares,
    yaw_errors,
)
from sinsjax.plots.errors import over_time
from sinsjax.plots.grids import (
    Contours,
    Marks,
    Scale,
    Shown,
    Verdicts,
    differ,
    heat_maps,
    spread,
    verdict_matrix,
)
from sinsjax.plots.maps import plot_map
from sinsjax.plots.spreads import Expected, along_axis, plot_compare, tells
from sinsjax.plots.stored_records import survival
from sinsjax.plots.style import COLOURS, STYLE, colour, png
from sinsjax.plots.words import label, setting

__all__ = [
    "COLOURS",
    "STYLE",
    "BeliefPanel",
    "Contours",
    "Course",
    "Ensemble",
    "Expected",
    "Line",
    "Marks",
    "Scale",
    "Shown",
    "Verdicts",
    "along_axis",
    "attitude",
    "beliefs",
    "believed",
    "colour",
    "differ",
    "draw",
    "ensembles",
    "heat_maps",
    "label",
    "misalignment",
    "over_time",
    "plot_belief",
    "plot_compare",
    "plot_curves",
    "plot_map",
    "png",
    "setting",
    "spread",
    "squares",
    "survival",
    "tells",
    "verdict_matrix",
    "yaw_errors",
]

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
)
from sinsjax.plots.grids import (
    Marks,
    Scale,
    Shown,
    differ,
    heat_maps,
)
from sinsjax.plots.maps import plot_map
from sinsjax.plots.spreads import Expected, along_axis, plot_compare, tells
from sinsjax.plots.style import COLOURS, STYLE, colour, png
from sinsjax.plots.words import label, setting

__all__ = [
    "COLOURS",
    "STYLE",
    "BeliefPanel",
    "Course",
    "Ensemble",
    "Expected",
    "Line",
    "Marks",
    "Scale",
    "Shown",
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
    "plot_belief",
    "plot_compare",
    "plot_curves",
    "plot_map",
    "png",
    "setting",
    "squares",
    "tells",
]

"""Figures from tables: one style, one file a kind of figure, nothing computed that is not drawn.

Every function returns a matplotlib `Figure` of its own; `png` turns it into bytes that depend on
the figure alone. Nothing here touches matplotlib's global state.
"""

from sinsjax.plots.curves import (
    Ensemble,
    Line,
    attitude,
    draw,
    ensembles,
    misalignment,
    squares,
    yaw_errors,
)
from sinsjax.plots.grids import Scale, Shown, Verdicts, heat_maps, verdict_matrix
from sinsjax.plots.spreads import along_axis, distributions
from sinsjax.plots.style import COLOURS, colour, label, png, setting

__all__ = [
    "COLOURS",
    "Ensemble",
    "Line",
    "Scale",
    "Shown",
    "Verdicts",
    "along_axis",
    "attitude",
    "colour",
    "distributions",
    "draw",
    "ensembles",
    "heat_maps",
    "label",
    "misalignment",
    "png",
    "setting",
    "squares",
    "verdict_matrix",
    "yaw_errors",
]

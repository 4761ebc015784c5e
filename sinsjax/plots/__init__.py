"""Figures from tables, in one style; each module has one kind of figure.

Every function returns a new matplotlib `Figure`; `render_png` converts it to bytes that depend only
on the figure. Nothing here changes matplotlib's global state.
"""

from sinsjax.plots.comparison import plot_compare
from sinsjax.plots.consistency import plot_belief
from sinsjax.plots.curves import draw_mean_and_95_percent_band, group_curves, plot_curves
from sinsjax.plots.maps import plot_map
from sinsjax.plots.style import COLOURS, render_png

__all__ = [
    "COLOURS",
    "draw_mean_and_95_percent_band",
    "group_curves",
    "plot_belief",
    "plot_compare",
    "plot_curves",
    "plot_map",
    "render_png",
]

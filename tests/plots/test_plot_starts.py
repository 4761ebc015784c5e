import numpy as np

from sinsjax import plots
from sinsjax.plots import starts


def legend_of(figure):
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def test_strips_show_one_dot_per_start_and_median_line():
    rows = {"a": np.array([1.0, -2.0, 30.0]), "b": np.array([0.5, 0.6, 0.7]), "c": np.zeros(3)}
    figure = starts.strips(rows, "T", "error (arcmin)", kinds=["x", "y", "x"])
    (axes,) = figure.axes
    dots = [line for line in axes.lines if line.get_marker() == "o"]
    medians = [line.get_xdata()[0] for line in axes.lines if line.get_linewidth() == 2.2]
    assert [list(line.get_xdata()) for line in dots] == [list(v) for v in rows.values()]
    assert medians == [1.0, 0.6, 0.0]
    assert dots[0].get_color() == dots[2].get_color() != dots[1].get_color()
    assert legend_of(figure) == ["x", "y"]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["a", "b", "c"]
    assert axes.get_xscale() == "asinh" and axes.get_xlabel().startswith("error (arcmin)")
    assert plots.png(figure).startswith(b"\x89PNG")

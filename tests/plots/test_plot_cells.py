"""Figures over cells that have names."""

import math

import numpy as np

from sinsjax.analysis import Estimate
from sinsjax.plots.cells import Class, beside, ratio_maps

NEVER = math.inf


def test_a_class_has_its_limit():
    """1.1 itself is within, as in the counts."""
    classes = [Class(1.1, "within", "#ffffff"), Class(math.inf, "beyond", "#000000", dark=True)]
    values = np.array([[1.1, np.nextafter(1.1, 2)], [NEVER, 0.0]])
    figure = ratio_maps(
        [("panel", values)], classes, "title", rows=["a", "b"], columns=["c", "d"], side="rows"
    )
    array = figure.axes[0].images[0].get_array()
    assert array.tolist() == [[0, 1], [None, 0]]
    labels = [t.get_text() for t in figure.legends[0].get_texts()]
    assert labels == ["within", "beyond", "never (median)"]


def test_what_never_settles_is_marked_at_the_edge():
    sure, never = Estimate(100, 90, 110, 8), Estimate(NEVER, NEVER, NEVER, 8)
    figure = beside(
        ["a", "b"],
        {"panel": {"line": [sure, never]}},
        {"panel": [(2.0, 5.0), (math.nan, math.nan)]},
        "title",
        side="start",
        quantity="time (s)",
        span="resets",
    )
    axes = figure.axes[0]
    (marks,) = [line for line in axes.lines if line.get_marker() == "x"]
    assert marks.get_xdata().tolist() == [1.0]
    labels = [t.get_text() for t in figure.legends[0].get_texts()]
    assert labels == ["line", "resets", "never (median)"]


def test_panels_that_are_not_there_are_hidden():
    one = np.ones((2, 3))
    figure = ratio_maps(
        [(name, one) for name in "abc"],
        [Class(math.inf, "any", "#ffffff")],
        "title",
        rows=["r", "s"],
        columns=["x", "y", "z"],
        side="rows",
        across=2,
    )
    assert [axes.get_visible() for axes in figure.axes] == [True, True, True, False]
    assert [t.get_text() for t in figure.axes[2].texts] == ["1.00"] * 6
    labels = [t.get_text() for t in figure.legends[0].get_texts()]
    assert labels == ["any"]

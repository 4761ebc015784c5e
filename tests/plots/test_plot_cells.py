"""Figures over cells that have names."""

import math

import numpy as np

from sinsjax.plots.cells import Class, ratio_maps

NEVER = math.inf


def test_ratio_map_class_includes_its_upper_bound():
    """1.1 itself is within, as in the counts."""
    classes = [Class(1.1, "within", "#ffffff"), Class(math.inf, "beyond", "#000000", dark=True)]
    values = np.array([[1.1, np.nextafter(1.1, 2)], [NEVER, 0.0]])
    figure = ratio_maps(
        [("panel", values)],
        classes,
        "title",
        rows=["a", "b"],
        columns=["c", "d"],
        side="rows",
        only="only it",
    )
    array = figure.axes[0].images[0].get_array()
    assert array.tolist() == [[0, 1], [None, 0]]
    labels = [t.get_text() for t in figure.legends[0].get_texts()]
    assert labels == ["within", "beyond", "*  only it", "never (median)"]
    assert [t.get_text() for t in figure.axes[0].texts] == ["1.10", "1.10", "*"]


def test_ratio_map_hides_unused_panels():
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

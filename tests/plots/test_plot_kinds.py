import numpy as np

from sinsjax import plots
from sinsjax.plots import Scale
from sinsjax.plots.kinds import Kind, kind_maps

KINDS = (Kind("o", "fine", "#dcdcdc"), Kind("x", "broken", "#0072B2", dark=True))


def maps(panels, across):
    sides = {"rows": Scale("level_deg", [0, 5]), "columns": Scale("yaw_deg", [1, 30, 120])}
    return kind_maps(panels, KINDS, "What holds", across=across, **sides)


def test_every_cell_has_the_mark_and_colour_of_its_kind():
    values = np.array([[0, 1, 1], [1, 0, 0]])
    axes, *hidden = maps([("a", values), ("b", values), ("c", 1 - values)], across=2).axes[::3]
    assert not hidden[0].get_visible()
    marks = {tuple(map(round, t.get_position())): t for t in axes.texts}
    assert {at: t.get_text() for at, t in marks.items()} == {
        (column, row): KINDS[values[row, column]].mark for row in range(2) for column in range(3)
    }
    assert marks[0, 0].get_color() == "black" and marks[1, 0].get_color() == "white"
    (image,) = axes.images
    shown = image.to_rgba(image.get_array(), bytes=True)
    assert tuple(shown[0, 0, :3]) == (0xDC, 0xDC, 0xDC)
    assert tuple(shown[0, 1, :3]) == (0x00, 0x72, 0xB2)


def test_sides_are_named_once_and_kinds_are_in_the_legend():
    figure = maps([("a", np.zeros((2, 3), int)), ("b", np.ones((2, 3), int))], across=1)
    upper, lower = figure.axes
    assert [upper.get_xlabel(), lower.get_xlabel()] == ["", "yaw (deg)"]
    assert upper.get_ylabel() == "level (deg)"
    assert [t.get_text() for t in lower.get_xticklabels()] == ["1", "30", "120"]
    (legend,) = figure.legends
    assert [t.get_text() for t in legend.get_texts()] == ["o  fine", "x  broken"]
    assert plots.png(figure)[:4] == b"\x89PNG"

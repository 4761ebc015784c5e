import numpy as np
import pytest
from matplotlib.colors import to_rgb

from sinsjax import plots
from sinsjax.plots import Line, Mark

TIME = np.arange(0.0, 101.0)


def line(label, level, colour="C0"):
    noise = 1e-3 * np.random.default_rng(1).normal(size=(5, TIME.size))
    return Line(label, TIME, level + noise, colour)


def test_attitude_errors_enlarge_what_is_near_a_mark():
    lines = {
        "pitch": [line("a", 0.1), line("b", 0.2)],
        "heading": [line("a", 0.05), line("b", 2.0)],
    }
    marks = [Mark("limit", {"pitch": 0.1, "heading": 0.1}), Mark("printed", {"pitch": 0.3}, ":")]
    figure = plots.attitude_errors(lines, "Title", marks=marks, zoom_s=(80.0, 100.0), reach=0.5)
    whole, enlarged, _, heading = figure.axes
    assert enlarged.get_xlim() == (80.0, 100.0) and whole.get_xlim() == (0.0, 100.0)
    low, high = enlarged.get_ylim()
    assert low < 0.1 and 0.3 < high < 0.4
    low, high = heading.get_ylim()  # without b, which is far off
    assert 0.0 < low < 0.05 and 0.1 < high < 0.2
    assert whole.get_ylabel() == "pitch error (deg)"
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["a", "b", "limit"]


def test_a_mark_is_drawn_where_it_has_a_value():
    marks = [Mark("printed", {"roll": 0.5}, "-.", "black")]
    lines = {"pitch": [line("a", 0.1)], "roll": [line("a", 0.1)]}
    figure = plots.attitude_errors(lines, "Title", marks=marks, zoom_s=(80.0, 100.0))
    drawn = [
        [mark for mark in axes.get_lines() if len(mark.get_xdata()) == 2] for axes in figure.axes
    ]
    assert [len(here) for here in drawn] == [0, 0, 0, 1]
    assert to_rgb(drawn[3][0].get_color()) == (0.0, 0.0, 0.0)
    assert drawn[3][0].get_ydata()[0] == 0.5


def test_an_enlargement_without_records_or_marks_is_drawn():
    figure = plots.attitude_errors({"pitch": [line("a", 0.1)]}, "Title", zoom_s=(200.0, 300.0))
    assert figure.axes[1].get_xlim() == (200.0, 300.0)


@pytest.mark.parametrize(("floor", "scale"), [(None, "linear"), (1e-3, "log")])
def test_lines_over_time(floor, scale):
    panels = {"one": [line("a", 1.0)], "two": [line("a", 2.0), line("b", 3.0, "C1")]}
    figure = plots.over_time(panels, "Title", quantity="size (deg)", floor=floor)
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["one", "two"]
    assert {axes.get_yscale() for axes in figure.axes} == {scale}
    assert figure.axes[0].get_ylabel() == "size (deg)"
    if floor:
        assert figure.axes[0].get_ylim()[0] == floor
    assert plots.png(figure) == plots.png(figure)

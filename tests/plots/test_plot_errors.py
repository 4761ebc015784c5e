import numpy as np
import pytest

from sinsjax import plots
from sinsjax.plots import Line

TIME = np.arange(0.0, 101.0)


def line(label, level, colour="C0"):
    noise = 1e-3 * np.random.default_rng(1).normal(size=(5, TIME.size))
    return Line(label, TIME, level + noise, colour)


@pytest.mark.parametrize(("floor", "scale"), [(None, "linear"), (1e-3, "log")])
def test_over_time_sets_panel_titles_scale_and_label(floor, scale):
    panels = {"one": [line("a", 1.0)], "two": [line("a", 2.0), line("b", 3.0, "C1")]}
    figure = plots.over_time(panels, "Title", quantity="size (deg)", floor=floor)
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["one", "two"]
    assert {axes.get_yscale() for axes in figure.axes} == {scale}
    assert figure.axes[0].get_ylabel() == "size (deg)"
    if floor:
        assert figure.axes[0].get_ylim()[0] == floor
    assert plots.png(figure) == plots.png(figure)

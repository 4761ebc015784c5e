"""A figure that only a page draws."""

import numpy as np

from docs.studies.compass_map.survival import survival
from sinsjax import plots


def test_survival_plot_shows_share_of_unsettled_runs():
    times = np.array([30.0, np.inf, 10.0, np.nan])
    figure = survival(
        {"6": {"a": times}, "1": {"a": np.full(2, np.inf)}},
        "Title",
        end_s=100.0,
        levels={"1": {"a": 0.2}},
    )
    left, right = figure.axes
    (line,) = left.get_lines()
    np.testing.assert_array_equal(line.get_xdata(), [0.0, 10.0, 30.0, 100.0])
    np.testing.assert_array_equal(line.get_ydata(), [1.0, 0.75, 0.5, 0.5])
    flat, level = right.get_lines()
    np.testing.assert_array_equal(flat.get_ydata(), [1.0, 1.0])
    assert set(level.get_ydata()) == {0.2}
    assert left.get_xlim() == (0.0, 100.0)
    assert plots.render_png(figure)

import math

import numpy as np
import pytest
from matplotlib.colors import LogNorm

from sinsjax import plots
from sinsjax.plots import Contours, Scale, Shown

SIGMAS, TAPES = [0.01, 0.02, 0.04], [20.0, 40.0]


def maps(values, *, log=True, contours=None, low=0.1, high=100.0):
    return plots.heat_maps(
        [("a", np.asarray(values)), ("b", np.asarray(values))],
        "Title",
        Shown("error (arcmin)", low, high, reverse=True, log=log),
        rows=Scale("azimuth_sigma_per_s", SIGMAS),
        columns=Scale("stored_s", TAPES),
        contours=contours,
    )


def test_heat_map_uses_log_colours_and_two_digits_per_cell():
    figure = maps([[0.123, 4.56], [78.9, 1234.0], [0.0, np.inf]])
    axes = figure.axes[0]
    assert [t.get_text() for t in axes.texts] == ["0.12", "4.6", "79", "1234", "0"]
    norm = axes.get_images()[0].norm
    assert isinstance(norm, LogNorm)
    assert norm(math.sqrt(0.1 * 100.0)) == pytest.approx(0.5)
    assert [t.get_color() for t in axes.texts][:4] == ["black", "white", "white", "white"]
    assert axes.get_ylabel() == "sigma of the azimuth loop (1/s)"
    assert plots.png(figure)


def test_heat_map_contours_lie_at_their_values():
    # Values that grow from the left edge (0) to the right edge (1) of two cells.
    values = np.tile(np.linspace(0.0, 1.0, 21), (11, 1))
    contours = Contours("radius", (0.25, 0.5), [values, values])
    figure = maps(np.ones((3, 2)), contours=contours)
    (lines,) = [c for c in figure.axes[0].collections if hasattr(c, "levels")]
    places = [path.vertices for path in lines.get_paths()]
    np.testing.assert_allclose(places[0][:, 0], 0.0)  # the middle of the left cell
    np.testing.assert_allclose(places[1][:, 0], 0.5)
    assert (places[0][:, 1].min(), places[0][:, 1].max()) == (-0.5, 2.5)
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["radius 0.25", "0.5"]
    assert plots.png(figure)


def test_spread_interpolates_cell_centres_and_extends_to_edges():
    found = plots.spread([1.0, 4.0, 64.0], 7)
    np.testing.assert_allclose(found[1::2], [1.0, 4.0, 64.0])
    np.testing.assert_allclose(found[::2], [0.5, 2.0, 16.0, 256.0])


def test_survival_plot_shows_share_of_unsettled_runs():
    times = np.array([30.0, np.inf, 10.0, np.nan])
    figure = plots.survival(
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
    assert plots.png(figure)

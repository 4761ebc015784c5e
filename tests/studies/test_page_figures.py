"""Figures that only pages of studies draw."""

import math

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from docs.studies.adaptive.cells import Class, ratio_maps
from docs.studies.compass_car.starts import strips
from docs.studies.compass_map.contours import Contours, draw_contours, legend, spread
from docs.studies.compass_map.survival import survival
from docs.studies.paper1.figures import Verdicts, verdict_matrix, yaw_errors
from docs.studies.paper2.lines import over_time
from sinsjax import plots
from sinsjax.plots import Ensemble, GridAxis, Line, MapQuantity

NEVER = math.inf
TIME = np.arange(0.0, 101.0)


def legend_of(figure):
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def line(label, level, colour="C0"):
    noise = 1e-3 * np.random.default_rng(1).normal(size=(5, TIME.size))
    return Line(label, TIME, level + noise, colour)


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


def test_strips_show_one_dot_per_start_and_median_line():
    rows = {"a": np.array([1.0, -2.0, 30.0]), "b": np.array([0.5, 0.6, 0.7]), "c": np.zeros(3)}
    figure = strips(rows, "T", "error (arcmin)", kinds=["x", "y", "x"])
    (axes,) = figure.axes
    dots = [line for line in axes.lines if line.get_marker() == "o"]
    medians = [line.get_xdata()[0] for line in axes.lines if line.get_linewidth() == 2.2]
    assert [list(line.get_xdata()) for line in dots] == [list(v) for v in rows.values()]
    assert medians == [1.0, 0.6, 0.0]
    assert dots[0].get_color() == dots[2].get_color() != dots[1].get_color()
    assert legend_of(figure) == ["x", "y"]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["a", "b", "c"]
    assert axes.get_xscale() == "asinh" and axes.get_xlabel().startswith("error (arcmin)")
    assert plots.render_png(figure).startswith(b"\x89PNG")


@pytest.mark.parametrize(("floor", "scale"), [(None, "linear"), (1e-3, "log")])
def test_over_time_sets_panel_titles_scale_and_label(floor, scale):
    panels = {"one": [line("a", 1.0)], "two": [line("a", 2.0), line("b", 3.0, "C1")]}
    figure = over_time(panels, "Title", quantity="size (deg)", floor=floor)
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["one", "two"]
    assert {axes.get_yscale() for axes in figure.axes} == {scale}
    assert figure.axes[0].get_ylabel() == "size (deg)"
    if floor:
        assert figure.axes[0].get_ylim()[0] == floor
    assert plots.render_png(figure) == plots.render_png(figure)


def test_heat_map_contours_lie_at_their_values():
    # Values that grow from the left edge (0) to the right edge (1) of two cells.
    values = np.tile(np.linspace(0.0, 1.0, 21), (11, 1))
    contours = Contours("radius", (0.25, 0.5), [values, values])
    figure = plots.draw_heat_maps(
        [("a", np.ones((3, 2))), ("b", np.ones((3, 2)))],
        "Title",
        MapQuantity("error (arcmin)", 0.1, 100.0, reverse=True, log=True),
        rows=GridAxis("azimuth_sigma_per_s", [0.01, 0.02, 0.04]),
        columns=GridAxis("stored_s", [20.0, 40.0]),
        legend=legend(contours),
    )
    for axes, some in zip(figure.axes, contours.values, strict=False):
        draw_contours(axes, contours.levels, some)
    (lines,) = [c for c in figure.axes[0].collections if hasattr(c, "levels")]
    places = [path.vertices for path in lines.get_paths()]
    np.testing.assert_allclose(places[0][:, 0], 0.0)  # the middle of the left cell
    np.testing.assert_allclose(places[1][:, 0], 0.5)
    assert (places[0][:, 1].min(), places[0][:, 1].max()) == (-0.5, 2.5)
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["radius 0.25", "0.5"]
    assert plots.render_png(figure)


def test_spread_interpolates_cell_centres_and_extends_to_edges():
    found = spread([1.0, 4.0, 64.0], 7)
    np.testing.assert_allclose(found[1::2], [1.0, 4.0, 64.0])
    np.testing.assert_allclose(found[::2], [0.5, 2.0, 16.0, 256.0])


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


def test_yaw_errors_have_one_panel_per_name():
    noise = np.random.default_rng(7).normal(size=(4, TIME.size))
    shown = [Ensemble(f"s{size}", TIME, {"phi_u_arcmin": size + noise}) for size in (1.0, 800.0)]
    panels = {name: shown for name in "abc"}
    figure = yaw_errors(panels, "Title")
    visible = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_title(loc="left") for axes in visible] == list("abc")
    assert all(len(axes.get_lines()) == 2 for axes in visible)
    assert len(figure.axes) == 4
    assert plots.render_png(figure)


def test_verdict_matrix_shows_counts_and_marks_best_reading():
    verdicts = Verdicts(
        readings=["a", "b"],
        statements=["S1", "S2", "S3"],
        holds=np.array([[True, False, True], [True, True, True]]),
        straddles=np.array([[False, True, False], [False, False, False]]),
        best=1,
    )
    figure = verdict_matrix(verdicts, "Title")
    assert plots.render_png(figure)
    axes = figure.axes[0]
    assert [t.get_text() for t in axes.get_xticklabels()] == ["S1", "S2", "S3"]
    assert [t.get_text().split() for t in axes.get_yticklabels()] == [["a", "2"], ["b", "3"]]
    assert [t.get_fontweight() for t in axes.get_yticklabels()] == ["normal", "bold"]
    assert [t.get_position() for t in axes.texts] == [(1, 0)]
    image = axes.get_images()[0]
    held = image.to_rgba(image.get_array())[..., :3]
    np.testing.assert_allclose(held[1, 1], to_rgb(plots.COLOURS[0]), atol=0.01)

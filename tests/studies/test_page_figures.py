"""Figures that only pages of studies draw."""

import math

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from docs.studies.adaptive.ratios import PolicyRatios, draw_ratios
from docs.studies.compass_map.contours import ERROR_LEVELS_ARCMIN, Panel, contour_maps, spaced
from docs.studies.compass_map.starts import strips
from docs.studies.compass_map.survival import survival
from docs.studies.paper1.figures import Verdicts, verdict_bars, yaw_errors
from docs.studies.paper2.lines import over_time
from sinsjax import plots
from sinsjax.plots import Ensemble, GridAxis, Line

NEVER = math.inf
TIME = np.arange(0.0, 101.0)


def legend_of(figure):
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def line(label, level, colour="C0"):
    noise = 1e-3 * np.random.default_rng(1).normal(size=(5, TIME.size))
    return Line(label, TIME, level + noise, colour)


def test_ratios_show_median_and_worst_cell_per_policy():
    """An infinite ratio is at the tick *never*, right of all others, without a number."""
    policies = [PolicyRatios("a", 0.9, 1.5), PolicyRatios("b", 2.5, NEVER)]
    figure = draw_ratios(policies, "title", 1.1)
    (axes,) = figure.axes
    dots = [line for line in axes.lines if line.get_marker() == "o"]
    places = [(float(dot.get_xdata()[0]), float(dot.get_ydata()[0])) for dot in dots]
    never = axes.get_xticks()[-1]
    assert places == [(0.9, 0), (1.5, 0), (2.5, 1), (never, 1)] and never > 2.5
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["1", "2", "never"]
    assert [tick.get_text() for tick in axes.get_yticklabels()] == ["a", "b"]
    assert [text.get_text() for text in axes.texts] == ["0.90", "1.50", "2.50"]
    assert legend_of(figure) == ["median cell", "worst cell"]


def test_ratios_of_policies_that_never_settle_are_drawn():
    figure = draw_ratios([PolicyRatios("a", NEVER, NEVER)], "title", 1.1)
    (axes,) = figure.axes
    assert not axes.texts and axes.get_xticklabels()[-1].get_text() == "never"


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


@pytest.mark.representative("0.001-log")
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


def test_contours_lie_at_their_values_and_are_labelled():
    # The error grows by 100 from column to column; the radius from 0 to 2 over the columns.
    errors = np.tile([0.1, 10.0, 1000.0], (2, 1))
    radii = np.tile(np.linspace(0.0, 2.0, 9), (5, 1))
    figure = contour_maps(
        [Panel("a", errors, radii), Panel("b", errors, radii), Panel("c", errors, radii)],
        "Title",
        rows=GridAxis("azimuth_sigma_per_s", [0.01, 0.04]),
        columns=GridAxis("stored_s", [10.0, 100.0, 1000.0]),
    )
    assert plots.render_png(figure)
    panels = figure.axes[:4]
    assert [axes.get_visible() for axes in panels] == [True, True, True, False]
    assert [t.get_text() for t in panels[0].get_yticklabels()] == ["0.01", "0.04"]
    filled, lines, circles = (c for c in panels[0].collections if hasattr(c, "levels"))
    np.testing.assert_allclose(10**filled.levels, ERROR_LEVELS_ARCMIN)
    # log10 of the length where the error has each level, on axes linear in the logarithm.
    expected = (np.log10(ERROR_LEVELS_ARCMIN) + 3) / 2
    for path, place in zip(lines.get_paths(), expected, strict=True):
        np.testing.assert_allclose(path.vertices[:, 0], place)
    for path, place in zip(circles.get_paths(), [1.5, 2.0], strict=True):
        np.testing.assert_allclose(path.vertices[:, 0], place)
    names = {t.get_text() for t in panels[0].texts}
    assert names == {"0.3", "1", "3", "10", "100", "0.5"}
    bar = figure.axes[-1]
    assert [t.get_text() for t in bar.get_yticklabels()] == ["0.3", "1", "3", "10", "100"]
    assert bar.get_ylabel() == "rms heading error (arcmin)"


def test_spaced_values_are_even_on_a_logarithmic_axis():
    np.testing.assert_allclose(spaced([1.0, 3.0, 16.0], 5), [1.0, 2.0, 4.0, 8.0, 16.0])


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


def test_verdict_bars_count_interpretations_and_colour_by_best():
    verdicts = Verdicts(
        statements=["S1", "S2", "S3"],
        holds=np.array([[True, False, False], [True, True, False]]),
        straddles=np.array([[True, True, False], [False, False, False]]),
        best=0,
    )
    figure = verdict_bars(verdicts, "Title")
    assert plots.render_png(figure)
    (axes,) = figure.axes
    assert [t.get_text() for t in axes.get_yticklabels()] == ["S1", "S2", "S3"]
    assert axes.get_ylim()[0] > axes.get_ylim()[1]  # the first statement on top
    held, undecided = axes.containers
    assert [bar.get_width() for bar in held] == [2, 1, 0]
    assert [t.get_text() for t in axes.texts] == ["2", "1", "0"]
    yes, no = map(to_rgb, plots.COLOURS[:2])
    assert [bar.get_facecolor()[:3] for bar in held] == [yes, no, no]
    # S2 fails with an interval that reaches across in one of the two; S1 holds where it straddles.
    assert [(bar.get_x(), bar.get_width()) for bar in undecided] == [(2, 0), (1, 1), (0, 0)]
    assert axes.get_xlim() == (0, 2)

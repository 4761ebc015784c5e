import io
import math

import matplotlib as mpl
import numpy as np
import pyarrow as pa
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from scipy import stats

from sinsjax import plots
from sinsjax.analysis import Estimate
from sinsjax.plots import ConsistencyLine, Ensemble, Line

TIME = np.arange(1.0, 11.0)


def make_ensemble(label, *, runs=4, size=1.0, sigma=2.0):
    noise = np.random.default_rng(7).normal(size=(runs, TIME.size))
    columns = {f"phi_{axis}_arcmin": size + noise for axis in "enu"}
    columns |= {f"sigma_{axis}_arcmin": np.full((runs, TIME.size), sigma) for axis in "enu"}
    columns |= {f"{angle}_deg": 0.1 * noise for angle in ("pitch", "roll", "yaw")}
    return Ensemble(label, TIME, columns)


def figure_text(figure: Figure) -> str:
    """Return all visible text of a figure."""
    return "\n".join(t.get_text() for t in figure.findobj(mpl.text.Text) if t.get_text().strip())


def test_ensembles_arrange_runs_by_record():
    runs, times = np.repeat([3, 5, 8], 2), np.tile([1.0, 2.0], 3)
    phi = 100.0 * runs + times
    curves = pa.table({"run_id": runs, "time_s": times, "phi_u_arcmin": phi})
    made = plots.group_curves(curves, {"a": [8, 3], "b": [5]})
    assert [e.label for e in made] == ["a", "b"]
    np.testing.assert_array_equal(made[0].time_s, [1.0, 2.0])
    np.testing.assert_array_equal(made[0].columns["phi_u_arcmin"], [[301, 302], [801, 802]])
    np.testing.assert_array_equal(made[1].columns["phi_u_arcmin"], [[501, 502]])


def test_line_is_mean_and_band_covers_95_percent():
    axes = Figure().subplots()
    values = np.random.default_rng(1).normal(size=(200, TIME.size))
    plots.draw_mean_and_band(axes, Line("x", TIME, values, "#000000"))
    np.testing.assert_allclose(axes.get_lines()[0].get_ydata(), values.mean(axis=0))
    (band,) = axes.collections
    edges = band.get_paths()[0].vertices
    for edge in np.quantile(values, [0.025, 0.975], axis=0).T.ravel():
        assert np.isclose(edges[:, 1], edge).any()
    plots.draw_mean_and_band(axes, Line("a single run", TIME, values[:1], "#000000"))
    assert len(axes.collections) == 1


def test_line_skips_records_with_missing_values():
    axes = Figure().subplots()
    values = np.ones((3, TIME.size))
    values[1, 4] = np.nan
    plots.draw_mean_and_band(axes, Line("x", TIME, values, "#000000"))
    np.testing.assert_array_equal(axes.get_lines()[0].get_xdata(), np.delete(TIME, 4))


def test_level_figure_has_panels_resets_and_names_of_lines():
    shown = [make_ensemble("a"), make_ensemble("b", size=900.0)]
    figure = plots.draw_level_errors(shown, "Title", [3.0, 6.0])
    for axes, name in zip(figure.axes, ("east", "north"), strict=True):
        assert axes.get_ylabel() == f"level error,\n{name} (arcmin)"
        assert axes.get_yscale() == "symlog" and axes.get_xlim() == (0.0, 10.0)
        assert sum(line.get_linestyle() == ":" for line in axes.get_lines()) == 2
    said = figure_text(figure).splitlines()
    assert {"Title", "a", "b", "95 % of the runs", "reset", "±1 sigma of the filter"} <= {*said}


def test_sigma_of_level_is_dashed_on_both_sides():
    figure = plots.draw_level_errors([make_ensemble("a", sigma=5.0)], "Title")
    dashed = [line for line in figure.axes[1].get_lines() if line.get_linestyle() == "--"]
    ends = [line.get_ydata()[0] for line in dashed if len(line.get_ydata())]
    assert sorted(ends) == [-5.0, 5.0]


def test_attitude_figure_shows_degrees_and_sigma_band():
    figure = plots.draw_attitude([make_ensemble("a", sigma=60.0), make_ensemble("b")], "Title")
    assert [axes.get_ylabel() for axes in figure.axes] == ["pitch (deg)", "roll (deg)", "yaw (deg)"]
    path = figure.axes[2].collections[0].get_paths()[0]
    middle = make_ensemble("a").columns["yaw_deg"].mean(axis=0)
    assert path.vertices[:, 1].max() == pytest.approx(middle.max() + 1.0)  # 60 arcmin are 1 deg


def test_along_axis_marks_infinite_values_as_never():
    lines = {
        "a": [Estimate(1.0, 0.5, 2.0, 8), Estimate(math.inf, 3.0, math.inf, 8)],
        "b": [Estimate(2.0, math.nan, math.nan, 8), Estimate(3.0, 2.0, math.inf, 8)],
    }
    figure = plots.draw_along_axis(
        "phi_u0_deg", [0.0, 30.0], {"time (s)": lines, "share": lines}, title="Title"
    )
    top, bottom = figure.axes
    assert (top.get_title(loc="left"), bottom.get_xlabel()) == (
        "time (s)",
        "initial heading error (deg)",
    )
    crosses = [line for line in bottom.get_lines() if line.get_marker() == "x"]
    # Beside the other line's marks, so that neither hides the other.
    assert [list(line.get_xdata()) for line in crosses] == [[pytest.approx(30.0, abs=0.15)]]
    assert "never" in figure_text(figure)
    assert plots.render_png(figure)


def test_beliefs_figure_shows_nees_distribution_and_shares():
    nees = np.array([0.5, 2.0, np.nan, 8.0])
    shares = {"a": Estimate(0.7, 0.6, 0.8, 4), "b": Estimate(0.4, math.nan, math.nan, 4)}
    shown = [ConsistencyLine("x", nees, shares), ConsistencyLine("y", 4 * nees, shares)]
    left, right = plots.draw_consistency(shown, "Title").axes
    first, second, chi2, *marks = left.get_lines()
    assert [line.get_label() for line in (first, second)] == ["x", "y"]
    np.testing.assert_array_equal(first.get_ydata(), [0.0, 0.25, 0.5, 0.75])
    expected = stats.chi2.cdf(chi2.get_xdata(), 3)
    np.testing.assert_allclose(chi2.get_ydata(), expected, atol=1e-12)
    assert left.get_xscale() == "log" and "NEES" in left.get_xlabel()
    dashed = [line for line in right.get_lines() if line.get_linestyle() == "--"]
    assert dashed[0].get_xdata()[0] == pytest.approx(stats.chi2.cdf(1.0, 1))
    points = [container.lines[0].get_xdata()[0] for container in right.containers]
    assert points == [0.7, 0.4, 0.7, 0.4]
    assert [mark.get_label() for mark in marks] == ["share a", "share b"]


def test_footer_is_added_as_strip_below_figure():
    figure = plots.draw_level_errors([make_ensemble("a")], "Title")
    plain, signed = (
        imread(io.BytesIO(plots.render_png(figure, text))) for text in ("", "swing: 3 draws")
    )
    np.testing.assert_array_equal(signed[: len(plain)], plain)
    assert (signed[len(plain) :] < 0.5).any()


def test_png_does_not_depend_on_rc_params(monkeypatch):
    def draw():
        return plots.render_png(plots.draw_level_errors([make_ensemble("a")], "Title"))

    first = draw()
    monkeypatch.setitem(mpl.rcParams, "font.size", 30.0)
    monkeypatch.setitem(mpl.rcParams, "savefig.dpi", 30.0)
    assert draw() == first
    assert mpl.rcParams["font.size"] == 30.0

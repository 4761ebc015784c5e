import io
import math

import matplotlib as mpl
import numpy as np
import pyarrow as pa
import pytest
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from scipy import stats

from sinsjax import plots
from sinsjax.analysis import Estimate
from sinsjax.plots import ConsistencyLine, Ensemble, GridAxis, Line, MapQuantity
from sinsjax.plots.comparison import cumulative_distribution_steps

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


def solid_lines(axes):
    """The lines of an axes that a legend names and that are no marks along it."""
    return [line for line in axes.get_lines() if len(line.get_xdata()) > 2]


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
    extent = plots.draw_mean_and_band(axes, Line("x", TIME, values, "#000000"))
    np.testing.assert_allclose(axes.get_lines()[0].get_ydata(), values.mean(axis=0))
    np.testing.assert_allclose(extent.low, np.quantile(values, 0.025, axis=0))
    np.testing.assert_allclose(extent.high, np.quantile(values, 0.975, axis=0))
    assert len(axes.collections) == 1


def test_line_skips_records_with_missing_values():
    axes = Figure().subplots()
    values = np.ones((3, TIME.size))
    values[1, 4] = np.nan
    plots.draw_mean_and_band(axes, Line("x", TIME, values, "#000000"))
    np.testing.assert_array_equal(axes.get_lines()[0].get_xdata(), np.delete(TIME, 4))


def test_single_run_has_no_band():
    axes = Figure().subplots()
    plots.draw_mean_and_band(axes, Line("x", TIME, np.ones((1, TIME.size)), "#000000"))
    assert not axes.collections


def test_misalignment_figure_has_panels_labels_and_legend():
    shown = [make_ensemble("a"), make_ensemble("b", size=900.0)]
    figure = plots.draw_misalignment(
        shown, "Title", floors={"u": -27.0}, resets_s=[3.0, 6.0], zoom_s=(5.0, 10.0)
    )
    whole, enlarged = figure.axes[::2], figure.axes[1::2]
    assert len(whole) == len(enlarged) == 3
    names = ("level error, east", "level error, north", "heading error")
    for axes, name in zip(whole, names, strict=True):
        assert axes.get_ylabel().startswith(name) and "(arcmin)" in axes.get_ylabel()
        assert [line.get_label() for line in solid_lines(axes)] == ["a", "b"]
        assert axes.get_yscale() == "asinh" and axes.get_xlim() == (0.0, 10.0)
        assert sum(line.get_linestyle() == ":" for line in axes.get_lines()) == 2
    assert all(axes.get_yscale() == "linear" for axes in enlarged)
    assert enlarged[0].get_xlim() == (5.0, 10.0)
    low, high = enlarged[0].get_ylim()
    assert low < 0.0 and high > 900.0
    assert [len(axes.get_lines()) for axes in whole] == [4, 4, 5]
    assert figure.get_suptitle() == "Title"
    assert [t.get_text() for t in enlarged[2].texts] == ["a", "b"]  # at the ends of their lines
    assert [t.get_text() for t in figure.legends[0].get_texts()] == [
        "95 % of the runs",
        "bias floor",
        "reset",
    ]


def test_misalignment_sigma_is_dashed_on_both_sides():
    figure = plots.draw_misalignment([make_ensemble("a", sigma=5.0)], "Title", with_sigma=True)
    dashed = [line for line in figure.axes[2].get_lines() if line.get_linestyle() == "--"]
    ends = [line.get_ydata()[0] for line in dashed if len(line.get_ydata())]
    assert sorted(ends) == [-5.0, 5.0]


def test_enlarged_panel_shows_whole_band():
    wide = make_ensemble("a", runs=40)
    figure = plots.draw_misalignment([wide], "Title", zoom_s=(4.0, 10.0))
    inside = wide.columns["phi_u_arcmin"][:, TIME >= 4.0]
    low, high = figure.axes[-1].get_ylim()
    assert low < np.quantile(inside, 0.025, axis=0).min()
    assert high > np.quantile(inside, 0.975, axis=0).max()


def test_attitude_figure_shows_degrees_and_sigma_band():
    figure = plots.draw_attitude([make_ensemble("a", sigma=60.0), make_ensemble("b")], "Title")
    assert [axes.get_ylabel() for axes in figure.axes] == ["pitch (deg)", "roll (deg)", "yaw (deg)"]
    path = figure.axes[2].collections[0].get_paths()[0]
    middle = make_ensemble("a").columns["yaw_deg"].mean(axis=0)
    assert path.vertices[:, 1].max() == pytest.approx(middle.max() + 1.0)  # 60 arcmin are 1 deg


def test_squares_figure_uses_log_axes_in_square_arcmin():
    values = np.full((3, TIME.size), 9.0)
    panels = {"one": [Line("P", TIME, values, "#000000", "--")], "two": []}
    figure = plots.draw_squared_errors(panels, "Title", resets_s=[2.0])
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["one", "two"]
    assert all(axes.get_yscale() == "log" for axes in figure.axes)
    assert "arcmin²" in figure.axes[0].get_ylabel()
    assert plots.render_png(figure)
    assert figure.axes[0].get_lines()[0].get_linestyle() == "--"


def test_heat_maps_show_values_and_hatch_infinite_cells():
    values = np.array([[10.0, 20.0, np.inf], [30.0, np.nan, 40.0]])
    figure = plots.draw_heat_maps(
        [("first", values), ("second", values[:, ::-1])],
        "Title",
        MapQuantity("time (s)", 0.0, 40.0, reverse=True),
        rows=GridAxis("reset_count", [0, 1]),
        columns=GridAxis("reset_cycle_s", [10.0, 20.0, 50.0]),
    )
    first, second, bar = figure.axes
    image = first.get_images()[0].get_array()
    np.testing.assert_array_equal(np.ma.getmaskarray(image), ~np.isfinite(values))
    assert sorted(t.get_text() for t in first.texts) == ["10", "20", "30", "40"]
    assert first.patch.get_hatch()
    assert [t.get_text() for t in first.get_xticklabels()] == ["10", "20", "50"]
    assert (first.get_ylabel(), second.get_xlabel()) == (
        "number of resets",
        "time between resets (s)",
    )
    assert bar.get_ylabel() == "time (s)"
    assert "never" in figure_text(figure)


def test_heat_map_uses_log_colours_and_two_digits_per_cell():
    figure = plots.draw_heat_maps(
        [("a", np.array([[0.123, 4.56], [78.9, 1234.0], [0.0, np.inf]]))],
        "Title",
        MapQuantity("error (arcmin)", 0.1, 100.0, reverse=True, log=True),
        rows=GridAxis("azimuth_sigma_per_s", [0.01, 0.02, 0.04]),
        columns=GridAxis("stored_s", [20.0, 40.0]),
    )
    axes = figure.axes[0]
    assert [t.get_text() for t in axes.texts] == ["0.12", "4.6", "79", "1234", "0"]
    norm = axes.get_images()[0].norm
    assert isinstance(norm, LogNorm)
    assert norm(math.sqrt(0.1 * 100.0)) == pytest.approx(0.5)
    assert [t.get_color() for t in axes.texts][:4] == ["black", "white", "white", "white"]
    assert axes.get_ylabel() == "sigma of the azimuth loop (1/s)"
    assert plots.render_png(figure)


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


def test_steps_thin_many_values_without_changing_shape():
    values = np.random.default_rng(3).normal(size=100_000)
    values[:20_000] = np.nan
    x, share = cumulative_distribution_steps(values)
    assert x.size <= 1000
    assert (share[0], share[-1]) == (0.0, 0.8) and x[-1] == np.nanmax(values)
    known = np.sort(values[20_000:])
    np.testing.assert_allclose(np.searchsorted(known, x[1:], side="right") / 100_000, share[1:])


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


def read_png(content):
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(content)))


def test_footer_is_added_as_strip_below_figure():
    figure = plots.draw_misalignment([make_ensemble("a")], "Title")
    plain, signed = (read_png(plots.render_png(figure, text)) for text in ("", "swing: 3 draws"))
    height = plain.shape[0]
    assert signed.shape[0] > height and signed.shape[1] == plain.shape[1]
    np.testing.assert_array_equal(signed[:height], plain)
    strip = signed[height:]
    assert (strip < 128).any() and (strip[:2] == 255).all()
    other = read_png(plots.render_png(figure, "swing: 4 draws"))
    assert (other[height:] != strip).any()


def test_png_does_not_depend_on_rc_params(monkeypatch):
    def draw():
        return plots.render_png(plots.draw_misalignment([make_ensemble("a")], "Title"))

    first = draw()
    monkeypatch.setitem(mpl.rcParams, "font.size", 30.0)
    monkeypatch.setitem(mpl.rcParams, "savefig.dpi", 30.0)
    assert draw() == first
    assert mpl.rcParams["font.size"] == 30.0
    from PIL import Image

    assert set(Image.open(io.BytesIO(first)).info) == {"dpi"}

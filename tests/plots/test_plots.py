"""The plots: tables in, figures out."""

from itertools import product

import matplotlib as mpl
import numpy as np
import pyarrow as pa
import pytest
from scipy import stats

import sinsjax
from sinsjax import plots
from sinsjax.analysis.labels import axis_label
from sinsjax.errors import InputError
from sinsjax.plots.consistency import SHARE_COLUMNS

POINTS = [*product((0, 1, 2), (0.0, 30.0), (10.0, 50.0))]
"""Numbers of resets, starts and cycles."""
TIMES_S = [300, 300, None, None, 100, 200, 400, 400, 150, 180, 210, 200]
"""At which they settle; None never settles."""
MAP = ("reset_count", "reset_cycle_s")


def run_table():
    """A summary: every point in three draws, a second apart, two of them in no order."""
    count, start, cycle = map(np.array, zip(*POINTS * 3, strict=True))
    draw = np.repeat(range(3), len(POINTS))
    times = [None if t is None else t + d - 1.0 for t, d in zip(TIMES_S * 3, draw, strict=True)]
    return pa.table(
        {
            "reset_count": count,
            "reset_cycle_s": cycle,
            "phi_u0_deg": start,
            "draw_id": draw,
            "settle_10_s": pa.array(times, pa.float64()),
            "phi_u_arcmin": 10.0 * count + np.where(count, cycle, 0.0) + start + draw,
            "ok_floor": [t is not None for t in times],
            "status": ["not_settled" if t is None else "ok" for t in times],
        }
    ).take([*range(12), *np.random.default_rng(0).permutation(np.arange(12, 36))])


def map_panels(figure):
    return [axes for axes in figure.axes if axes.get_images()]


def shown(axes):
    return axes.get_images()[0].get_array()


def framed_cells(axes):
    return {frame.get_xy() for frame in axes.patches}


def test_map_frames_the_best_cell_in_every_panel_that_it_is_in():
    best = {"reset_count": 2, "reset_cycle_s": 10.0}
    figure = sinsjax.plot_map(run_table(), *MAP, "settle_10_s", by="phi_u0_deg", best=best)
    first, second = map_panels(figure)
    np.testing.assert_array_equal(shown(first), [[300, 300], [100, 200], [150, 180]])
    assert [tick.get_text() for tick in first.get_yticklabels()] == ["0", "1", "2"]
    assert second.get_xlabel() == axis_label("reset_cycle_s")
    assert np.ma.getmaskarray(shown(second))[0].all()  # never
    titles = [panel.get_title(loc="left").replace("\n", " ") for panel in (first, second)]
    assert titles == [f"initial heading error {start} deg" for start in (0, 30)]
    assert framed_cells(first) == framed_cells(second) == {(-0.5, 1.5)}
    best["phi_u0_deg"] = 30.0
    figure = sinsjax.plot_map(run_table(), *MAP, "settle_10_s", by="phi_u0_deg", best=best)
    assert list(map(framed_cells, map_panels(figure))) == [set(), {(-0.5, 1.5)}]


def test_map_of_flag_is_share_in_percent_and_of_number_its_rms():
    table = run_table()
    (panel,) = map_panels(sinsjax.plot_map(table, *MAP, "ok_floor"))
    np.testing.assert_allclose(shown(panel), [[50, 50], [100, 100], [100, 100]])
    figure = sinsjax.plot_map(table, *MAP, "phi_u_arcmin")
    phi = table["phi_u_arcmin"].to_numpy()[table["reset_count"].to_numpy() == 0]
    np.testing.assert_allclose(shown(figure.axes[0])[0], np.sqrt(np.mean(phi**2)))
    assert "(arcmin)" in figure.axes[-1].get_ylabel()


@pytest.mark.parametrize(
    ("table", "value", "line"),
    [
        (run_table().slice(0, 5), "settle_10_s", "no full grid of these keys"),
        (run_table().slice(0, 0), "settle_10_s", "there are no runs"),
        (run_table(), "settle_3_s", "column settle_3_s is missing"),
        (run_table(), "status", "column status has no numbers"),
        ([1, 2], "settle_10_s", "list: is not a table"),
    ],
)
def test_map_of_unusable_runs_is_refused(table, value, line):
    with pytest.raises(InputError, match=line):
        sinsjax.plot_map(table, *MAP, value)


def test_infinite_values_are_marked_as_never_clear_of_the_other_line():
    table, statistics = run_table(), {"settle_10_s_median": "time (s)"}
    figure = sinsjax.plot_compare(table, "phi_u0_deg", by="reset_count", statistics=statistics)
    crosses = [line for line in figure.axes[0].get_lines() if line.get_marker() == "x"]
    places = [list(line.get_xdata()) for line in crosses if len(line.get_xdata())]
    assert places == [[pytest.approx(30.0, abs=0.5)]] and places[0][0] != 30.0
    assert "never (median)" in {text.get_text() for text in figure.legends[0].get_texts()}


def test_belief_shows_nees_against_chi_square_and_shares_of_records():
    shares = dict(zip(SHARE_COLUMNS.values(), ([0.7] * 8, [0.4] * 8), strict=True))
    nees = np.array([0.5, 2.0, np.nan, 8.0])
    columns = {"nees": [*nees, *(4 * nees)], "method": ["x"] * 4 + ["y"] * 4}
    left, right = sinsjax.plot_belief(pa.table(columns | shares), by="method").axes
    first, second, chi2, *marks = left.get_lines()
    assert [line.get_label() for line in (first, second)] == ["method x", "method y"]
    np.testing.assert_array_equal(first.get_ydata(), [0.0, 0.25, 0.5, 0.75])
    expected = stats.chi2.cdf(chi2.get_xdata(), 3)
    np.testing.assert_allclose(chi2.get_ydata(), expected, atol=1e-12)
    dashed = [line for line in right.get_lines() if line.get_linestyle() == "--"]
    assert dashed[0].get_xdata()[0] == pytest.approx(stats.chi2.cdf(1.0, 1))
    points = [bar.lines[0].get_xdata()[0] for bar in right.containers]
    assert points == pytest.approx([0.7, 0.4, 0.7, 0.4])
    assert [mark.get_label() for mark in marks] == ["share from truth", "share from the bias floor"]


def test_belief_leaves_out_lines_without_covariance_and_refuses_none():
    columns = {name: [0.5] * 4 for name in SHARE_COLUMNS.values()}
    table = pa.table(columns | {"method": ["a", "a", "b", "b"], "nees": [1.0, 2.0, None, None]})
    figure = sinsjax.plot_belief(table, by="method")
    assert [text.get_text() for text in figure.axes[1].texts] == ["method a"]
    with pytest.raises(InputError, match="no run has a finite nees"):
        sinsjax.plot_belief(table.slice(2), by="method")


def curve_table(ids, *, truth=True, without_heading=()):
    """Curves of some runs; sigmas and errors are 100 times the number of the run plus time."""
    time = np.tile([1.0, 2.0, 3.0], len(ids))
    run = np.repeat(ids, 3)
    unknown = np.isin(run, without_heading)
    columns = {"run_id": run, "time_s": time}
    for axis in "enu":
        values = np.where(unknown & (axis == "u"), np.nan, 100.0 * run + time)
        columns[f"phi_{axis}_arcmin"] = values if truth else np.full(time.size, np.nan)
        columns[f"sigma_{axis}_arcmin"] = values
    columns |= {f"{angle}_deg": time for angle in ("pitch", "roll")}
    return pa.table(columns | {"yaw_deg": np.where(unknown, np.nan, time)})


def test_curves_are_grouped_by_keys_with_resets_and_floor_of_their_runs():
    columns = {"case": [*"xyxy"], "reset_times_s": [[1.0], [], [1.0], []]}
    columns |= {"run_id": [0, 1, 2, 3], "floor_arcmin": [-20.0, None, 40.0, None]}
    figure = sinsjax.plot_curves(curve_table([0, 1, 2, 3]), pa.table(columns), by="case")
    first, second = figure.axes
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["x", "y"]
    error, sigma, reset, floor = first.get_lines()
    runs_0_and_2 = np.array([[1.0, 2.0, 3.0], [201.0, 202.0, 203.0]])
    rms = np.sqrt((runs_0_and_2**2).mean(axis=0))
    np.testing.assert_allclose(error.get_ydata(), rms)
    np.testing.assert_allclose(sigma.get_ydata(), rms)
    assert (error.get_linestyle(), sigma.get_linestyle()) == ("-", "--")
    assert reset.get_xdata()[0] == 1.0
    assert floor.get_ydata()[0] == pytest.approx(np.sqrt((20.0**2 + 40.0**2) / 2))
    assert len(second.get_lines()) == 2  # neither resets nor a floor
    with pytest.raises(InputError, match="no curves of these runs"):
        sinsjax.plot_curves(curve_table([0]), pa.table({"run_id": [5]}))


def test_curves_without_truth_show_attitude_and_sigma_in_degrees():
    figure = sinsjax.plot_curves(curve_table([1], truth=False))
    assert [axes.get_ylabel() for axes in figure.axes] == ["pitch (deg)", "roll (deg)", "yaw (deg)"]
    ends = [line.get_ydata()[-1] for line in figure.axes[2].get_lines() if len(line.get_ydata())]
    assert ends == pytest.approx([3.0, 3.0 + 103 / 60, 3.0 - 103 / 60])


@pytest.mark.parametrize(("truth", "panels"), [(True, 4), (False, 2)])
def test_figure_without_any_heading_shows_level_errors_or_pitch_and_roll(truth, panels):
    figure = sinsjax.plot_curves(curve_table([0, 1], truth=truth, without_heading=[0, 1]))
    assert len(figure.axes) == panels
    assert figure.get_suptitle() == ("Level error" if truth else "Attitude")


def test_png_does_not_depend_on_rc_params(monkeypatch):
    def draw():
        return plots.render_png(sinsjax.plot_curves(curve_table([0])))

    first = draw()
    monkeypatch.setitem(mpl.rcParams, "font.size", 30.0)
    monkeypatch.setitem(mpl.rcParams, "savefig.dpi", 30.0)
    assert draw() == first
    assert mpl.rcParams["font.size"] == 30.0

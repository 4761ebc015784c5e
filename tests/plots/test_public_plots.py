"""The plot functions of the package's own namespace: tables in, figures out."""

import numpy as np
import pyarrow as pa
import pytest
from matplotlib.figure import Figure
from scipy import stats

import sinsjax
from sinsjax import analysis, plots
from sinsjax.errors import InputError
from sinsjax.plots.comparison import has_significant_effect
from sinsjax.plots.consistency import SHARE_COLUMNS

COUNTS, CYCLES, STARTS = (0, 1, 2), (10.0, 50.0), (0.0, 30.0)
SETTLE = {  # s, by number of resets, cycle and start; None never settles
    (0, 10.0, 0.0): 300.0,
    (0, 50.0, 0.0): 300.0,
    (0, 10.0, 30.0): None,
    (0, 50.0, 30.0): None,
    (1, 10.0, 0.0): 100.0,
    (1, 50.0, 0.0): 200.0,
    (1, 10.0, 30.0): 400.0,
    (1, 50.0, 30.0): 400.0,
    (2, 10.0, 0.0): 150.0,
    (2, 50.0, 0.0): 180.0,
    (2, 10.0, 30.0): 210.0,
    (2, 50.0, 30.0): 200.0,
}
MAP = ("reset_count", "reset_cycle_s")


def run_table(settle=SETTLE, draws=3, **more):
    """A summary: every point of `SETTLE` in some draws, a second apart."""
    points = [(*point, draw) for draw in range(draws) for point in settle]
    count, cycle, start, draw = zip(*points, strict=True)
    times = [settle[point[:3]] for point in points]
    times = [None if t is None else t + d - 1 for t, d in zip(times, draw, strict=True)]
    points = zip(count, cycle, start, draw, strict=True)
    phi = [10.0 * n + (cycle if n else 0) + u + d for n, cycle, u, d in points]  # acts if n > 0
    columns = {
        "reset_times_s": [
            [b * i for i in range(1, n + 1)] for n, b in zip(count, cycle, strict=True)
        ],
        "reset_count": count,
        "reset_cycle_s": cycle,
        "phi_u0_deg": start,
        "draw_id": draw,
        "settle_10_s": pa.array(times, pa.float64()),
        "phi_u_arcmin": phi,
        "ok_floor": [t is not None for t in times],
        "status": ["not_settled" if t is None else "ok" for t in times],
    }
    return pa.table(columns | more)


def panel_titles(figure: Figure):
    return [axes for axes in figure.axes if axes.get_images()]


# --- plot_map -----------------------------------------------------------------------------------


def framed_cells(axes):
    """The corners of the frames of a panel."""
    return {frame.get_xy() for frame in axes.patches}


def test_map_frames_cell_that_title_names():
    figure = sinsjax.plot_map(run_table(), *MAP, "settle_10_s", by="phi_u0_deg")
    assert figure.get_suptitle() == "Soonest: 2 resets, every 10 s (180 s on average)"
    first, second = panel_titles(figure)
    np.testing.assert_array_equal(
        first.get_images()[0].get_array(), [[300, 300], [100, 200], [150, 180]]
    )
    assert np.ma.getmaskarray(second.get_images()[0].get_array())[0].all()  # never
    assert (
        first.get_title(loc="left").endswith("0 deg") and second.get_title(loc="left") == "30 deg"
    )
    assert framed_cells(first) == framed_cells(second) == {(-0.5, 1.5)}  # 2 resets, every 10 s


def test_map_title_names_best_choice_where_panels_are_choices():
    table = run_table()
    table = table.append_column("method", table["phi_u0_deg"].cast(pa.string()))
    figure = sinsjax.plot_map(table, *MAP, "settle_10_s", by=["method"], pooled=[])
    title = "Soonest: 1 reset at 10 s, method 0 (100 s on average)"
    assert figure.get_suptitle().replace("\n", " ") == title
    assert list(map(framed_cells, panel_titles(figure))) == [{(-0.5, 0.5)}, set()]


def test_map_of_flag_is_share_in_percent_and_of_number_its_rms():
    figure = sinsjax.plot_map(run_table(), *MAP, "ok_floor")
    np.testing.assert_allclose(
        panel_titles(figure)[0].get_images()[0].get_array(), [[50, 50], [100, 100], [100, 100]]
    )
    table = run_table()
    figure = sinsjax.plot_map(table, *MAP, "phi_u_arcmin")
    phi = table["phi_u_arcmin"].to_numpy()[table["reset_count"].to_numpy() == 0]
    shown = panel_titles(figure)[0].get_images()[0].get_array()
    np.testing.assert_allclose(shown[0], np.sqrt(np.mean(phi**2)))
    assert "(arcmin)" in figure.axes[-1].get_ylabel()


def test_map_does_not_depend_on_order_of_rows():
    table = run_table()
    order = np.random.default_rng(0).permutation(table.num_rows)
    order = order[np.lexsort((table["reset_cycle_s"].to_numpy()[order],))]
    mixed = table.take(order)
    counts = list(dict.fromkeys(mixed["reset_count"].to_pylist()))
    one, other = (
        panel_titles(sinsjax.plot_map(rows, *MAP, "settle_10_s"))[0].get_images()[0].get_array()
        for rows in (table, mixed)
    )
    np.testing.assert_array_equal(other, one[counts])


@pytest.mark.parametrize(
    ("table", "line"),
    [
        (run_table().slice(0, 5), "no full grid of these keys"),
        (run_table().slice(0, 0), "there are no runs"),
        (run_table().drop_columns(["settle_10_s"]), "column settle_10_s is missing"),
        ([1, 2], "list: is not a table"),
    ],
)
def test_map_of_unusable_runs_is_refused(table, line):
    with pytest.raises(InputError, match=line):
        sinsjax.plot_map(table, *MAP, "settle_10_s")


def test_pandas_frames_are_accepted():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(run_table().to_pydict())
    figure = sinsjax.plot_map(frame, *MAP, "settle_10_s", by="phi_u0_deg")
    same = sinsjax.plot_map(run_table(), *MAP, "settle_10_s", by="phi_u0_deg")
    assert plots.render_png(figure) == plots.render_png(same)


# --- plot_compare -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ends", "expected"),
    [
        ([(10.0, 9.0, 11.0), (14.5, 13.5, 15.5)], True),
        ([(10.0, 9.0, 11.0), (13.5, 12.5, 14.5)], False),  # bars of twice the length overlap
        ([(10.0, 9.0, 11.0), (np.inf, 12.0, np.inf)], True),
        ([(np.nan, np.nan, np.nan), (10.0, 9.0, 11.0)], False),
        ([(np.inf, np.nan, np.nan)] * 2, False),
    ],
)
def test_key_acts_if_values_lie_far_outside_each_others_intervals(ends, expected):
    line = [analysis.Estimate(*numbers, 9) for numbers in ends]
    assert has_significant_effect({"x": {"a": line}}) == expected


def test_compare_states_best_value_of_choice_and_best_line_over_conditions():
    table = run_table({point: time for point, time in SETTLE.items() if point[0]})
    choice = sinsjax.plot_compare(table, "reset_count", by=["reset_cycle_s", "phi_u0_deg"])
    assert "1, time between resets 10 s" in choice.get_suptitle().replace("\n", " ")
    assert "100 s" in choice.get_suptitle()
    over = sinsjax.plot_compare(table, "phi_u0_deg", by=MAP, condition=True)
    said = over.get_suptitle().replace("\n", " ")
    assert "number of resets 2, time between resets 10 s" in said and "180 s on average" in said


# --- plot_belief and plot_curves ----------------------------------------------------------------


def test_belief_leaves_out_lines_without_covariance_and_refuses_none():
    columns = {name: [0.5] * 4 for name in SHARE_COLUMNS.values()}
    table = pa.table(columns | {"method": ["a", "a", "b", "b"], "nees": [1.0, 2.0, None, None]})
    figure = sinsjax.plot_belief(table, by="method")
    assert [text.get_text() for text in figure.axes[1].texts] == ["method a"]
    with pytest.raises(InputError, match="no run has a finite nees"):
        sinsjax.plot_belief(table.slice(2), by="method")


def test_belief_from_bias_floor_shows_heading_against_one_degree_of_freedom():
    columns = {"nees": [900.0] * 4, "nis_u": [0.2, 0.4, 1.4, 2.0]}
    shares = dict(zip(SHARE_COLUMNS.values(), ([0.0] * 4, [0.7] * 4), strict=True))
    figure = sinsjax.plot_belief(pa.table(columns | shares), from_floor=True)
    left, right = figure.axes
    title = "Mean NEES of the heading, from the bias floor: 1, where a consistent filter has 1"
    assert figure.get_suptitle().replace("\n", " ") == title
    course, expected = left.get_lines()[:2]
    assert max(course.get_xdata()) == 2.0
    x, share = expected.get_xdata(), expected.get_ydata()
    np.testing.assert_allclose(share, stats.chi2(1).cdf(x), atol=1e-12)
    assert left.get_xlabel() == "NEES of the heading at the end, from the bias floor"
    assert [bar.lines[0].get_xdata()[0] for bar in right.containers] == [pytest.approx(0.7)]
    assert (
        sinsjax.plot_belief(pa.table(columns | shares)).get_suptitle().startswith("Mean NEES 900")
    )


def curve_table(ids, *, truth=True):
    time = np.tile([1.0, 2.0, 3.0], len(ids))
    run = np.repeat(ids, 3)
    names = [f"{kind}_{axis}_arcmin" for kind in ("phi", "sigma") for axis in "enu"]
    values = {name: 100.0 * run + time for name in names}
    if not truth:
        values |= {f"phi_{axis}_arcmin": np.full(time.size, np.nan) for axis in "enu"}
    values |= {f"{angle}_deg": time for angle in ("pitch", "roll", "yaw")}
    return pa.table({"run_id": run, "time_s": time} | values)


def test_curves_are_grouped_by_keys_with_resets_and_floor_of_their_runs():
    summary = pa.table(
        {
            "run_id": [0, 1, 2, 3],
            "case": ["x", "y", "x", "y"],
            "reset_times_s": [[1.0], [], [1.0], []],
            "floor_arcmin": [-20.0, None, 40.0, None],
        }
    )
    figure = sinsjax.plot_curves(curve_table([0, 1, 2, 3]), summary, by="case")
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
    assert figure.get_suptitle().startswith("Heading error after 3 s: ")


def test_curves_without_truth_show_attitude():
    figure = sinsjax.plot_curves(curve_table([0], truth=False))
    assert [axes.get_ylabel() for axes in figure.axes] == ["pitch (deg)", "roll (deg)", "yaw (deg)"]


def without_heading(table, run_ids):
    """The curves of a table with nulls for the heading of some runs."""
    for name in ("phi_u_arcmin", "sigma_u_arcmin", "yaw_deg"):
        known = np.isin(table["run_id"].to_numpy(), run_ids, invert=True)
        values = np.where(known, table[name].to_numpy(), np.nan)
        table = table.set_column(table.column_names.index(name), name, pa.array(values))
    return table


def test_lines_without_heading_have_no_panel():
    figure = sinsjax.plot_curves(without_heading(curve_table([0, 1]), [1]))
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["run id 0"]
    assert figure.axes[0].get_xlim() == (0, 3)
    assert figure.get_suptitle() == "Heading error after 3 s: 3 arcmin"


@pytest.mark.parametrize(("truth", "title"), [(True, "Level errors"), (False, "Pitch and roll")])
def test_figure_without_any_heading_has_two_panels(truth, title):
    figure = sinsjax.plot_curves(without_heading(curve_table([0, 1], truth=truth), [0, 1]))
    assert len(figure.axes) == 2 and figure.get_suptitle().startswith(title)


def test_curves_of_other_runs_are_refused():
    with pytest.raises(InputError, match="no curves of these runs"):
        sinsjax.plot_curves(curve_table([0]), pa.table({"run_id": [5]}))

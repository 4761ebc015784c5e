"""The plot functions of the package's own namespace: tables in, figures out."""

import numpy as np
import pyarrow as pa
import pytest
from matplotlib.figure import Figure

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


def test_plot_functions_are_public_names():
    names = {"plot_belief", "plot_compare", "plot_curves", "plot_map"}
    assert names <= {*sinsjax.__all__}
    assert all(getattr(sinsjax, name) is getattr(plots, name) for name in names)


# --- plot_map -----------------------------------------------------------------------------------


def test_map_states_best_cell_over_all_panels_and_frames_best_of_each():
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
    corners = [axes.patches[-1].get_xy() for axes in (first, second)]
    assert corners == [(-0.5, 0.5), (0.5, 1.5)]  # 1 reset at 10 s, 2 resets 50 s apart
    assert [t.get_text() for t in first.texts].count("300") == 1  # the same runs, one number


def test_map_title_names_best_choice_where_panels_are_choices():
    table = run_table()
    table = table.append_column("method", table["phi_u0_deg"].cast(pa.string()))
    figure = sinsjax.plot_map(table, *MAP, "settle_10_s", by=["method"], pooled=[])
    title = "Soonest: 1 reset at 10 s, method 0 (100 s on average)"
    assert figure.get_suptitle().replace("\n", " ") == title


def test_map_of_schedule_that_fails_sometimes_states_share():
    settle = {point: None if point[2] else time for point, time in SETTLE.items()}
    figure = sinsjax.plot_map(run_table(settle), *MAP, "settle_10_s", by="phi_u0_deg")
    assert figure.get_suptitle() == "Most often: 1 reset at 10 s (50 % of the runs settle)"


def test_outlier_ends_beyond_colour_scale():
    values = np.append(np.linspace(100.0, 130.0, 29), 5000.0)
    table = pa.table(
        {"a": np.repeat(range(5), 6), "b": np.tile(range(6), 5), "settle_10_s": values}
    )
    figure = sinsjax.plot_map(table, "a", "b", "settle_10_s")
    image = panel_titles(figure)[0].get_images()[0]
    assert image.norm.vmax < 140 and "and more" in figure.axes[-1].get_ylabel()
    even = table.set_column(2, "settle_10_s", pa.array(np.linspace(100.0, 130.0, 30)))
    figure = sinsjax.plot_map(even, "a", "b", "settle_10_s")
    assert panel_titles(figure)[0].get_images()[0].norm.vmax == 130.0
    assert "and more" not in figure.axes[-1].get_ylabel()


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


def test_compare_leaves_out_panels_that_show_nothing_more():
    table = run_table({point: time for point, time in SETTLE.items() if point[0]})
    table = table.append_column("settle_10_truth_s", table["settle_10_s"])
    figure = sinsjax.plot_compare(table, "phi_u0_deg", by=MAP)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == [
        "median time (s) to within 10' of the bias floor",  # and not the same from the truth
        "heading error at the end, rms (arcmin)",  # and no share, 100 % everywhere
    ]


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


def test_compare_of_one_line_states_range():
    table = run_table({point: time for point, time in SETTLE.items() if point[:2] == (0, 10.0)})
    figure = sinsjax.plot_compare(table, "phi_u0_deg", condition=True)
    assert figure.get_suptitle() == "Median time: 300 to 300 s, never at 1 of 2 values"


def test_compare_names_lines_at_their_ends_if_there_is_room():
    rows = {"a": [0.0, 1.0] * 2, "line": ["low"] * 2 + ["high"] * 2, "status": ["ok"] * 4}
    table = pa.table(rows | {"phi_u_arcmin": [1.0, 2.0, 1.0, 9.0]})
    figure = sinsjax.plot_compare(table, "a", by="line")
    assert [text.get_text() for text in figure.axes[0].texts] == ["line low", "line high"]
    assert not figure.legends
    near = pa.table(rows | {"phi_u_arcmin": [1.0, 9.0, 1.0, 9.01]})
    figure = sinsjax.plot_compare(near, "a", by="line")
    assert not figure.axes[0].texts
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["line low", "line high"]


# --- plot_belief and plot_curves ----------------------------------------------------------------


def test_belief_leaves_out_lines_without_covariance_and_refuses_none():
    columns = {name: [0.5] * 4 for name in SHARE_COLUMNS.values()}
    table = pa.table(columns | {"method": ["a", "a", "b", "b"], "nees": [1.0, 2.0, None, None]})
    figure = sinsjax.plot_belief(table, by="method")
    assert [text.get_text() for text in figure.axes[1].texts] == ["method a"]
    with pytest.raises(InputError, match="no run has a finite nees"):
        sinsjax.plot_belief(table.slice(2), by="method")


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
            "floor_arcmin": [-20.0] * 4,
        }
    )
    figure = sinsjax.plot_curves(curve_table([0, 1, 2, 3]), summary, by="case")
    heading = figure.axes[2]
    labels = [line.get_label() for line in heading.get_lines()]
    assert labels.count("x") == labels.count("y") == 1 and {"reset", "bias floor"} <= {*labels}
    first = next(line for line in heading.get_lines() if line.get_label() == "x")
    np.testing.assert_array_equal(first.get_ydata(), [101.0, 102.0, 103.0])  # of runs 0 and 2
    assert figure.get_suptitle().startswith("Heading error after 3 s: ")


def test_curves_without_summary_are_a_line_each():
    figure = sinsjax.plot_curves(curve_table([4, 7]))
    labels = [line.get_label() for line in figure.axes[2].get_lines()]
    assert [label for label in labels if label.startswith("run")] == ["run id 4", "run id 7"]


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


def test_panel_of_heading_has_only_the_lines_that_have_one():
    figure = sinsjax.plot_curves(without_heading(curve_table([0, 1]), [1]))
    lines = [
        {line.get_label() for line in axes.get_lines() if line.get_xdata().size}
        for axes in figure.axes
    ]
    assert [{"run id 0", "run id 1"} <= found for found in lines] == [True, True, False]
    assert figure.axes[0].get_xlim() == figure.axes[2].get_xlim() == (0, 3)
    assert figure.get_suptitle() == "Heading error after 3 s: 3 arcmin"


@pytest.mark.parametrize(("truth", "title"), [(True, "Misalignment"), (False, "Pitch and roll")])
def test_figure_without_any_heading_has_two_panels(truth, title):
    figure = sinsjax.plot_curves(without_heading(curve_table([0, 1], truth=truth), [0, 1]))
    assert len(figure.axes) == 2 and figure.get_suptitle().startswith(title)


def test_spike_of_sigma_at_reset_does_not_flatten_attitude():
    table = curve_table([0], truth=False)
    time = np.arange(1.0, 101.0)
    values = {name: np.ones(100) for name in table.column_names}
    values |= {"run_id": np.zeros(100, int), "time_s": time}
    values |= {f"phi_{axis}_arcmin": np.full(100, np.nan) for axis in "enu"}
    values |= {"sigma_e_arcmin": np.where(time == 50, 6000.0, 6.0)}
    figure = sinsjax.plot_curves(pa.table(values))
    low, high = figure.axes[0].get_ylim()
    assert low < 0.9 and 1.1 < high < 1.5  # 1 deg with a sigma of 0.1 deg, once of 100 deg
    assert figure.get_suptitle() == "Yaw after 100 s: 1.00 deg"


def test_curves_of_other_runs_are_refused():
    with pytest.raises(InputError, match="no curves of these runs"):
        sinsjax.plot_curves(curve_table([0]), pa.table({"run_id": [5]}))

"""Groups and tables of statistics of the runs of a summary."""

import math

import numpy as np
import pyarrow as pa
import pytest

from sinsjax import analysis
from sinsjax.errors import InputError

NEVER = math.inf


def summary_table(n=12, **columns):
    base = {
        "draw_id": np.arange(n),
        "status": ["ok"] * n,
        "phi_u_arcmin": np.full(n, -27.0),
        "phi_u_mean_arcmin": np.linspace(-28.0, -26.0, n),
        "phi_u_std_arcmin": np.linspace(0.1, 0.4, n),
        "floor_arcmin": np.full(n, -27.0),
        "settle_10_s": np.linspace(50.0, 160.0, n),
        "nees": np.linspace(1.0, 5.0, n),
        "nis_u": np.linspace(0.2, 2.0, n),
    }
    return pa.table(base | columns)


def with_times(table, times):
    column = pa.array([times] * table.num_rows, pa.list_(pa.float64()))
    return table.append_column("reset_times_s", column)


def ends(row, name):
    """A statistic with its interval in a row of a wide table; NaN for null."""
    numbers = (row[f"{name}{end}"] for end in ("", "_low", "_high"))
    return [math.nan if number is None else number for number in numbers]


def same(found, estimate):
    np.testing.assert_allclose(found, estimate[:3], rtol=1e-12)


@pytest.mark.parametrize("dictionary", [False, True])
@pytest.mark.parametrize("by", [["case", "reset_times_s"], []])
def test_groups_match_naive_loop(by, dictionary):
    label = pa.array(["b", "a", None, "b", "a", "b"])
    times = pa.array([[50.0], [], [50.0], [50.0], None, [50.0, 100.0]])
    columns = {"case": label.dictionary_encode() if dictionary else label, "reset_times_s": times}
    whole = pa.table(columns | {"row": np.arange(6)})
    # Two chunks, as a dataset of several parts gives them.
    table = pa.concat_tables([whole.slice(0, 4), whole.slice(4)])
    keys = [{name: row[name] for name in by} for row in table.to_pylist()]
    first = [key for i, key in enumerate(keys) if key not in keys[:i]]
    expected = [(key, [i for i in range(6) if keys[i] == key]) for key in first]
    found = [(key, rows["row"].to_pylist()) for key, rows in analysis.group_rows(table, by)]
    assert found == expected and not list(analysis.group_rows(table.slice(0, 0), by))


@pytest.mark.parametrize(
    ("draws", "column", "message"),
    [([0, 0, 1], "x", "repeats"), ([0, 1, 3], "x", "differ"), ([0, 1, 2], "y", "column y")],
)
def test_runs_are_paired_by_draw(draws, column, message):
    a = pa.table({"draw_id": [2, 0, 1], "x": [20, 0, None]})
    b = pa.table({"draw_id": [0, 1, 2], "x": [0.5, 1.5, 2.5]})
    first, second = analysis.pair_by_draw(a, b, "x")
    np.testing.assert_array_equal(first, [0.0, math.nan, 20.0])
    np.testing.assert_array_equal(second, [0.5, 1.5, 2.5])
    with pytest.raises(InputError, match=message):
        analysis.pair_by_draw(a, pa.table({"draw_id": draws, "x": [1, 2, 3]}), column)


def test_summarise_returns_one_row_per_group():
    status = ["ok"] * 6 + ["diverged"] * 3 + ["not_settled"] * 2 + ["nonfinite"]
    settle = [50.0, 60.0, 70.0, 80.0, 90.0, 100.0] + [None] * 6
    yaw = [-27.5, -26.5] * 5 + [-27.0, math.nan]
    one = summary_table(status=status, settle_10_s=settle, phi_u_mean_arcmin=yaw)
    parts = [with_times(one, [50.0, 100.0]), with_times(summary_table(), [])]
    table = analysis.summarise(pa.concat_tables(parts), ["reset_times_s"])
    assert table.column_names[:4] == ["reset_times_s", "n", "nonfinite", "no_floor"]
    first, second = table.to_pylist()
    assert first["reset_times_s"] == [50.0, 100.0] and second["reset_times_s"] == []
    assert (first["n"], first["nonfinite"], second["nonfinite"]) == (12, 1, 0)
    finite, never = np.array(yaw[:-1]), [*settle[:6], *[NEVER] * 6]
    for name, estimate in {
        "success_rate": analysis.share(np.arange(12) < 6),
        "diverged_rate": analysis.share(np.arange(12) < 3),
        "settle_10_s_median": analysis.quantile(never),
        "settle_10_s_q90": analysis.quantile(never, 0.9),
        "settle_10_s_mean": analysis.mean(settle[:6]),
        "phi_u_mean_arcmin_mean": analysis.mean(finite),
        "phi_u_mean_arcmin_q10": analysis.quantile(finite, 0.1),
        "phi_u_mean_arcmin_median": analysis.quantile(finite),
        "phi_u_from_floor_arcmin_mean": analysis.mean(finite + 27.0),
        "phi_u_std_arcmin_mean": analysis.mean(np.linspace(0.1, 0.4, 12)),
        "nees_median": analysis.quantile(np.linspace(1, 5, 12)),
        "nees_mean": analysis.mean(np.linspace(1, 5, 12)),
        "nis_u_mean": analysis.mean(np.linspace(0.2, 2, 12)),
    }.items():
        same(ends(first, name), estimate)
    assert (first["never_settled_10"], second["never_settled_10"]) == (6, 0)
    assert (first["settle_10_s_mean_n"], first["phi_u_mean_arcmin_mean_n"]) == (6, 11)


def test_heading_errors_are_magnitudes_of_all_finite_runs_capped_at_180_deg():
    """Pooled variants of a draw count once, headings do not cancel."""
    draw, error = np.repeat(np.arange(40), 2), 60.0 * np.random.default_rng(3).normal(size=80)
    early = np.where(np.arange(80) == 7, math.nan, 10 * error)
    table = summary_table(80, draw_id=draw, phi_u_arcmin=error, phi_u_at_60_arcmin=early)
    (row,) = analysis.summarise(table, []).to_pylist()
    for name, values in {"phi_u_arcmin": error, "phi_u_at_60_arcmin": early}.items():
        same(ends(row, f"{name}_rms"), analysis.rms(values, draw))
        same(ends(row, f"{name}_abs_q90"), analysis.quantile(np.abs(values), 0.9, draw))
    assert (row["phi_u_arcmin_rms_n"], row["phi_u_at_60_arcmin_rms_n"]) == (80, 79)
    errors = np.r_[np.full(11, 30.0), 8000.0]
    (row,) = analysis.summarise(summary_table(12, phi_u_arcmin=errors), []).to_pylist()
    assert analysis.rms(errors).high > 10_800.0 == row["phi_u_arcmin_rms_high"]


def test_summarise_without_truth_returns_nulls():
    names = [name for name in summary_table().column_names if name not in ("draw_id", "status")]
    nulls = dict.fromkeys(names, pa.nulls(12, pa.float64()))
    table = summary_table(**nulls, status=pa.nulls(12, pa.string()))
    (row,) = analysis.summarise(table, []).to_pylist()
    assert row.pop("n") == 12 and row.pop("nonfinite") == row.pop("no_floor") == 0
    assert {value for name, value in row.items() if not name.endswith("_n")} == {None}
    draws = pa.array(np.repeat(np.arange(6), 2))
    both = table.set_column(0, "draw_id", draws).append_column("case", pa.array([*"ab"] * 6))
    ((key, found),) = analysis.compare_with_baseline(both, ["case"], {"case": "a"}).groups
    assert (key, found.pop("n")) == ({"case": "b"}, 6)
    assert {*found.values()} == {analysis.UNKNOWN}


@pytest.mark.parametrize(("status", "nonfinite"), [("nonfinite", 12), ("no_north", 0)])
def test_summarise_counts_runs_without_heading_as_failed_and_unsettled(status, nonfinite):
    names = ("phi_u_arcmin", "phi_u_mean_arcmin", "settle_10_s", "nees", "nis_u")
    nothing = dict.fromkeys(names, np.full(12, math.nan))
    (row,) = analysis.summarise(summary_table(status=[status] * 12, **nothing), []).to_pylist()
    assert (row["nonfinite"], row["success_rate"]) == (nonfinite, 0.0)
    assert row["settle_10_s_median"] == NEVER and row["never_settled_10"] == 12
    for name in ("phi_u_mean_arcmin_mean", "nees_mean", "phi_u_arcmin_rms", "phi_u_arcmin_abs_q90"):
        assert np.isnan(ends(row, name)).all()


def test_summarise_of_chosen_statistics_needs_only_their_columns():
    whole = summary_table(case=["a", "b"] * 6)
    table = whole.select(["case", "status", "phi_u_arcmin", "settle_10_s"])
    names = ["never_settled_10", "success_rate", "settle_10_s_median"]
    found = analysis.summarise(table, "case", names)
    assert found.column_names[4:6] == ["never_settled_10", "success_rate"]
    assert found.equals(analysis.summarise(whole, ["case"]).select(found.column_names))


@pytest.mark.parametrize(
    ("table", "names", "message"),
    [
        (summary_table().slice(0, 0), None, "no runs"),
        (summary_table().drop_columns(["nees"]), None, "column nees is missing"),
        (summary_table(), ["settle_60_s_median"], "no statistic settle_60_s_median"),
        ("out", None, "str: is not a table"),
    ],
)
def test_summarise_refuses_unusable_tables_and_unknown_statistics(table, names, message):
    with pytest.raises(InputError, match=message):
        analysis.summarise(table, [], names)


def test_summarise_pools_runs_clustered_by_draw():
    draws = np.repeat(np.arange(12), 4)
    status = np.where(draws < 3, "not_settled", "ok")
    (row,) = analysis.summarise(summary_table(48, draw_id=draws, status=status), []).to_pylist()
    same(ends(row, "success_rate"), analysis.share(status == "ok", draws))


def variant_table(n=40):
    """Three variants on the same draws, in random order."""
    random = np.random.default_rng(11)
    shared = random.normal(0.0, 5.0, n)
    parts = []
    for times, slower, failing in (([], 0.0, 0), ([50.0], 30.0, 0), ([50.0, 100.0], 60.0, 25)):
        settle = 100.0 + shared + slower
        settle[:failing] = np.nan
        status = ["not_settled"] * failing + ["ok"] * (n - failing)
        yaw = -27.0 + shared * (1.0 + slower / 60.0)
        part = summary_table(n, settle_10_s=settle, status=status, phi_u_mean_arcmin=yaw)
        parts.append(with_times(part, times).take(random.permutation(n)))
    return parts


def test_compare_pairs_by_draw():
    base, later, failing = parts = variant_table()
    table, key = pa.concat_tables(parts), ["reset_times_s"]
    groups = analysis.compare_with_baseline(table, key, {"reset_times_s": ()}).groups
    (_, first), (last, second) = groups
    assert last == {"reset_times_s": [50.0, 100.0]} and first["n"] == 40
    # The same settling times 30 s later, so no interval, though draws differ by far more.
    same(first["settle_10_s_median_difference"][:3], (30.0, 30.0, 30.0))
    assert second["settle_10_s_median_difference"].value == NEVER
    ok = [np.asarray(t.sort_by("draw_id")["status"]) == "ok" for t in (failing, base)]
    assert second["success_rate_difference"] == analysis.proportion_difference(*ok)
    assert first["success_rate_difference"].value == 0.0
    errors = (np.abs(x + 27.0) for x in analysis.pair_by_draw(later, base, "phi_u_mean_arcmin"))
    assert first["phi_u_error_arcmin_difference"] == analysis.mean_difference(*errors)
    with pytest.raises(InputError, match="no runs of the baseline {'reset_times_s': \\[7.0\\]}"):
        analysis.compare_with_baseline(table, key, {"reset_times_s": [7.0]})
    with pytest.raises(InputError, match="draws differ"):
        analysis.compare_with_baseline(table.slice(1), key, {"reset_times_s": []})


def test_summarise_and_compare_give_no_intervals_on_record():
    table = summary_table(start_s=30.0 * np.arange(12))
    (row,) = analysis.summarise(table, []).to_pylist()
    assert row["success_rate"] == 1.0 and row["settle_10_s_median"] > 0
    both = pa.concat_tables([table.append_column("case", [[name] * 12]) for name in "ab"])
    assert {v for name, v in row.items() if name.endswith(("_low", "_high"))} == {None}
    ((_, found),) = analysis.compare_with_baseline(both, ["case"], {"case": "a"}).groups
    assert found["settle_10_s_median_difference"].value == 0.0 and found.pop("n") == 12
    assert all(np.isnan(one[1:3]).all() for one in found.values())

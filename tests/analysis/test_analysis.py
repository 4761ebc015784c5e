import math

import numpy as np
import pyarrow as pa
import pytest
from scipy import stats

from sinsjax import analysis
from sinsjax.analysis import tables
from sinsjax.errors import InputError

NEVER = math.inf
KEYS = ["reset_count", "reset_times_s"]


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


def test_paired_joins_on_draw_id():
    a = pa.table({"draw_id": [2, 0, 1], "x": [20, 0, None]})
    b = pa.table({"draw_id": [0, 1, 2], "x": [0.5, 1.5, 2.5]})
    first, second = analysis.pair_by_draw(a, b, "x")
    np.testing.assert_array_equal(first, [0.0, math.nan, 20.0])
    np.testing.assert_array_equal(second, [0.5, 1.5, 2.5])


@pytest.mark.parametrize(
    ("draws", "column", "message"),
    [([0, 0, 1], "x", "repeats"), ([0, 1, 3], "x", "differ"), ([0, 1, 2], "y", "column y")],
)
def test_paired_refuses_repeated_or_differing_draws_and_missing_column(draws, column, message):
    a = pa.table({"draw_id": [0, 1, 2], "x": [1, 2, 3]})
    b = pa.table({"draw_id": draws, "x": [1, 2, 3]})
    with pytest.raises(InputError, match=message):
        analysis.pair_by_draw(a, b, column)


def keyed_table(dictionary=False):
    label = pa.array(["b", "a", None, "b", "a", "b"])
    return pa.table(
        {
            "case": label.dictionary_encode() if dictionary else label,
            "reset_times_s": pa.array([[50.0], [], [50.0], [50.0], None, [50.0, 100.0]]),
            "row": np.arange(6),
        }
    )


@pytest.mark.parametrize("dictionary", [False, True])
@pytest.mark.parametrize(
    "by", [["case"], ["reset_times_s"], ["case", "reset_times_s"], ["reset_times_s", "case"], []]
)
def test_groups_match_naive_loop(by, dictionary, monkeypatch):
    monkeypatch.setattr(tables, "_SLICE", 4)
    # Two chunks, as a dataset of several parts gives them.
    table = pa.concat_tables(
        [keyed_table(dictionary).slice(0, 4), keyed_table(dictionary).slice(4)]
    )
    expected: list[tuple[dict, list]] = []
    for row in table.to_pylist():
        key = {name: row[name] for name in by}
        rows = next((rows for k, rows in expected if k == key), None)
        if rows is None:
            expected.append((key, [row["row"]]))
        else:
            rows.append(row["row"])
    found = [(key, rows["row"].to_pylist()) for key, rows in analysis.group_rows(table, by)]
    assert found == expected


def test_groups_of_empty_table_are_empty():
    assert list(analysis.group_rows(keyed_table().slice(0, 0), ["case", "reset_times_s"])) == []


def test_groups_refuses_unknown_key():
    with pytest.raises(InputError, match="column reset_cout"):
        list(analysis.group_rows(keyed_table(), ["reset_cout"]))


def test_summarise_returns_one_row_per_group():
    status = ["ok"] * 6 + ["diverged"] * 3 + ["not_settled"] * 2 + ["nonfinite"]
    settle = [50.0, 60.0, 70.0, 80.0, 90.0, 100.0] + [None] * 6
    yaw = [-27.5, -26.5] * 5 + [-27.0, math.nan]
    one = summary_table(status=status, settle_10_s=settle, phi_u_mean_arcmin=yaw)
    other = summary_table(settle_60_s=np.full(12, 30.0)).select(one.column_names)
    parts = [
        t.append_column("reset_times_s", pa.array([times] * 12, pa.list_(pa.float64())))
        .append_column("reset_count", pa.array([len(times)] * 12, pa.int32()))
        for t, times in ((one, [50.0, 100.0]), (other, []))
    ]  # fmt: skip
    table = analysis.summarise(pa.concat_tables(parts), KEYS)
    assert table.column_names[:4] == [*KEYS, "n", "nonfinite"]
    assert table.schema.field("reset_count").type == pa.int32()
    first, second = table.to_pylist()
    assert first["reset_times_s"] == [50.0, 100.0] and second["reset_times_s"] == []
    assert (first["n"], first["nonfinite"], second["nonfinite"]) == (12, 1, 0)

    def holds(name, estimate):
        columns = (name, f"{name}_low", f"{name}_high")
        unknown = [None if math.isnan(x) else pytest.approx(x) for x in estimate[:3]]
        assert [first[c] for c in columns] == unknown

    finite = np.array(yaw[:-1])
    holds("success_rate", analysis.proportion(6, 12))
    holds("diverged_rate", analysis.proportion(3, 12))
    holds("settle_10_s_median", analysis.quantile([*settle[:6], *[NEVER] * 6]))
    holds("settle_10_s_q90", analysis.quantile([*settle[:6], *[NEVER] * 6], 0.9))
    holds("phi_u_mean_arcmin_mean", analysis.mean(finite))
    # The runs ended in four ways, so quantiles stand for the standard deviation.
    holds("phi_u_mean_arcmin_std", analysis.UNKNOWN)
    holds("phi_u_mean_arcmin_q10", analysis.quantile(finite, 0.1))
    holds("phi_u_mean_arcmin_median", analysis.quantile(finite))
    holds("phi_u_mean_arcmin_q90", analysis.quantile(finite, 0.9))
    spread = [second[f"phi_u_mean_arcmin_std{end}"] for end in ("", "_low", "_high")]
    assert spread == pytest.approx(analysis.std(np.linspace(-28.0, -26.0, 12))[:3])
    holds("phi_u_from_floor_arcmin_mean", analysis.mean(finite + 27.0))
    holds("settle_10_s_mean", analysis.mean(settle[:6]))
    holds("phi_u_std_arcmin_mean", analysis.mean(np.linspace(0.1, 0.4, 12)))
    holds("nees_median", analysis.quantile(np.linspace(1, 5, 12)))
    holds("nees_mean", analysis.mean(np.linspace(1, 5, 12)))
    holds("nis_u_mean", analysis.mean(np.linspace(0.2, 2, 12)))
    for name, freedom in (("nees_mean", 3), ("nis_u_mean", 1)):
        band = stats.chi2.ppf([0.025, 0.975], freedom * 12) / 12
        assert [first[f"{name}_chi2_{end}"] for end in ("low", "high")] == pytest.approx(list(band))
    assert (first["never_settled_10"], second["never_settled_10"]) == (6, 0)
    assert (first["settle_10_s_mean_n"], first["phi_u_mean_arcmin_mean_n"]) == (6, 11)
    assert first["settle_10_s_median"] == 100.0 and first["settle_10_s_median_high"] == NEVER
    assert second["success_rate"] == 1.0


def test_heading_error_interval_ends_are_capped_at_180_deg():
    errors = np.r_[np.full(11, 30.0), 8000.0]
    row = analysis.summarise(summary_table(12, phi_u_arcmin=errors), []).to_pylist()[0]
    assert analysis.rms(errors).high > 10_800.0 == row["phi_u_arcmin_rms_high"]


def test_heading_error_statistics_use_magnitudes_at_end_and_report_times():
    """Compared with NumPy; pooled variants of a draw count once, and headings do not cancel."""
    draw = np.repeat(np.arange(40), 2)
    error = 60.0 * np.random.default_rng(3).normal(size=80)
    early = np.where(np.arange(80) == 7, math.nan, 10 * error)
    table = summary_table(
        80, draw_id=draw, phi_u_arcmin=np.r_[error[::2], -error[::2]], phi_u_at_60_arcmin=early
    )
    (row,) = analysis.summarise(table, []).to_pylist()
    assert row["phi_u_arcmin_rms"] == pytest.approx(np.sqrt(np.mean(error[::2] ** 2)))
    assert row["phi_u_at_60_arcmin_rms"] == pytest.approx(np.sqrt(np.nanmean(early**2)))
    assert (row["phi_u_arcmin_rms_n"], row["phi_u_at_60_arcmin_rms_n"]) == (80, 79)
    ranked = np.sort(np.abs(np.nan_to_num(early, nan=NEVER)))
    assert row["phi_u_at_60_arcmin_abs_q90"] == ranked[71] and ranked[-1] == NEVER
    for name in ("phi_u_arcmin", "phi_u_at_60_arcmin"):
        values = table[name].to_numpy()
        known = np.isfinite(values)
        for end, estimate in (
            ("rms", analysis.rms(values[known], draw[known])),
            ("abs_q90", analysis.quantile(np.abs(values), 0.9, draw)),
        ):
            ends = [row[f"{name}_{end}_low"], row[f"{name}_{end}_high"]]
            assert ends == pytest.approx(list(estimate[1:3])), (name, end)
            assert ends[0] < row[f"{name}_{end}"] < ends[1]


def test_summarise_of_single_run_covers_every_settle_band():
    table = analysis.summarise(summary_table(1, settle_3_s=[None], settle_60_s=[20.0]), [])
    (row,) = table.to_pylist()
    assert row["settle_3_s_median"] == NEVER and row["settle_60_s_median"] == 20.0
    assert (row["never_settled_3"], row["never_settled_60"]) == (1, 0)
    assert (row["settle_3_s_mean"], row["settle_3_s_mean_n"]) == (None, 0)
    assert row["phi_u_mean_arcmin_mean"] == -28.0
    assert row["phi_u_mean_arcmin_mean_low"] is row["phi_u_mean_arcmin_std"] is None


def test_summarise_without_truth_returns_nulls():
    nothing = pa.nulls(12, pa.float64())
    names = [name for name in summary_table().column_names if name not in ("draw_id", "status")]
    status = pa.nulls(12, pa.string())
    table = summary_table(**dict.fromkeys(names, nothing), status=status)
    (row,) = analysis.summarise(table, []).to_pylist()
    assert row.pop("n") == 12 and row.pop("nonfinite") == row.pop("no_floor") == 0
    assert {value for name, value in row.items() if not name.endswith("_n")} == {None}
    assert {value for name, value in row.items() if name.endswith("_n")} == {0}


@pytest.mark.parametrize(("status", "nonfinite"), [("nonfinite", 12), ("no_north", 0)])
def test_summarise_counts_runs_without_heading_as_failed_and_unsettled(status, nonfinite):
    nothing = np.full(12, math.nan)
    table = summary_table(
        status=[status] * 12, phi_u_arcmin=nothing, phi_u_mean_arcmin=nothing,
        settle_10_s=nothing, nees=nothing, nis_u=nothing,
    )  # fmt: skip
    (row,) = analysis.summarise(table, []).to_pylist()
    assert (row["nonfinite"], row["success_rate"]) == (nonfinite, 0.0)
    assert row["settle_10_s_median"] == NEVER
    assert row["phi_u_mean_arcmin_mean"] is None and row["never_settled_10"] == 12
    assert row["nees_mean_chi2_low"] is row["nees_mean"] is None
    assert row["phi_u_arcmin_rms"] is row["phi_u_arcmin_abs_q90"] is None


def test_summarise_of_chosen_statistics_needs_only_their_columns():
    whole = summary_table(case=["a", "b"] * 6)
    table = whole.select(["case", "status", "phi_u_arcmin", "settle_10_s"])
    names = ["never_settled_10", "success_rate", "settle_10_s_median"]
    found = analysis.summarise(table, ["case"], names)
    assert found.column_names[:4] == ["case", "n", "nonfinite", "no_floor"]
    assert found.column_names[4] == "never_settled_10"
    assert found.column_names[5:8] == ["success_rate", "success_rate_low", "success_rate_high"]
    assert found.equals(analysis.summarise(whole, ["case"]).select(found.column_names))


def test_summarise_refuses_no_runs_missing_column_and_unknown_statistic():
    with pytest.raises(InputError, match="no runs"):
        analysis.summarise(summary_table().slice(0, 0), [])
    with pytest.raises(InputError, match="column nees is missing"):
        analysis.summarise(summary_table().drop_columns(["nees"]), [])
    with pytest.raises(InputError, match="no statistic settle_60_s_median"):
        analysis.summarise(summary_table(), [], ["settle_60_s_median"])


def variant_table(n=40):
    """Three variants on the same draws, in random order."""
    random = np.random.default_rng(11)
    shared = random.normal(0.0, 5.0, n)
    parts = []
    for times, slower, failing in (([], 0.0, 0), ([50.0], 30.0, 0), ([50.0, 100.0], 60.0, 25)):
        settle = 100.0 + shared + slower
        settle[:failing] = np.nan
        part = summary_table(
            n,
            settle_10_s=settle,
            status=["not_settled"] * failing + ["ok"] * (n - failing),
            phi_u_mean_arcmin=-27.0 + shared * (1.0 + slower / 60.0),
        ).append_column("reset_times_s", pa.array([times] * n, pa.list_(pa.float64())))
        parts.append(part.take(random.permutation(n)))
    return parts


def test_compare_pairs_by_draw():
    base, later, failing = parts = variant_table()
    table = analysis.compare_with_baseline(
        pa.concat_tables(parts), ["reset_times_s"], {"reset_times_s": ()}
    )
    first, second = table.to_pylist()
    assert [row["reset_times_s"] for row in (first, second)] == [[50.0], [50.0, 100.0]]
    # The same settling times 30 s later, so no interval, though draws differ by far more.
    names = [f"settle_10_s_median_difference{end}" for end in ("", "_low", "_high")]
    assert [first[name] for name in names] == pytest.approx([30.0, 30.0, 30.0])
    assert second[names[0]] == NEVER
    ok = [np.asarray(t.sort_by("draw_id")["status"]) == "ok" for t in (failing, base)]
    expected = analysis.proportion_difference(*ok)
    ends = [second[f"success_rate_difference{end}"] for end in ("", "_low", "_high")]
    assert ends == pytest.approx(list(expected[:3])) and second["success_rate_difference"] < -0.5
    assert first["success_rate_difference"] == 0.0
    errors = (np.abs(x + 27.0) for x in analysis.pair_by_draw(later, base, "phi_u_mean_arcmin"))
    error = analysis.mean_difference(*errors)
    ends = [first[f"phi_u_error_arcmin_difference{end}"] for end in ("", "_low", "_high", "_n")]
    assert ends == pytest.approx(list(error)) and first["n"] == 40


def test_compare_without_truth_returns_nulls():
    lost = pa.nulls(40, pa.float64())
    names = ("phi_u_arcmin", "phi_u_mean_arcmin", "floor_arcmin", "settle_10_s", "status")
    parts = [t.drop_columns(names) for t in variant_table()]
    for name in names:
        nulls = pa.nulls(40, pa.string()) if name == "status" else lost
        parts = [t.append_column(name, nulls) for t in parts]
    row, _ = analysis.compare_with_baseline(
        pa.concat_tables(parts), ["reset_times_s"], {"reset_times_s": []}
    ).to_pylist()
    keys = ("reset_times_s", "n", "phi_u_error_arcmin_difference_n")
    assert {value for name, value in row.items() if name not in keys} == {None}


def test_compare_refuses_missing_baseline_and_unpaired_draws():
    table = pa.concat_tables(variant_table())
    with pytest.raises(InputError, match="no runs of the baseline {'reset_times_s': \\[7.0\\]}"):
        analysis.compare_with_baseline(table, ["reset_times_s"], {"reset_times_s": [7.0]})
    with pytest.raises(InputError, match="draws differ"):
        analysis.compare_with_baseline(table.slice(1), ["reset_times_s"], {"reset_times_s": []})
    with pytest.raises(InputError, match="draw_id repeats"):
        analysis.compare_with_baseline(
            table.append_column("case", table["status"]), ["case"], {"case": "ok"}
        )


def test_one_key_is_enough_and_a_path_is_no_table():
    draws = {"draw_id": range(16), "status": ["ok"] * 16, "phi_u_arcmin": [2.0] * 16}
    table = pa.table(draws | {"method": ["a", "b"] * 8})
    names = ["success_rate"]
    one, several = (analysis.summarise(table, by, names) for by in ("method", ["method"]))
    assert one == several and one["method"].to_pylist() == ["a", "b"]
    with pytest.raises(InputError, match="str: is not a table"):
        analysis.summarise("out", "method")

import math

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from sinsjax import analysis
from sinsjax.analysis import Estimate
from sinsjax.types import InputError

NEVER = math.inf
KEYS = ["reset_count", "reset_times_s"]


def summary(n=12, **columns):
    base = {
        "draw_id": np.arange(n),
        "status": ["ok"] * n,
        "phi_u_arcmin": np.full(n, -27.0),
        "phi_u_mean_arcmin": np.linspace(-28.0, -26.0, n),
        "floor_arcmin": np.full(n, -27.0),
        "settle_10_s": np.linspace(50.0, 160.0, n),
        "nees": np.linspace(1.0, 5.0, n),
    }
    return pa.table(base | columns)


@pytest.mark.parametrize(
    ("estimate", "unit", "text"),
    [
        (Estimate(12.31, 11.88, 12.84, 5), "", "12.3 [11.9, 12.8]"),
        (Estimate(12.31, 11.88, 12.84, 5), "s", "12.3 [11.9, 12.8] s"),
        (Estimate(NEVER, 300.0, NEVER, 5), "s", "never [300.0, never] s"),
        (Estimate(-NEVER, -NEVER, 0.0, 5), "", "-never [-never, 0.0]"),
        (Estimate(1.0, math.nan, math.nan, 1), "", "1.0 [unknown, unknown]"),
    ],
)
def test_format(estimate, unit, text):
    assert analysis.format_estimate(estimate, unit) == text


def test_format_digits():
    assert (
        analysis.format_estimate(Estimate(0.5, 0.25, 0.75, 9), digits=3) == "0.500 [0.250, 0.750]"
    )


@pytest.mark.parametrize(("k", "n"), [(0, 1), (1, 1), (0, 64), (61, 64), (64, 64), (500, 1000)])
def test_proportion_is_wilsons_closed_form(k, n):
    z = stats.norm.ppf(0.975)
    share = k / n
    centre = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    found = analysis.proportion(k, n)
    assert (found.value, found.n) == (share, n)
    assert found[1:3] == pytest.approx((max(0, centre - half), min(1, centre + half)), abs=1e-12)


@pytest.mark.parametrize(("k", "n"), [(0, 0), (-1, 4), (5, 4)])
def test_proportion_refuses(k, n):
    with pytest.raises(ValueError, match="a share needs"):
        analysis.proportion(k, n)


@given(
    st.lists(st.floats(-1e3, 1e3) | st.just(math.nan) | st.just(NEVER), min_size=1, max_size=80),
    st.sampled_from([0.1, 0.5, 0.75, 0.9]),
)
def test_quantile_is_the_first_value_that_enough_reach(values, q):
    data = [NEVER if math.isnan(v) else v for v in values]
    found = analysis.quantile(values, q)
    enough = [v for v in sorted(data) if sum(w <= v for w in data) >= q * len(data) - 1e-9]
    assert found.value == enough[0]
    oracle = stats.quantile_test(data, p=q).confidence_interval(0.95)
    np.testing.assert_array_equal(found[1:3], oracle)


def test_quantile_never():
    assert analysis.quantile([math.nan] * 64) == Estimate(NEVER, NEVER, NEVER, 64)
    half = analysis.quantile([10.0] * 32 + [math.nan] * 32)
    assert half == Estimate(10.0, 10.0, NEVER, 64)
    assert analysis.quantile([10.0] * 31 + [math.nan] * 33).value == NEVER


def test_quantile_of_one_value_has_no_interval():
    found = analysis.quantile([7.0])
    assert found.value == 7.0
    assert math.isnan(found.low) and math.isnan(found.high)


def test_quantile_interval_covers():
    random = np.random.default_rng(3)
    draws = random.lognormal(size=(400, 40))
    hits = 0
    for row in draws:
        found = analysis.quantile(row)
        hits += found.low <= 1.0 <= found.high
    assert hits / 400 > 0.93


def test_mean_is_students():
    values = np.random.default_rng(1).normal(3.0, 2.0, 20)
    found = analysis.mean(np.append(values, [math.nan, NEVER]))
    oracle = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert found == pytest.approx((values.mean(), oracle.low, oracle.high, 20), rel=1e-12)


def test_std_agrees_with_scipys_bootstrap():
    values = np.random.default_rng(2).normal(3.0, 2.0, 64)
    found = analysis.std(np.append(values, math.nan))
    oracle = stats.bootstrap(
        (values,), lambda x, axis: np.std(x, axis=axis, ddof=1), n_resamples=9999,
        method="percentile", random_state=5,
    ).confidence_interval  # fmt: skip
    assert (found.value, found.n) == (pytest.approx(values.std(ddof=1)), 64)
    assert found[1:3] == pytest.approx(tuple(oracle), rel=0.02)
    assert found == analysis.std(values)


def test_bootstrap_in_small_blocks_is_the_same(monkeypatch):
    values = np.random.default_rng(2).normal(size=30)
    whole = analysis.std(values)
    monkeypatch.setattr(analysis, "_BLOCK", 700)
    assert analysis.std(values) == whole


def test_constant_values_have_an_interval_of_no_width():
    assert analysis.mean([2.0, 2.0, 2.0]) == Estimate(2.0, 2.0, 2.0, 3)
    assert analysis.std([2.0, 2.0, 2.0]) == Estimate(0.0, 0.0, 0.0, 3)


@pytest.mark.parametrize("values", [[5.0], [math.nan, 5.0], [math.nan]])
def test_too_few_values_are_unknown(values):
    finite = [v for v in values if not math.isnan(v)]
    centre, spread = analysis.mean(values), analysis.std(values)
    assert centre.value == finite[0] if finite else math.isnan(centre.value)
    assert centre.n == spread.n == len(finite)
    assert np.isnan([*centre[1:3], *spread[:3]]).all()


@pytest.mark.parametrize("statistic", [analysis.quantile, analysis.mean, analysis.std])
@pytest.mark.parametrize("values", [[], [[1.0, 2.0]]])
def test_statistics_refuse(statistic, values):
    with pytest.raises(ValueError, match="one or more values"):
        statistic(values)


@pytest.mark.parametrize("compare", [analysis.difference, analysis.quantile_difference])
def test_differences_refuse(compare):
    with pytest.raises(ValueError, match="equal lengths"):
        compare([1.0, 2.0], [1.0])
    with pytest.raises(ValueError, match="one or more values"):
        compare([], [])


def test_quantile_out_of_range_is_refused():
    with pytest.raises(ValueError):
        analysis.quantile([1.0, 2.0], 1.5)


def test_difference_is_the_paired_t_test():
    random = np.random.default_rng(4)
    a = random.normal(size=30)
    b = a + random.normal(0.3, 0.1, 30)
    oracle = stats.ttest_rel(b, a).confidence_interval(0.95)
    found = analysis.difference(b, a)
    assert found == pytest.approx(((b - a).mean(), oracle.low, oracle.high, 30), rel=1e-9)
    a[3], b[4] = math.nan, NEVER
    a[5] = b[5] = NEVER
    assert analysis.difference(b, a).n == 27


def test_quantile_difference_against_a_naive_loop():
    random = np.random.default_rng(6)
    b = random.uniform(50, 150, 40)
    a = b + random.uniform(0, 30, 40)
    a[:8] = math.nan
    found = analysis.quantile_difference(a, b)

    def median(values):
        return sorted(NEVER if math.isnan(v) else v for v in values)[len(values) // 2 - 1]

    resampled = []
    for _ in range(2000):
        pick = random.integers(0, 40, 40)
        resampled.append(median(a[pick]) - median(b[pick]))
    assert found.value == median(a) - median(b)
    assert found[1:3] == pytest.approx(np.quantile(resampled, [0.025, 0.975]), abs=4.0)


def test_quantile_difference_keeps_the_pairs():
    noise = np.random.default_rng(7).normal(0, 100, 50)
    assert analysis.quantile_difference(noise + 5.0, noise)[:3] == pytest.approx((5.0, 5.0, 5.0))


@pytest.mark.parametrize(
    ("a", "b", "expected"), [(None, 9.0, NEVER), (9.0, None, -NEVER), (None, None, 0.0)]
)
def test_quantile_difference_of_never(a, b, expected):
    found = analysis.quantile_difference(np.full(20, a, float), np.full(20, b, float))
    assert found == Estimate(expected, expected, expected, 20)


def test_one_pair_has_no_interval():
    found = analysis.quantile_difference([3.0], [1.0])
    assert (found.value, found.n) == (2.0, 1)
    assert np.isnan(found[1:3]).all()


def test_paired_joins_on_the_draw():
    a = pa.table({"draw_id": [2, 0, 1], "x": [20, 0, None]})
    b = pa.table({"draw_id": [0, 1, 2], "x": [0.5, 1.5, 2.5]})
    first, second = analysis.paired(a, b, "x")
    np.testing.assert_array_equal(first, [0.0, math.nan, 20.0])
    np.testing.assert_array_equal(second, [0.5, 1.5, 2.5])


@pytest.mark.parametrize(
    ("draws", "column", "message"),
    [([0, 0, 1], "x", "repeats"), ([0, 1, 3], "x", "differ"), ([0, 1, 2], "y", "column y")],
)
def test_paired_refuses(draws, column, message):
    a = pa.table({"draw_id": [0, 1, 2], "x": [1, 2, 3]})
    b = pa.table({"draw_id": draws, "x": [1, 2, 3]})
    with pytest.raises(InputError, match=message):
        analysis.paired(a, b, column)


def keyed(dictionary=False):
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
def test_groups_against_a_naive_loop(by, dictionary):
    # Two chunks, as a dataset of several parts gives them.
    table = pa.concat_tables([keyed(dictionary).slice(0, 4), keyed(dictionary).slice(4)])
    expected: list[tuple[dict, list]] = []
    for row in table.to_pylist():
        key = {name: row[name] for name in by}
        rows = next((rows for k, rows in expected if k == key), None)
        if rows is None:
            expected.append((key, [row["row"]]))
        else:
            rows.append(row["row"])
    found = [(key, rows["row"].to_pylist()) for key, rows in analysis.groups(table, by)]
    assert found == expected


def test_groups_of_nothing():
    assert list(analysis.groups(keyed().slice(0, 0), ["case", "reset_times_s"])) == []


def test_groups_refuses_an_unknown_key():
    with pytest.raises(InputError, match="column reset_cout is missing"):
        list(analysis.groups(keyed(), ["reset_cout"]))


def test_summarise_one_row_a_group():
    status = ["ok"] * 6 + ["diverged"] * 3 + ["not_settled"] * 2 + ["nonfinite"]
    settle = [50.0, 60.0, 70.0, 80.0, 90.0, 100.0] + [None] * 6
    yaw = [-27.5, -26.5] * 5 + [-27.0, math.nan]
    one = summary(status=status, settle_10_s=settle, phi_u_mean_arcmin=yaw)
    other = summary(settle_60_s=np.full(12, 30.0)).select(one.column_names)
    tables = [
        t.append_column("reset_times_s", pa.array([times] * 12, pa.list_(pa.float64())))
        .append_column("reset_count", pa.array([len(times)] * 12, pa.int32()))
        for t, times in ((one, [50.0, 100.0]), (other, []))
    ]  # fmt: skip
    table = analysis.summarise(pa.concat_tables(tables), KEYS)
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
    holds("phi_u_mean_arcmin_std", analysis.std(finite))
    holds("phi_u_from_floor_arcmin_mean", analysis.mean(finite + 27.0))
    holds("nees_median", analysis.quantile(np.linspace(1, 5, 12)))
    assert first["settle_10_s_median"] == 100.0 and first["settle_10_s_median_high"] == NEVER
    assert second["success_rate"] == 1.0


def test_summarise_a_single_run_and_every_band():
    table = analysis.summarise(summary(1, settle_3_s=[None], settle_60_s=[20.0]), [])
    (row,) = table.to_pylist()
    assert row["settle_3_s_median"] == NEVER and row["settle_60_s_median"] == 20.0
    assert row["phi_u_mean_arcmin_mean"] == -28.0
    assert row["phi_u_mean_arcmin_mean_low"] is row["phi_u_mean_arcmin_std"] is None


def test_summarise_without_truth_says_unknown():
    nothing = pa.nulls(12, pa.float64())
    names = ("phi_u_arcmin", "phi_u_mean_arcmin", "floor_arcmin", "settle_10_s", "nees")
    status = pa.nulls(12, pa.string())
    table = summary(**dict.fromkeys(names, nothing), status=status)
    (row,) = analysis.summarise(table, []).to_pylist()
    assert row.pop("n") == 12 and row.pop("nonfinite") == 0
    assert set(row.values()) == {None}


def test_summarise_all_nonfinite_is_not_without_truth():
    nothing = np.full(12, math.nan)
    table = summary(
        status=["nonfinite"] * 12, phi_u_arcmin=nothing, phi_u_mean_arcmin=nothing,
        settle_10_s=nothing, nees=nothing,
    )  # fmt: skip
    (row,) = analysis.summarise(table, []).to_pylist()
    assert (row["nonfinite"], row["success_rate"]) == (12, 0.0)
    assert row["settle_10_s_median"] == NEVER
    assert row["phi_u_mean_arcmin_mean"] is None


def test_summarise_refuses():
    with pytest.raises(InputError, match="no runs"):
        analysis.summarise(summary().slice(0, 0), [])
    with pytest.raises(InputError, match="column nees is missing"):
        analysis.summarise(summary().drop_columns(["nees"]), [])


def test_rms_is_the_root_of_the_mean_square_and_its_interval_covers():
    random = np.random.default_rng(4)
    values = random.normal(size=40)
    found = analysis.rms(values)
    assert found.value == pytest.approx(math.sqrt(np.mean(values**2)))
    assert found.low < found.value < found.high and found.n == 40
    hits = [e.low < 1 < e.high for e in map(analysis.rms, random.normal(size=(100, 40)))]
    assert 0.85 < np.mean(hits) < 1


def test_rms_leaves_out_what_is_not_finite():
    values = np.array([3.0, np.nan, 4.0, np.inf])
    assert analysis.rms(values)[::3] == (pytest.approx(math.sqrt(12.5)), 2)
    assert analysis.rms([np.nan]).n == 0 and math.isnan(analysis.rms([2.0]).low)

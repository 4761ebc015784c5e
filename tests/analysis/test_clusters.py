"""Intervals of runs that depend on one another: by draw, and none on a record."""

import math

import numpy as np
import pyarrow as pa
import pytest
from scipy import special, stats

from sinsjax import analysis

DRAWS, VARIANTS = 16, 12


def pooled(values):
    """Values (draws, variants) as runs, with the draw of each."""
    draws = np.broadcast_to(np.arange(len(values))[:, None], np.shape(values))
    return np.ravel(values), draws.ravel()


@pytest.mark.parametrize("statistic", [analysis.mean, analysis.std, analysis.rms])
def test_clusters_of_one_value_equal_independent_values(statistic):
    values = np.random.default_rng(1).normal(2.0, 1.0, 20)
    assert statistic(values, np.arange(20)[::-1]) == pytest.approx(statistic(values))
    assert analysis.quantile(values, 0.9, np.arange(20)) == analysis.quantile(values, 0.9)
    assert analysis.share(values > 2, np.arange(20)) == analysis.share(values > 2)


def test_share_without_clusters_is_wilson_interval():
    assert analysis.share([True, False, True, True]) == analysis.proportion(3, 4)


def test_mean_of_equal_draws_is_student_interval_of_draw_means():
    values = np.random.default_rng(2).normal(size=(DRAWS, 1)) + np.zeros((DRAWS, VARIANTS))
    values += np.random.default_rng(3).normal(0, 0.3, values.shape)
    found, by_draw = analysis.mean(*pooled(values)), analysis.mean(values.mean(axis=1))
    assert found[:3] == pytest.approx(by_draw[:3]) and found.n == DRAWS * VARIANTS


def test_mean_of_unequal_draws_agrees_with_bootstrap():
    random = np.random.default_rng(4)
    draw = np.repeat(np.arange(60), random.integers(1, 9, 60))
    values = random.normal(size=60)[draw] + random.normal(0, 0.5, draw.size)
    drawn = []
    for _ in range(2000):
        pick = np.concatenate([np.flatnonzero(draw == d) for d in random.integers(0, 60, 60)])
        drawn.append(values[pick].mean())
    found = analysis.mean(values, draw)
    assert found.high - found.low == pytest.approx(2 * 2.0 * np.std(drawn), rel=0.06)


def test_nonfinite_values_are_left_out_with_their_clusters():
    values, draws = pooled(np.random.default_rng(5).normal(size=(8, 3)))
    holed = np.append(values, [math.inf, math.nan])
    assert analysis.mean(holed, np.append(draws, [0, 99])) == analysis.mean(values, draws)


def test_share_of_identical_runs_per_draw_is_share_of_draws():
    whole = np.repeat(np.arange(DRAWS) < 5, VARIANTS).reshape(DRAWS, VARIANTS)
    found = analysis.share(*pooled(whole))
    share, worth = 5 / 16, DRAWS - 1  # the variance of a mean is told with n - 1
    t = stats.t.ppf(0.975, DRAWS - 1)
    ends = np.roots([1 + t * t / worth, -2 * share - t * t / worth, share**2])
    assert found[1:3] == pytest.approx(sorted(ends))
    naive = analysis.proportion(60, 192)
    assert found.high - found.low > 3 * (naive.high - naive.low)


def test_interval_of_zero_or_full_share_counts_draws():
    flags, draws = pooled(np.zeros((DRAWS, VARIANTS)))
    found = analysis.share(flags, draws)
    t = stats.t.ppf(0.975, DRAWS - 1)
    assert found[:3] == pytest.approx((0.0, 0.0, t * t / (DRAWS + t * t)))
    assert analysis.share(1 - flags, draws)[1:3] == pytest.approx((1 - found.high, 1.0))


@pytest.mark.slow
@pytest.mark.parametrize("alike", [0.0, 0.9])
@pytest.mark.parametrize("draws", [8, 64])
def test_clustered_intervals_cover_true_values(draws, alike):
    random = np.random.default_rng([draws, round(10 * alike)])
    hits = {0.5: 0, 0.9: 0}
    shares = []
    for _ in range(400):
        values = math.sqrt(alike) * random.normal(size=(draws, 1)) + math.sqrt(
            1 - alike
        ) * random.normal(size=(draws, VARIANTS))
        runs = pooled(values)
        for q in hits:
            one, true = analysis.quantile(runs[0], q, runs[1]), special.ndtri(q)
            hits[q] += not (one.low > true or one.high < true)
        share = random.uniform(0.02, 0.98)
        one = analysis.share(runs[0] < special.ndtri(share), runs[1])
        shares.append(one.low <= share <= one.high)
    assert np.mean(shares) >= 0.93
    assert min(hits.values()) >= 0.93 * 400, hits


def test_one_cluster_has_no_interval():
    values = np.random.default_rng(6).normal(size=12)
    record = np.zeros(12, dtype=int)
    for found in (
        analysis.mean(values, record),
        analysis.quantile(values, 0.5, record),
        analysis.share(values > 0, record),
        analysis.std(values, record),
        analysis.rms(values, record),
        analysis.difference(values, -values, record),
    ):
        assert math.isfinite(found.value) and found.n == 12
        assert np.isnan(found[1:3]).all()


def test_one_run_has_no_interval():
    found = analysis.share([True], [0])
    assert found.value == 1.0 and found.n == 1 and np.isnan(found[1:3]).all()


def test_unequal_number_of_clusters_and_values_raises():
    with pytest.raises(ValueError, match="3 values need as many clusters, got 2"):
        analysis.mean([1.0, 2.0, 3.0], [0, 1])


def runs(draw, start):
    return pa.table({"draw_id": draw, "start_s": start, "x": np.arange(len(draw))})


def test_clusters_are_draws_or_one_whole_record():
    simulated, recorded = runs([0, 0, 1], [0.0, 0.0, 0.0]), runs([0, 0, 1], [0.0, 0.0, 30.0])
    assert analysis.clusters_of(simulated).tolist() == [0, 0, 1]
    assert analysis.clusters_of(recorded).tolist() == [0, 0, 0]
    assert analysis.clusters_of(simulated.select(["x"])) is None
    assert not analysis.are_single(simulated) and not analysis.are_single(recorded)
    assert analysis.are_single(simulated.slice(1)) and analysis.are_single(simulated.select(["x"]))


def summary(draws, **columns):
    n = len(draws)
    base = {
        "draw_id": draws,
        "start_s": np.zeros(n),
        "status": ["ok"] * n,
        "phi_u_arcmin": np.zeros(n),
        "phi_u_mean_arcmin": np.random.default_rng(7).normal(size=n),
        "phi_u_std_arcmin": np.ones(n),
        "floor_arcmin": np.zeros(n),
        "settle_10_s": np.random.default_rng(8).uniform(10, 90, n),
        "nees": np.random.default_rng(9).chisquare(3, n),
        "nis_u": np.random.default_rng(10).chisquare(1, n),
    }
    return pa.table(base | columns)


def test_summarise_pools_runs_clustered_by_draw():
    draws = np.repeat(np.arange(12), 4)
    status = np.where(draws < 3, "not_settled", "ok")
    (row,) = analysis.summarise(summary(draws, status=status), []).to_pylist()
    expected = analysis.share(status == "ok", draws)
    ends = [row[f"success_rate{end}"] for end in ("", "_low", "_high")]
    assert ends == pytest.approx(expected[:3]) and row["n"] == 48
    assert row["nees_mean"] and row["nees_mean_chi2_low"] is None  # a band of independent runs


def test_summarise_and_compare_give_no_intervals_on_record():
    table = summary(np.arange(12), start_s=30.0 * np.arange(12))
    (row,) = analysis.summarise(table, []).to_pylist()
    assert row["success_rate"] == 1.0 and row["settle_10_s_median"] > 0
    ends = {value for name, value in row.items() if name.endswith(("_low", "_high"))}
    assert ends == {None}
    both = [table.append_column("case", [[name] * 12]) for name in "ab"]
    (row,) = analysis.compare(pa.concat_tables(both), ["case"], {"case": "a"}).to_pylist()
    assert row["settle_10_s_median_difference"] == 0.0
    assert {value for name, value in row.items() if name.endswith(("_low", "_high"))} == {None}

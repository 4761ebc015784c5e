"""Intervals of dependent runs: by draw, and none on a record."""

import math

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from sinsjax import analysis

DRAWS, VARIANTS = 16, 12
LEAST = 0.025 ** (1 / 16)  # of 16 successes of 16


def flatten_draws(values):
    """Return values (draws, variants) as runs, with the draw of each."""
    draws = np.broadcast_to(np.arange(len(values))[:, None], np.shape(values))
    return np.ravel(values), draws.ravel()


@pytest.mark.parametrize("statistic", [analysis.mean, analysis.rms])
def test_clusters_of_one_value_equal_independent_values(statistic):
    values = np.random.default_rng(1).normal(2.0, 1.0, 20)
    assert statistic(values, np.arange(20)[::-1]) == pytest.approx(statistic(values))
    assert analysis.quantile(values, 0.9, np.arange(20)) == analysis.quantile(values, 0.9)
    assert analysis.share(values > 2, np.arange(20)) == analysis.share(values > 2)


def test_mean_of_equal_draws_is_student_interval_of_draw_means():
    values = np.random.default_rng(2).normal(size=(DRAWS, 1)) + np.zeros((DRAWS, VARIANTS))
    values += np.random.default_rng(3).normal(0, 0.3, values.shape)
    runs, draws = flatten_draws(values)
    found, by_draw = analysis.mean(runs, draws), analysis.mean(values.mean(axis=1))
    assert found[:3] == pytest.approx(by_draw[:3]) and found.n == DRAWS * VARIANTS
    holed = np.append(runs, [math.inf, math.nan])
    assert analysis.mean(holed, np.append(draws, [0, 99])) == found


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


def test_share_of_identical_runs_per_draw_is_share_of_draws():
    whole = np.repeat(np.arange(DRAWS) < 5, VARIANTS).reshape(DRAWS, VARIANTS)
    oracle = stats.binomtest(5, DRAWS).proportion_ci(0.95, "exact")
    assert analysis.share(*flatten_draws(whole))[:3] == pytest.approx((5 / 16, *oracle), rel=1e-9)


def test_share_that_all_draws_have_is_bounded_by_one_unseen_kind_of_draw():
    """2 of 8 starts settle in each of 16 draws: by hand, 2.5 % quantiles of Beta(16, 1)."""
    flags, draws = flatten_draws(np.tile(np.arange(8) < 2, (16, 1)))
    assert analysis.share(flags, draws)[1:3] == pytest.approx((LEAST / 4, 1 - LEAST * 3 / 4))
    assert analysis.share(flags >= 0, draws)[1:3] == pytest.approx((LEAST, 1.0))


@pytest.mark.parametrize("sizes", [[12] * 16, [5, 12, 1, 7, 12, 12, 3, 8]])
def test_share_ends_are_quantiles_of_dirichlet_weighted_share(sizes):
    """Compared with simulated weights of the draws and of one that fails, or succeeds, always."""
    random = np.random.default_rng(14)
    draw = np.repeat(np.arange(len(sizes)), sizes)
    likely = random.uniform(0.3, 1.0, len(sizes))
    flags = random.random(draw.size) < likely[draw]
    hits = np.bincount(draw, flags)
    weight = random.exponential(size=(200_000, len(sizes) + 1))
    weighted = [
        weight @ np.append(hits, one) / (weight @ np.append(sizes, 12)) for one in (0.0, 12.0)
    ]
    expected = np.quantile(weighted[0], 0.025), np.quantile(weighted[1], 0.975)
    assert analysis.share(flags, draw)[1:3] == pytest.approx(expected, abs=2e-3)


FLAGS = st.lists(st.lists(st.booleans(), min_size=1, max_size=8), min_size=2, max_size=20)


@given(FLAGS, st.integers(0, 10**6))
def test_share_ends_never_rise_with_further_failure(flags, chosen):
    draws = np.repeat(np.arange(len(flags)), [len(one) for one in flags])
    runs = np.concatenate(flags)
    found = analysis.share(runs, draws)
    assert 0 <= found.low <= found.value <= found.high <= 1
    succeeded = np.flatnonzero(runs)
    if succeeded.size:
        runs[succeeded[chosen % succeeded.size]] = False
        worse = analysis.share(runs, draws)
        assert worse.low <= found.low + 1e-7 and worse.high <= found.high + 1e-7


def test_spread_between_variants_does_not_widen_intervals():
    """Over eight fixed variants the mean is as wide as over equal ones, and q90 is the last's."""
    random = np.random.default_rng(15)
    noise = random.uniform(-0.6, 0.6, (16, 8))
    spread = noise + [40.0, 50.0, 60.0, 70.0, 80.0, 90.0, 98.0, 148.4]
    one, other = analysis.mean(*flatten_draws(noise)), analysis.mean(*flatten_draws(spread))
    assert other.high - other.low == pytest.approx(one.high - one.low)
    runs, draws = flatten_draws(spread)
    found = analysis.quantile(runs, 0.9, draws)
    assert spread[:, -1].min() <= found.low <= found.value <= found.high < spread[:, -1].max()
    # The quantile is the 20 % one of the last variant; 8 of 16 below it have 0.7 % probability.
    assert found.high == np.sort(spread[:, -1])[7]


@pytest.mark.parametrize(("q", "ends"), [(0.1, (1, 2)), (0.5, (5, 6)), (0.9, (9, 10))])
def test_quantile_between_two_constant_variants_is_bounded_by_them(q, ends):
    """The share up to the lower one is q in every draw, which rounding must not decide."""
    runs, draws = flatten_draws(np.tile(np.arange(1.0, 11.0), (16, 1)))
    assert analysis.quantile(runs, q, draws)[:3] == (ends[0], *ends)


@pytest.mark.parametrize("q", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("n", [5, 16, 64])
def test_quantile_of_identical_runs_per_draw_is_that_of_draws(n, q):
    values = np.random.default_rng(n).normal(size=n).round(1)
    values[:2] = math.inf
    runs, draws = flatten_draws(np.repeat(values[:, None], 3, axis=1))
    np.testing.assert_array_equal(
        analysis.quantile(runs, q, draws)[:3], analysis.quantile(values, q)[:3]
    )


def test_one_cluster_has_no_interval():
    values, record = np.random.default_rng(6).normal(size=12), np.zeros(12, dtype=int)
    for found in (
        *(f(values, cluster=record) for f in (analysis.mean, analysis.quantile)),
        analysis.rms(values, record),
        analysis.share(values > 0, record),
        analysis.mean_difference(values, -values, record),
    ):
        assert math.isfinite(found.value) and found.n == 12 and np.isnan(found[1:3]).all()


def test_clusters_are_draws_or_one_whole_record():
    runs = pa.table({"draw_id": [0, 0, 1], "start_s": [0.0, 0.0, 0.0], "x": [1, 2, 3]})
    record = runs.set_column(1, "start_s", pa.array([0.0, 0.0, 30.0]))
    assert analysis.cluster_ids(runs).tolist() == [0, 0, 1]
    assert analysis.cluster_ids(record).tolist() == [0, 0, 0]
    assert analysis.cluster_ids(runs.select(["x"])) is None

import doctest
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import optimize, stats

import sinsjax
from sinsjax import analysis
from sinsjax.analysis import Estimate, estimates, summaries

NEVER = math.inf


@pytest.mark.parametrize(
    ("estimate", "unit", "text"),
    [
        (Estimate(12.31, 11.88, 12.84, 5), "s", "12.3 [11.9, 12.8] s"),
        (Estimate(NEVER, 300.0, NEVER, 5), "s", "never [300.0, never] s"),
        (Estimate(1.0, math.nan, 2.0, 9), "", "1.0 [few draws, 2.0]"),
        (Estimate(1.0, math.nan, math.nan, 1), "s", "1.0 s"),
        (analysis.UNKNOWN, "", "unknown"),
    ],
)
def test_format_estimate_prints_value_interval_and_unit(estimate, unit, text):
    assert analysis.format_estimate(estimate, unit) == text


@pytest.mark.parametrize(
    ("estimate", "text"),
    [
        (Estimate(12.31, 11.88, 12.84, 5), "12.3 [11.9, 12.8] s"),
        (Estimate(NEVER, NEVER, NEVER, 5), "a never settles"),
        (Estimate(-NEVER, -NEVER, -NEVER, 5), "b never settles"),
        (Estimate(-NEVER, -NEVER, -30.0, 5), "b never settles [b never settles, -30.0] s"),
        (Estimate(12.31, -NEVER, 12.84, 5), "12.3 [b never settles, 12.8] s"),
        (Estimate(math.nan, -NEVER, 0.0, 5), "neither settles"),
        (estimates.UNKNOWN, "unknown"),
    ],
)
def test_format_difference_names_side_that_never_settles(estimate, text):
    assert analysis.format_difference(estimate, "s", sides=("a", "b")) == text


@pytest.mark.parametrize(("k", "n"), [(0, 1), (1, 1), (0, 64), (61, 64), (64, 64), (500, 1000)])
def test_proportion_interval_is_clopper_pearson(k, n):
    oracle = stats.binomtest(k, n).proportion_ci(0.95, "exact")
    found = analysis.proportion(k, n)
    assert (found.value, found.n) == (k / n, n)
    assert found[1:3] == pytest.approx((oracle.low, oracle.high), rel=1e-12)


def test_docstring_examples_run():
    names = {"analysis": analysis, "sinsjax": sinsjax}
    for module, least in ((estimates, 4), (summaries, 1)):
        found = doctest.testmod(module, extraglobs=names)
        assert found.failed == 0 and found.attempted >= least


@pytest.mark.parametrize(("k", "n"), [(0, 0), (-1, 4), (5, 4)])
def test_proportion_refuses_invalid_counts(k, n):
    with pytest.raises(ValueError, match="a share needs"):
        analysis.proportion(k, n)


VALUES = st.lists(
    st.floats(-1e3, 1e3) | st.just(math.nan) | st.just(NEVER), min_size=1, max_size=80
)
SHARES = st.sampled_from([0.1, 0.25, 0.5, 0.75, 0.9, 0.95])


@given(VALUES, SHARES)
def test_quantile_is_smallest_value_covering_requested_share(values, q):
    data = sorted(NEVER if math.isnan(v) else v for v in values)
    found = analysis.quantile(values, q)
    assert found.value == next(v for v in data if sum(w <= v for w in data) >= q * len(data) - 1e-9)
    assert found.n == len(data)
    assert math.isnan(found.low) or (found.low in data and found.low <= found.value)
    assert math.isnan(found.high) or (found.high in data and found.value <= found.high)


def binomial_at_most(k, n, q):
    """Return the probability that at most k of n values lie below their quantile q."""
    return sum(math.comb(n, i) * q**i * (1 - q) ** (n - i) for i in range(k + 1))


@pytest.mark.parametrize("n", [1, 2, 5, 6, 8, 13, 16, 33, 64])
@pytest.mark.parametrize("q", [0.1, 0.5, 0.9])
def test_quantile_interval_is_narrowest_allowed_by_binomial_law(n, q):
    values = np.random.default_rng(n).permutation([*np.arange(1.0, n), NEVER])
    ordered, share, tail = sorted(values), Fraction(str(q)), Fraction(25, 1000)
    lows = [k for k in range(1, n + 1) if binomial_at_most(k - 1, n, share) <= tail]
    highs = [k for k in range(1, n + 1) if 1 - binomial_at_most(k - 1, n, share) <= tail]
    found = analysis.quantile(values, q)
    assert found.low == ordered[lows[-1] - 1] if lows else math.isnan(found.low)
    assert found.high == ordered[highs[0] - 1] if highs else math.isnan(found.high)


def test_quantile_counts_unsettled_runs_as_never():
    assert analysis.quantile([math.nan] * 64) == Estimate(NEVER, NEVER, NEVER, 64)
    half = analysis.quantile([10.0] * 32 + [math.nan] * 32)
    assert half == Estimate(10.0, 10.0, NEVER, 64)
    assert analysis.quantile([10.0] * 31 + [math.nan] * 33).value == NEVER


def test_mean_interval_of_symmetric_values_is_student_t():
    half = np.random.default_rng(1).normal(3.0, 2.0, 10)
    values = np.r_[half, 6.0 - half]
    found = analysis.mean(np.append(values, [math.nan, NEVER]))
    oracle = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert found == pytest.approx((values.mean(), oracle.low, oracle.high, 20), rel=1e-12)


def test_mean_interval_ends_at_limits_of_values():
    values = [40.0, 187.0, 334.0]
    free, within = analysis.mean(values), analysis.mean(values, limits=(0.0, 500.0))
    assert free.low < 0.0 and free.high > 500.0
    assert within == (free.value, 0.0, 500.0, 3)
    assert analysis.mean(values, limits=(-1e3, 1e3)) == free


def hall_interval_end(values, end):
    """The end at which Hall's transformation of the studentised mean equals a t quantile."""
    n, skew = len(values), stats.skew(values, bias=False)
    mean, error = np.mean(values), stats.sem(values)
    a = skew / math.sqrt(n)

    def apart(true):
        score = (mean - true) / error
        return score + a * score**2 / 3 + a**2 * score**3 / 27 + a / 6 - stats.t.ppf(end, n - 1)

    return optimize.brentq(apart, mean - 100 * error, mean + 100 * error, xtol=1e-13)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_mean_interval_of_skewed_values_is_wider_on_their_long_side_only(sign):
    values = sign * np.random.default_rng(1).lognormal(0.0, 1.0, 24)
    ends = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    found = analysis.mean(values)
    if sign > 0:
        assert found.low == pytest.approx(ends.low) and found.high > 1.04 * ends.high
        assert found.high == pytest.approx(hall_interval_end(values, 0.025))
    else:
        assert found.high == pytest.approx(ends.high) and found.low < 1.04 * ends.low
        assert found.low == pytest.approx(hall_interval_end(values, 0.975))


def naive_root_interval(squares, value):
    """The interval of the root of a mean square, term by term."""
    n = len(squares)
    mean = sum(squares) / n
    of_mean = sum((x - mean) ** 2 for x in squares) / (n - 1) / n
    relative = n / (n - 2) * of_mean / mean**2
    factor = 1 + relative
    reach = stats.t.ppf(0.975, n - 1) * math.sqrt(relative) * factor
    low, high = (math.log(value**2) + relative + r for r in (-reach, 1.3 * reach))
    return math.exp(low / 2), math.exp(high / 2)


@pytest.mark.parametrize("n", [5, 8, 64])
def test_std_and_rms_intervals_match_naive_loop(n):
    values = np.random.default_rng(n).standard_t(5, n) + 0.5
    found = analysis.rms(values)
    assert found[1:3] == pytest.approx(naive_root_interval([x * x for x in values], found.value))
    found, middle = analysis.std(values), values.mean()
    assert found[1:3] == pytest.approx(
        naive_root_interval([(x - middle) ** 2 for x in values], found.value)
    )


@pytest.mark.parametrize("statistic", [analysis.std, analysis.rms])
def test_std_and_rms_intervals_need_five_values(statistic):
    assert np.isnan(statistic([1.0, 2.0, 4.0, 7.0])[1:3]).all()
    few, scaled = statistic([1.0, -2.0, 4.0, 7.0, 5.0]), statistic([10.0, -20.0, 40.0, 70.0, 50.0])
    assert scaled[:3] == pytest.approx([10 * x for x in few[:3]]) and few.low < few.high


def test_bootstrap_result_is_independent_of_block_size(monkeypatch):
    a, b = np.random.default_rng(2).normal(size=(2, 30))
    whole = analysis.quantile_difference(a, b)
    monkeypatch.setattr(estimates, "_BLOCK", 700)
    assert analysis.quantile_difference(a, b) == whole


def test_constant_values_have_zero_width_interval():
    assert analysis.mean([2.0, 2.0, 2.0]) == Estimate(2.0, 2.0, 2.0, 3)
    assert analysis.std([2.0, 2.0, 2.0]) == Estimate(0.0, 0.0, 0.0, 3)


@pytest.mark.parametrize("values", [[5.0], [math.nan, 5.0], [math.nan]])
def test_mean_interval_and_std_of_too_few_values_are_unknown(values):
    finite = [v for v in values if not math.isnan(v)]
    centre, spread = analysis.mean(values), analysis.std(values)
    assert centre.value == finite[0] if finite else math.isnan(centre.value)
    assert centre.n == spread.n == len(finite)
    assert np.isnan([*centre[1:3], *spread[:3]]).all()


@pytest.mark.parametrize("statistic", [analysis.quantile, analysis.mean, analysis.std])
@pytest.mark.parametrize("values", [[], [[1.0, 2.0]]])
def test_statistics_refuse_empty_or_nested_values(statistic, values):
    with pytest.raises(ValueError, match="one or more values"):
        statistic(values)


@pytest.mark.parametrize(
    "compare",
    [analysis.mean_difference, analysis.quantile_difference, analysis.proportion_difference],
)
def test_differences_refuse_unequal_lengths_or_empty_values(compare):
    with pytest.raises(ValueError, match="equal lengths"):
        compare([1.0, 2.0], [1.0])
    with pytest.raises(ValueError, match="one or more values"):
        compare([], [])


def test_quantile_out_of_range_is_refused():
    with pytest.raises(ValueError):
        analysis.quantile([1.0, 2.0], 1.5)


def test_difference_matches_paired_t_test():
    random = np.random.default_rng(4)
    a, apart = random.normal(size=30), random.normal(0.3, 0.1, 15)
    b = a + np.r_[apart, 0.6 - apart]
    oracle = stats.ttest_rel(b, a).confidence_interval(0.95)
    found = analysis.mean_difference(b, a)
    assert found == pytest.approx(((b - a).mean(), oracle.low, oracle.high, 30), rel=1e-9)
    a[3], b[4] = math.nan, NEVER
    a[5] = b[5] = NEVER
    assert analysis.mean_difference(b, a).n == 27


@pytest.mark.parametrize(
    ("table", "interval"),
    [
        # Fagerland, Lydersen and Laake 2017, tables 8.1 and 8.2 (Bentur 2009, Cavo 2012)
        ((1, 1, 7, 12), (-0.507, -0.026)),
        ((59, 6, 16, 80), (-0.1186, -0.0046)),
        # Altman, Machin, Bryant and Gardner 2000, table 6.2
        ((14, 5, 0, 22), (0.011, 0.226)),
    ],
)
def test_proportion_difference_interval_matches_newcombe_examples(table, interval):
    a = np.repeat([True, True, False, False], table)
    b = np.repeat([True, False, True, False], table)
    found = analysis.proportion_difference(a, b)
    assert (found.value, found.n) == (pytest.approx((table[1] - table[2]) / sum(table)), sum(table))
    digits = 4 if table[0] == 59 else 3
    assert tuple(round(end, digits) for end in found[1:3]) == interval
    swapped = analysis.proportion_difference(b, a)
    assert swapped[:3] == pytest.approx((-found.value, -found.high, -found.low))


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_proportion_difference_of_equal_shares_has_nonzero_width(share):
    same = np.full(64, share)
    found = analysis.proportion_difference(same, same)
    wilson = stats.binomtest(int(64 * share), 64).proportion_ci(0.95, "wilson")
    reach = wilson.high - wilson.low
    assert found[:3] == pytest.approx((0.0, -reach, reach))


def test_quantile_difference_matches_naive_bootstrap():
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


def test_quantile_difference_resamples_pairs_together():
    noise = np.random.default_rng(7).normal(0, 100, 50)
    assert analysis.quantile_difference(noise + 5.0, noise)[:3] == pytest.approx((5.0, 5.0, 5.0))


@pytest.mark.parametrize(("a", "b", "expected"), [(None, 9.0, NEVER), (9.0, None, -NEVER)])
def test_quantile_difference_with_one_unsettled_side_is_infinite(a, b, expected):
    found = analysis.quantile_difference(np.full(20, a, float), np.full(20, b, float))
    assert found == Estimate(expected, expected, expected, 20)


def test_quantile_difference_of_two_unsettled_sides_has_no_value():
    half = np.where(np.arange(20) < 9, 9.0, math.nan)  # one more, and the median is finite
    never = np.full(20, math.nan)
    for a, low in ((never, 0.0), (half, -NEVER)):
        found = analysis.quantile_difference(a, never)
        assert math.isnan(found.value) and (found.low, found.high, found.n) == (low, 0.0, 20)
        assert analysis.format_difference(found) == "neither settles"


def test_quantile_difference_of_one_pair_has_no_interval():
    found = analysis.quantile_difference([3.0], [1.0])
    assert (found.value, found.n) == (2.0, 1)
    assert np.isnan(found[1:3]).all()


def test_rms_matches_root_mean_square_and_interval_covers():
    random = np.random.default_rng(4)
    values = random.normal(size=40)
    found = analysis.rms(values)
    assert found.value == pytest.approx(math.sqrt(np.mean(values**2)))
    assert found.low < found.value < found.high and found.n == 40
    hits = [e.low < 1 < e.high for e in map(analysis.rms, random.normal(size=(400, 40)))]
    assert 0.93 < np.mean(hits) < 1


def test_rms_ignores_non_finite_values():
    values = np.array([3.0, np.nan, 4.0, np.inf])
    assert analysis.rms(values)[::3] == (pytest.approx(math.sqrt(12.5)), 2)
    assert analysis.rms([np.nan]).n == 0 and math.isnan(analysis.rms([2.0]).low)


def test_rms_interval_is_capped_at_largest_possible_value():
    values = [*np.full(9, 30.0), 8000.0]
    free, bound = analysis.rms(values), analysis.rms(values, max_magnitude=10_800.0)
    assert free.high > 1e4 and bound == free._replace(high=10_800.0)
    assert analysis.rms(np.arange(9.0), max_magnitude=100.0) == analysis.rms(np.arange(9.0))
    assert math.isnan(analysis.rms([2.0], max_magnitude=9.0).high)


@pytest.mark.parametrize(("freedom", "n"), [(1, 1), (3, 1), (3, 256), (1, 100_000)])
def test_chi2_mean_band_matches_scipy_quantiles(freedom, n):
    band = analysis.chi2_mean_band(freedom, n)
    assert band == pytest.approx(tuple(stats.chi2.ppf([0.025, 0.975], freedom * n) / n), rel=1e-9)
    assert np.isnan(analysis.chi2_mean_band(freedom, 0)).all()

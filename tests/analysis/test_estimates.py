"""Statistics of independent values and of pairs, against SciPy, worked examples and naive loops."""

import doctest
import math
from fractions import Fraction

import numpy as np
import pytest
from scipy import optimize, stats

import sinsjax
from sinsjax import analysis
from sinsjax.analysis import Estimate, estimates, summaries
from sinsjax.analysis.labels import format_time_difference

NEVER, NAN = math.inf, math.nan
PAIRED = [analysis.mean_difference, analysis.quantile_difference, analysis.proportion_difference]


@pytest.mark.parametrize(
    ("estimate", "text", "as_difference"),
    [
        (Estimate(12.31, 11.88, 12.84, 5), "12 [12, 13]", "12 [12, 13]"),
        (Estimate(NEVER, NEVER, NEVER, 5), "never", "it never settles"),
        (Estimate(-NEVER, -NEVER, 0.0, 5), "-never [-never, 0]", "the first never settles"),
        (Estimate(1.0, NAN, 2.0, 9), "1 [few draws, 2]", "1 [few draws, 2]"),
        (Estimate(1.0, NAN, NAN, 1), "1", "1"),
        (Estimate(NAN, -NEVER, 0.0, 5), "unknown [-never, 0]", "neither settles"),
        (analysis.UNKNOWN, "unknown", "unknown"),
    ],
)
def test_estimates_are_printed_with_interval_and_words(estimate, text, as_difference):
    assert analysis.format_estimate(estimate, digits=0) == text
    assert format_time_difference(estimate) == as_difference


def test_docstring_examples_run():
    names = {"analysis": analysis, "sinsjax": sinsjax}
    for module, least in ((estimates, 3), (summaries, 1)):
        found = doctest.testmod(module, extraglobs=names)
        assert found.failed == 0 and found.attempted >= least


@pytest.mark.parametrize(
    ("statistic", "values", "message"),
    [
        (analysis.quantile, [[]], "one or more values"),
        (analysis.mean, [[[1.0, 2.0]]], "one or more values"),
        (analysis.quantile, [[1.0, 2.0], 1.5], "0 <= q <= 1"),
        (analysis.mean, [[1.0, 2.0, 3.0], [0, 1]], "3 values need as many clusters, got 2"),
        *((compare, [[1.0, 2.0], [1.0]], "equal lengths") for compare in PAIRED),
        *((compare, [[], []], "one or more values") for compare in PAIRED),
    ],
)
def test_unusable_values_are_refused(statistic, values, message):
    with pytest.raises(ValueError, match=message):
        statistic(*values)


@pytest.mark.parametrize(("k", "n"), [(0, 1), (1, 1), (0, 64), (61, 64), (64, 64), (500, 1000)])
def test_share_interval_of_independent_runs_is_clopper_pearson(k, n):
    oracle = stats.binomtest(k, n).proportion_ci(0.95, "exact")
    found = analysis.share(np.arange(n) < k)
    assert (found.value, found.n) == (k / n, n)
    assert found[1:3] == pytest.approx((oracle.low, oracle.high), rel=1e-12)


@pytest.mark.parametrize("n", [1, 2, 5, 6, 8, 13, 16, 33, 64])
@pytest.mark.parametrize("q", [0.1, 0.5, 0.9])
def test_quantile_interval_is_narrowest_allowed_by_binomial_law(n, q):
    values = np.random.default_rng(n).permutation([*np.arange(1.0, n), NAN])
    ordered, share, tail = [*range(1, n), NEVER], Fraction(str(q)), Fraction(25, 1000)

    def at_most(k):
        """Probability that at most k values lie below their quantile."""
        return sum(math.comb(n, i) * share**i * (1 - share) ** (n - i) for i in range(k + 1))

    lows = [k for k in range(1, n + 1) if at_most(k - 1) <= tail]
    highs = [k for k in range(1, n + 1) if 1 - at_most(k - 1) <= tail]
    found = analysis.quantile(values, q)
    assert found.low == ordered[lows[-1] - 1] if lows else math.isnan(found.low)
    assert found.high == ordered[highs[0] - 1] if highs else math.isnan(found.high)
    thrice = analysis.quantile(np.repeat(values, 3), q, np.repeat(np.arange(n), 3))
    np.testing.assert_array_equal(thrice[:3], found[:3])


def test_mean_interval_of_symmetric_values_is_student_t():
    half = np.random.default_rng(1).normal(3.0, 2.0, 10)
    values = np.r_[half, 6.0 - half]
    found = analysis.mean(np.append(values, [NAN, NEVER]))
    oracle = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert found == pytest.approx((values.mean(), oracle.low, oracle.high, 20), rel=1e-12)
    within = analysis.mean(values, limits=(found.low + 0.1, 100.0))
    assert within == pytest.approx((found.value, found.low + 0.1, found.high, 20))


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
    near, far = (found.low, found.high)[:: int(sign)]
    assert near == pytest.approx((ends.low, ends.high)[:: int(sign)][0])
    assert abs(far) > 1.04 * abs((ends.low, ends.high)[:: int(sign)][1])
    assert far == pytest.approx(hall_interval_end(values, 0.025 if sign > 0 else 0.975))


def naive_root_interval(squares, value):
    """The interval of the root of a mean square, term by term."""
    n = len(squares)
    mean = sum(squares) / n
    of_mean = sum((x - mean) ** 2 for x in squares) / (n - 1) / n
    relative = n / (n - 2) * of_mean / mean**2
    reach = stats.t.ppf(0.975, n - 1) * math.sqrt(relative) * (1 + relative)
    low, high = (math.log(value**2) + relative + r for r in (-reach, 1.3 * reach))
    return math.exp(low / 2), math.exp(high / 2)


@pytest.mark.parametrize("n", [5, 8, 64])
def test_rms_interval_matches_naive_loop(n):
    values = np.random.default_rng(n).standard_t(5, n) + 0.5
    rms = analysis.rms(np.append(values, [NAN, NEVER]))
    assert (rms.value, rms.n) == (pytest.approx(math.sqrt(np.mean(values**2))), n)
    assert rms[1:3] == pytest.approx(naive_root_interval(values**2, rms.value))
    assert analysis.rms(values, max_magnitude=rms.high - 0.1).high == rms.high - 0.1


def test_too_few_values_have_no_interval_and_constant_ones_no_width():
    assert np.isnan(analysis.rms([1.0, 2.0, 4.0, 7.0])[1:3]).all()
    assert analysis.mean([2.0, 2.0, 2.0]) == Estimate(2.0, 2.0, 2.0, 3)
    assert analysis.rms([0.0, 0.0, 0.0]) == Estimate(0.0, 0.0, 0.0, 3)
    np.testing.assert_array_equal(analysis.mean([NAN, 5.0]), [5.0, NAN, NAN, 1])
    np.testing.assert_array_equal(analysis.mean([NAN]), [NAN, NAN, NAN, 0])


def test_difference_matches_paired_t_test():
    random = np.random.default_rng(4)
    a, apart = random.normal(size=30), random.normal(0.3, 0.1, 15)
    b = a + np.r_[apart, 0.6 - apart]
    oracle = stats.ttest_rel(b, a).confidence_interval(0.95)
    found = analysis.mean_difference(b, a)
    assert found == pytest.approx(((b - a).mean(), oracle.low, oracle.high, 30), rel=1e-9)
    a[3], b[4] = NAN, NEVER
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


def test_quantile_difference_resamples_pairs_together_and_alike_in_blocks(monkeypatch):
    random = np.random.default_rng(6)
    b = random.uniform(50, 150, 40)
    a = b + random.uniform(0, 30, 40)
    found = analysis.quantile_difference(a, b)
    assert found.low < found.value == np.sort(a)[19] - np.sort(b)[19] < found.high
    monkeypatch.setattr(estimates, "_BLOCK", 700)
    assert analysis.quantile_difference(a, b) == found
    assert analysis.quantile_difference(b + 5.0, b)[:3] == pytest.approx((5.0, 5.0, 5.0))


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ([NAN] * 20, [9.0] * 20, (NEVER, NEVER, NEVER)),
        ([9.0] * 20, [NAN] * 20, (-NEVER, -NEVER, -NEVER)),
        ([NAN] * 20, [NAN] * 20, (NAN, 0.0, 0.0)),
        ([9.0] * 9 + [NAN] * 11, [NAN] * 20, (NAN, -NEVER, 0.0)),  # one more has a median
        ([3.0], [1.0], (2.0, NAN, NAN)),
    ],
)
def test_quantile_difference_with_unsettled_runs(a, b, expected):
    found = analysis.quantile_difference(a, b)
    np.testing.assert_array_equal(found[:3], expected)
    assert found.n == len(a)


def flatten_draws(values):
    """Return values (draws, variants) as runs, with the draw of each."""
    draws = np.broadcast_to(np.arange(len(values))[:, None], np.shape(values))
    return np.ravel(values), draws.ravel()


def test_mean_of_equal_draws_is_student_interval_of_draw_means():
    random = np.random.default_rng(2)
    values = random.normal(size=(16, 1)) + random.normal(0, 0.3, (16, 12))
    runs, draws = flatten_draws(values)
    found, by_draw = analysis.mean(runs, draws), analysis.mean(values.mean(axis=1))
    assert found[:3] == pytest.approx(by_draw[:3]) and found.n == 192
    holed = np.append(runs, [math.inf, math.nan])
    assert analysis.mean(holed, np.append(draws, [0, 99])) == found


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


def test_one_cluster_has_no_interval():
    values, record = np.random.default_rng(6).normal(size=12), np.zeros(12, dtype=int)
    for found in (
        *(f(values, cluster=record) for f in (analysis.mean, analysis.quantile)),
        analysis.rms(values, record),
        analysis.share(values > 0, record),
        analysis.mean_difference(values, -values, record),
    ):
        assert math.isfinite(found.value) and found.n == 12 and np.isnan(found[1:3]).all()

"""Controlled estimates: against plain least squares, and their intervals against repetitions."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from sinsjax import analysis
from sinsjax.analysis.controlled import (
    Expectation,
    controlled_mean,
    controlled_share,
    samples_needed,
)

pytestmark = pytest.mark.slow

FINITE = st.lists(st.floats(-1e3, 1e3), min_size=6, max_size=30)


def pairs(n, correlation, seed=0):
    random = np.random.default_rng(seed)
    x = random.normal(size=(2, n))
    return correlation * x[0] + math.sqrt(1 - correlation**2) * x[1], x[0]


@given(FINITE, st.floats(-10, 10), st.floats(0, 1))
def test_controlled_mean_is_regression_line_at_expectation(x, expected, error):
    x = np.asarray(x)
    y = 2 * x + np.sin(np.arange(x.size))
    if np.ptp(x) < 1e-3:
        return
    found = controlled_mean(y, x, Expectation(expected, error))
    line = stats.linregress(x, y)
    assert found.controlled.value == pytest.approx(line.intercept + line.slope * expected, abs=1e-6)
    assert found.plain == analysis.mean(y)
    residuals = y - line.intercept - line.slope * x
    hidden = 2 * max(y.var(ddof=1), x.var(ddof=1) * 1.0)
    # `linregress` knows no hidden residuals: the interval is at least as wide as its own.
    own = math.sqrt((residuals @ residuals) / (x.size - 2) / x.size)
    assert found.controlled.high - found.controlled.value > 1.9 * own
    assert hidden > 0


def test_controlled_interval_is_student_t_with_two_hidden_residuals():
    y, x = pairs(20, 0.9)
    found = controlled_mean(y, x, Expectation(0.3, 0.1)).controlled
    line = stats.linregress(x, y)
    residuals = y - line.intercept - line.slope * x
    hidden = 2 * max(y.var(ddof=1), x.var(ddof=1))
    variance = (residuals @ residuals + hidden) / 18
    spread = np.sum((x - x.mean()) ** 2)
    error = math.sqrt(variance * (1 / 20 + (x.mean() - 0.3) ** 2 / spread) + line.slope**2 * 0.01)
    assert found.high - found.value == pytest.approx(stats.t.ppf(0.975, 18) * error)
    assert found.value - found.low == pytest.approx(found.high - found.value)


def test_saving_by_control_variates_is_at_most_half_draw_count():
    y, x = pairs(64, 0.9999)
    assert 25 < controlled_mean(y, x, Expectation(0.0)).saved < 32.5
    y, x = pairs(64, 0.0)
    assert 0.8 < controlled_mean(y, x, Expectation(0.0)).saved < 1.0


@pytest.mark.parametrize("rare", [0.0, 0.03])
def test_controlled_interval_covers_mean_with_rare_outliers(rare):
    """Settling times go with their companions, but for a few that settle far apart."""
    random, covered = np.random.default_rng(5), []
    for _ in range(600):
        x = 100 + 30 * random.gamma(2.0, size=64) / math.sqrt(2)
        y = x + np.where(random.random(64) < rare, random.normal(0, 40, 64), 0.0)
        found = controlled_mean(y, x, Expectation(100 + 60 / math.sqrt(2)))
        mean = 100 + 60 / math.sqrt(2)
        covered.append(found.controlled.low <= mean <= found.controlled.high)
    assert np.mean(covered) > 0.93


@pytest.mark.parametrize(("share", "apart"), [(0.9, 0.02), (0.999, 0.0), (0.5, 0.1), (0.05, 0.05)])
def test_controlled_share_interval_covers_true_share(share, apart):
    random, covered, narrower = np.random.default_rng(6), [], []
    for _ in range(600):
        x = random.random(64) < share
        y = x ^ (random.random(64) < apart)
        true = share * (1 - apart) + (1 - share) * apart
        found = controlled_share(y, x, Expectation(share))
        covered.append(found.controlled.low <= true <= found.controlled.high)
        narrower.append(found.saved)
        assert 0 <= found.controlled.low <= found.controlled.value <= found.controlled.high <= 1
    assert np.mean(covered) > 0.93 and np.median(narrower) > 1.0


def test_nonfinite_inputs_give_nan_controlled_mean():
    y, x = pairs(8, 0.5)
    for values, companions, expected in (
        ([*y[:-1], np.nan], x, Expectation(0.0)),
        (y, [*x[:-1], np.inf], Expectation(0.0)),
        (y, x, Expectation(math.nan)),
    ):
        found = controlled_mean(values, companions, expected)
        assert math.isnan(found.controlled.value) and math.isnan(found.saved)
        found = controlled_share(np.asarray(values) > 0, companions, expected)
    constant = controlled_mean(y, np.ones(8), Expectation(1.0))
    assert constant.controlled == constant.plain
    with pytest.raises(ValueError, match="as many companions as values"):
        controlled_mean(y, x[1:], Expectation(0.0))


def test_samples_needed_limits_variance_increase_to_five_percent():
    y, x = pairs(32, 0.95)
    samples = samples_needed(y, x, 0.05)
    error = x.std(ddof=1) / math.sqrt(samples)
    exact, sampled = (
        controlled_mean(y, x, Expectation(float(x.mean()), e)).controlled for e in (0.0, error)
    )
    widths = [one.high - one.low for one in (exact, sampled)]
    assert widths[1] ** 2 == pytest.approx(1.05 * widths[0] ** 2)
    assert samples_needed(y, np.ones(32), 0.05) == 0.0
    assert samples_needed(np.ones(32), x, 0.05) == 0.0

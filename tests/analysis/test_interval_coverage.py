"""Each promised 95 % interval contains the truth in 93 of 100 samples or more (fixed seeds).

Each draw has runs with normal scores that are equally correlated within the draw; an interval's
coverage is the share of samples whose interval contains the true value. An end that is not given
bounds nothing.
"""

import numpy as np
import pytest
from scipy import special

from sinsjax import analysis

LEAST = 93.0  # percent
CORRELATIONS = (0.0, 0.5, 0.8, 0.95, 1.0)
SHARES = (0.5, 0.9, 0.97, 0.99, 1.0)
ESTIMATES = {
    "mean": analysis.mean,
    "rms": analysis.rms,
    "median": lambda runs, draw: analysis.quantile(runs, 0.5, draw),
    "90 % quantile": lambda runs, draw: analysis.quantile(runs, 0.9, draw),
}
NAMES = [*ESTIMATES]


def lognormal(sigma):
    """The exponential of a normal value: values of normal scores, true numbers by `NAMES`."""
    square, q90 = np.exp(sigma**2), np.exp(sigma * special.ndtri(0.9))
    return lambda score: np.exp(sigma * score), [square**0.5, square, 1.0, q90]


def student(freedom):
    """Student's t; normal with infinite degrees of freedom."""
    rms = 1.0 if np.isinf(freedom) else (freedom / (freedom - 2)) ** 0.5
    q90 = float(special.stdtrit(freedom, 0.9))
    return lambda score: special.stdtrit(freedom, special.ndtr(score)), [0.0, rms, 0.0, q90]


LAWS = {
    "normal": (student(np.inf), NAMES),
    "Student's t, 5 degrees": (student(5), NAMES),
    "lognormal, sigma 0.5": (lognormal(0.5), NAMES),
    "lognormal, sigma 1": (lognormal(1.0), NAMES[2:]),
}
"""Distributions, and the estimates whose coverage is promised."""


def covers(found, true):
    return not (found.low > true or found.high < true)


def scores(draws, variants, correlation, repetitions):
    """Samples of normal scores, shape (draws, variants), the same at every call."""
    random = np.random.default_rng([draws, variants, round(100 * correlation)])
    own, shared = (1 - correlation) ** 0.5, correlation**0.5
    for _ in range(repetitions):
        common_part = random.normal(size=(draws, 1))
        yield own * random.normal(size=(draws, variants)) + shared * common_part


@pytest.mark.nightly
@pytest.mark.parametrize("variants", [1, 12, 64])
@pytest.mark.parametrize("draws", [16, 64])
def test_share_intervals_reach_promised_coverage(draws, variants):
    draw = np.repeat(np.arange(draws), variants)
    for correlation in CORRELATIONS if variants > 1 else CORRELATIONS[:1]:
        hits = np.zeros(len(SHARES))
        for sample in scores(draws, variants, correlation, 600):
            below = special.ndtr(sample.ravel())
            hits += [covers(analysis.share(below < true, draw), true) for true in SHARES]
        assert (hits / 6 >= LEAST).all(), (correlation, hits / 6)


@pytest.mark.nightly
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("variants", [1, 12])
def test_intervals_of_values_reach_promised_coverage(law, variants):
    """Of 32 draws: quantiles of any distribution, means and rms of some."""
    draw, ((value, numbers), names) = np.repeat(np.arange(32), variants), LAWS[law]
    truth = dict(zip(NAMES, numbers, strict=True))
    for correlation in CORRELATIONS if variants > 1 else CORRELATIONS[:1]:
        hits = {name: [] for name in names}
        for place, sample in enumerate(scores(32, variants, correlation, 1500)):
            for name in names if place < 188 else names[: len(names) - 2]:  # quantiles take long
                found = ESTIMATES[name](value(sample.ravel()), draw)
                hits[name].append(covers(found, truth[name]))
        for name, hit in hits.items():
            assert 100 * np.mean(hit) >= LEAST, (name, correlation)


@pytest.mark.nightly
@pytest.mark.parametrize("draws", [16, 64])
def test_intervals_of_paired_differences_reach_promised_coverage(draws):
    """Differences of shares, and last of medians, between two variants on the same draws."""
    shares, hits = SHARES[:-1], np.zeros(len(SHARES))
    for sample in scores(draws, 2, 0.8, 300):
        first, second = special.ndtr(sample).T
        hits[:-1] += [
            covers(analysis.proportion_difference(first < true, second < true - 0.01), 0.01)
            for true in shares
        ]
        hits[-1] += covers(analysis.quantile_difference(*sample.T), 0.0)
    assert (hits / 3 >= LEAST).all(), hits / 3

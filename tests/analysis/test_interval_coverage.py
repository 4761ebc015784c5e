"""Each promised 95 % interval contains the truth in 93 of 100 samples or more (fixed seeds).

Each draw has runs with normal scores that are equally correlated within the draw. A cell is a true
value, a correlation, a number of draws and of runs per draw; its coverage is the share of samples
whose interval contains the true value. An end that is not given bounds nothing.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import special

from sinsjax import analysis
from sinsjax.analysis import Estimate

LEAST = 93.0  # percent
CORRELATIONS = (0.0, 0.5, 0.8, 0.95, 1.0)
SHARES = (0.5, 0.9, 0.97, 0.99, 1.0)


class Law(NamedTuple):
    """A distribution of values: values of normal scores, true numbers, and promised means."""

    name: str
    value: Callable[[NDArray], NDArray]
    truth: dict[str, float]
    promised: bool

    @classmethod
    def lognormal(cls, sigma: float, *, promised: bool) -> "Law":
        """The exponential of a normal value of this standard deviation."""
        square = np.exp(sigma**2)
        truth = {"mean": square**0.5, "rms": square, "median": 1.0}
        truth["90 % quantile"] = np.exp(sigma * special.ndtri(0.9))
        name = f"lognormal, sigma {sigma:g}"
        return cls(name, lambda score: np.exp(sigma * score), truth, promised)

    @classmethod
    def student(cls, freedom: float, name: str) -> "Law":
        """Student's t with some degrees of freedom; infinite for the normal distribution."""
        truth = {"mean": 0.0, "rms": 1.0 if np.isinf(freedom) else (freedom / (freedom - 2)) ** 0.5}
        truth |= {"median": 0.0, "90 % quantile": float(special.stdtrit(freedom, 0.9))}
        return cls(name, lambda score: special.stdtrit(freedom, special.ndtr(score)), truth, True)


LAWS = (
    Law.student(np.inf, "normal"),
    Law.student(5, "Student's t, 5 degrees"),
    Law.lognormal(0.5, promised=True),
    Law.lognormal(1.0, promised=False),
)
NUMBERS: dict[str, tuple[Callable[[NDArray, NDArray], Estimate], float]] = {
    "mean": (analysis.mean, 1.0),
    "rms": (analysis.rms, 1.0),
    "median": (lambda runs, draw: analysis.quantile(runs, 0.5, draw), 0.125),
    "90 % quantile": (lambda runs, draw: analysis.quantile(runs, 0.9, draw), 0.125),
}
"""Estimates of runs and their draws, and the share of repetitions, fewer for what takes long."""


def covers(found: Estimate, true: float) -> bool:
    """Whether an interval contains a value; an end that is NaN bounds nothing."""
    return not (found.low > true or found.high < true)


def scores(draws: int, variants: int, correlation: float, repetitions: int) -> Iterator[NDArray]:
    """Samples of normal scores, shape (draws, variants), the same at every call."""
    random = np.random.default_rng([draws, variants, round(100 * correlation)])
    own, shared = (1 - correlation) ** 0.5, correlation**0.5
    for _ in range(repetitions):
        common_part = random.normal(size=(draws, 1))
        yield own * random.normal(size=(draws, variants)) + shared * common_part


@pytest.mark.nightly
@pytest.mark.parametrize("variants", [1, 12, 64])
@pytest.mark.parametrize("draws", [16, 64])
def test_share_intervals_reach_promised_coverage(draws: int, variants: int) -> None:
    draw = np.repeat(np.arange(draws), variants)
    for correlation in CORRELATIONS if variants > 1 else CORRELATIONS[:1]:
        hits = np.zeros(len(SHARES))
        for sample in scores(draws, variants, correlation, 600):
            below = special.ndtr(sample.ravel())
            hits += [covers(analysis.share(below < true, draw), true) for true in SHARES]
        assert (hits / 6 >= LEAST).all(), (correlation, hits / 6)


@pytest.mark.nightly
@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
@pytest.mark.parametrize("variants", [1, 12])
def test_intervals_of_values_reach_promised_coverage(law: Law, variants: int) -> None:
    """Of 32 draws: quantiles of any distribution, means and rms of some."""
    draw, repetitions = np.repeat(np.arange(32), variants), 1500
    names = NUMBERS if law.promised else ("median", "90 % quantile")
    promised = {name: NUMBERS[name] for name in names}
    for correlation in CORRELATIONS if variants > 1 else CORRELATIONS[:1]:
        hits = dict.fromkeys(promised, 0)
        for place, sample in enumerate(scores(32, variants, correlation, repetitions)):
            runs = law.value(sample.ravel())
            for name, (estimate, part) in promised.items():
                if place < part * repetitions:
                    hits[name] += covers(estimate(runs, draw), law.truth[name])
        for name, hit in hits.items():
            percent = 100 * hit / np.ceil(promised[name][1] * repetitions)
            assert percent >= LEAST, (name, correlation, percent)


@pytest.mark.nightly
@pytest.mark.parametrize("draws", [16, 64])
def test_intervals_of_paired_differences_reach_promised_coverage(draws: int) -> None:
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

"""Each promised 95 % interval contains the truth in 93 of 100 samples or more (fixed seeds).

Each draw has runs with normal scores that are equally correlated within the draw. A cell is a true
value, a correlation, a number of draws and of runs per draw; its coverage is the share of samples
whose interval contains the true value. An end that is not given bounds nothing.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import special

from sinsjax import analysis
from sinsjax.analysis import Estimate

LEAST = 93.0  # percent
VARIANTS = (1, 12, 64)
CORRELATIONS = (0.0, 0.5, 0.8, 0.95, 1.0)
SHARES = (0.5, 0.9, 0.97, 0.99, 1.0)

Interval = Callable[[NDArray, NDArray], Estimate]
"""The estimate of some runs, from their values and their draws."""


class Law(NamedTuple):
    """A distribution of values, by the transformation of a normal score.

    Attributes:
        name: name in the table.
        value: values of normal scores.
        truth: true values by the name of a number.
        promised: whether 93 % is promised for means and rms.
    """

    name: str
    value: Callable[[NDArray], NDArray]
    truth: dict[str, float]
    promised: bool

    @classmethod
    def lognormal(cls, sigma: float, *, promised: bool) -> "Law":
        """The exponential of a normal value of this standard deviation."""
        square = np.exp(sigma**2)
        truth = {
            "mean": square**0.5,
            "rms": square,
            "standard deviation": (square * (square - 1)) ** 0.5,
            "median": 1.0,
            "90 % quantile": np.exp(sigma * special.ndtri(0.9)),
        }
        name = f"lognormal, sigma {sigma:g}"
        return cls(name, lambda score: np.exp(sigma * score), truth, promised)

    @classmethod
    def student(cls, freedom: float, name: str, *, promised: bool) -> "Law":
        """Student's t with some degrees of freedom; infinite for the normal distribution."""
        spread = 1.0 if np.isinf(freedom) else (freedom / (freedom - 2)) ** 0.5
        truth = {
            "mean": 0.0,
            "rms": spread,
            "standard deviation": spread,
            "median": 0.0,
            "90 % quantile": float(special.stdtrit(freedom, 0.9)),
        }
        return cls(
            name, lambda score: special.stdtrit(freedom, special.ndtr(score)), truth, promised
        )


class Number(NamedTuple):
    """A number whose interval is measured.

    Attributes:
        of: its estimate.
        from_draws: number of draws from which on 93 % is promised; infinite if it is not.
        any_law: whether that holds for any distribution.
        part: share of the repetitions, fewer for what takes long.
    """

    of: Interval
    from_draws: float
    any_law: bool = False
    part: float = 1.0


LAWS = (
    Law.student(np.inf, "normal", promised=True),
    Law.student(5, "Student's t, 5 degrees", promised=True),
    Law.lognormal(0.5, promised=True),
    Law.lognormal(1.0, promised=False),
)
NUMBERS = {
    "mean": Number(analysis.mean, 32),
    "rms": Number(analysis.rms, 32),
    "standard deviation": Number(analysis.std, np.inf),
    "median": Number(lambda runs, draw: analysis.quantile(runs, 0.5, draw), 16, True, 0.125),
    "90 % quantile": Number(lambda runs, draw: analysis.quantile(runs, 0.9, draw), 16, True, 0.125),
}
PAIR_CORRELATION = 0.8


class Cell(NamedTuple):
    """The coverage of one cell.

    Attributes:
        name: number and distribution, or true share.
        draws: number of draws.
        variants: runs per draw.
        correlation: of the scores of a draw.
        percent: coverage.
        promised: whether it must not be below `LEAST`.
    """

    name: str
    draws: int
    variants: int
    correlation: float
    percent: float
    promised: bool


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


def correlations(variants: int) -> Sequence[float]:
    """Correlations to measure; a single run per draw has none."""
    return CORRELATIONS if variants > 1 else CORRELATIONS[:1]


def of_shares(draws: int, variants: int, repetitions: int) -> Iterator[Cell]:
    """Coverage of shares."""
    draw = np.repeat(np.arange(draws), variants)
    for correlation in correlations(variants):
        hits = np.zeros(len(SHARES))
        for sample in scores(draws, variants, correlation, repetitions):
            below = special.ndtr(sample.ravel())
            hits += [covers(analysis.share(below < true, draw), true) for true in SHARES]
        for true, hit in zip(SHARES, hits, strict=True):
            percent = 100 * hit / repetitions
            yield Cell(f"{true:g}", draws, variants, correlation, percent, draws >= 16)


def of_values(
    draws: int, variants: int, repetitions: int, laws: Sequence[Law] = LAWS
) -> Iterator[Cell]:
    """Coverage of numbers of values with some distributions."""
    draw = np.repeat(np.arange(draws), variants)
    for correlation in correlations(variants):
        hits = np.zeros((len(laws), len(NUMBERS)))
        for place, sample in enumerate(scores(draws, variants, correlation, repetitions)):
            for law, hit in zip(laws, hits, strict=True):
                runs = law.value(sample.ravel())
                hit += [
                    place < number.part * repetitions
                    and covers(number.of(runs, draw), law.truth[name])
                    for name, number in NUMBERS.items()
                ]
        for law, hit in zip(laws, hits, strict=True):
            for (name, number), found in zip(NUMBERS.items(), hit, strict=True):
                percent = 100 * found / np.ceil(number.part * repetitions)
                promised = draws >= number.from_draws and (number.any_law or law.promised)
                title = f"{name}, {law.name}"
                yield Cell(title, draws, variants, correlation, percent, promised)


def of_pairs(draws: int, repetitions: int) -> Iterator[Cell]:
    """Coverage of differences between two variants on the same draws."""
    shares = SHARES[:-1]
    hits, median = np.zeros(len(shares)), 0
    for sample in scores(draws, 2, PAIR_CORRELATION, repetitions):
        first, second = special.ndtr(sample).T
        hits += [
            covers(analysis.proportion_difference(first < true, second < true - 0.01), 0.01)
            for true in shares
        ]
        median += covers(analysis.quantile_difference(*sample.T), 0.0)
    names = [f"difference of shares, {true:g}" for true in shares]
    for name, hit in zip([*names, "difference of medians"], [*hits, median], strict=True):
        yield Cell(name, draws, 2, PAIR_CORRELATION, 100 * hit / repetitions, draws >= 16)


@pytest.mark.nightly
@pytest.mark.parametrize("variants", VARIANTS)
@pytest.mark.parametrize("draws", [16, 64])
def test_share_intervals_reach_promised_coverage(draws, variants):
    cells = list(of_shares(draws, variants, 600))
    assert all(cell.promised for cell in cells)
    assert min(cell.percent for cell in cells) >= LEAST, cells


@pytest.mark.nightly
@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
@pytest.mark.parametrize("variants", [1, 12])
def test_intervals_of_values_reach_promised_coverage(law, variants):
    cells = [cell for cell in of_values(32, variants, 1500, [law]) if cell.promised]
    names = {cell.name.partition(",")[0] for cell in cells}
    assert names == {"median", "90 % quantile"} | ({"mean", "rms"} if law.promised else set())
    assert min(cell.percent for cell in cells) >= LEAST, cells


@pytest.mark.nightly
@pytest.mark.parametrize("draws", [16, 64])
def test_intervals_of_paired_differences_reach_promised_coverage(draws):
    cells = list(of_pairs(draws, 300))
    assert min(cell.percent for cell in cells) >= LEAST, cells

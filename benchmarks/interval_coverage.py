"""How often the 95 % intervals of `sinsjax.analysis` contain the true value, cell by cell.

Each draw has runs with normal scores that are equally correlated within the draw. A cell is a true
value, a correlation, a number of draws and of runs per draw; its coverage is the share of samples
whose interval contains the true value. An end that is not given bounds nothing. A table shows the
lowest coverage over the correlations, so that no cell hides behind another. The exit code is 1 if a
cell is below 93 % that `docs/statistics.md` promises.
"""

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import common
import numpy as np
from numpy.typing import NDArray
from scipy import special

import sinsjax
from sinsjax import analysis
from sinsjax.analysis import Estimate
from sinsjax.bench.timing import Row, measurement_conditions

REPETITIONS = 4000
LEAST = 93.0  # percent
DRAWS = (8, 16, 32, 64)
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


def lowest(
    cells: Sequence[Cell], row: Callable[[Cell], Row], column: Callable[[Cell], str]
) -> list[Row]:
    """Rows of the lowest coverage over all cells that share a row and a column, percent."""
    found: dict[tuple, Row] = {}
    for cell in cells:
        keys = row(cell)
        mine = found.setdefault(tuple(keys.values()), keys)
        percent = round(cell.percent, 1)
        mine[column(cell)] = min(percent, mine.get(column(cell), percent))
    return list(found.values())


def measure(quick: bool, repetitions: int) -> tuple[list[Cell], list[Cell], list[Cell]]:
    """The cells of shares, of values and of pairs."""
    draws = DRAWS[:2] if quick else DRAWS
    variants = VARIANTS[:2] if quick else VARIANTS
    laws = LAWS[2:3] if quick else LAWS
    sizes = [(n, m) for n in draws for m in variants]
    return (
        [cell for size in sizes if size[0] != 32 for cell in of_shares(*size, repetitions)],
        [cell for size in sizes for cell in of_values(*size, repetitions, laws)],
        [cell for n in draws for cell in of_pairs(n, repetitions)],
    )


def main() -> None:
    """Measure and print; no timing, so it is no set of the history."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="one JSON object a line, for each cell")
    parser.add_argument("--quick", action="store_true", help="tiny sizes: does it work?")
    parser.add_argument("--repetitions", type=int, default=REPETITIONS, help="samples per cell")
    flags = parser.parse_args()
    sinsjax.configure()
    shares, values, pairs = measure(flags.quick, 20 if flags.quick else flags.repetitions)
    every = [*shares, *values, *pairs]
    if flags.json:
        common.show([cell._asdict() for cell in every], measurement_conditions(), as_json=True)
    else:
        tables = (
            lowest(shares, lambda c: {"draws_": c.draws, "per_draw": c.variants}, lambda c: c.name),
            lowest(
                sorted(values, key=lambda c: [*NUMBERS].index(c.name.partition(",")[0])),
                lambda c: {"name": c.name, "draws_": c.draws},
                lambda c: f"{c.variants} per draw",
            ),
            lowest(pairs, lambda c: {"name": c.name}, lambda c: f"{c.draws} draws"),
        )
        for table in tables:
            common.show(table, measurement_conditions(), as_json=False)
    failed = [cell for cell in every if cell.promised and cell.percent < LEAST]
    if failed and not flags.quick:
        for cell in failed:
            print(f"below {LEAST:g} %: {cell}", file=sys.stderr)
        raise SystemExit(1)


if __name__ == "__main__":
    main()

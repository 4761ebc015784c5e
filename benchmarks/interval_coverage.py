"""What the 95 % intervals of `sinsjax.analysis` cover, by estimator, population and sample size.

A population is known, so its true numbers are: samples of n are taken from it many times, and it is
counted how often the interval holds the truth. An end that is not given bounds nothing. The
empirical populations are draws of shipped studies, which the script runs itself.
"""

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import common
import numpy as np
from numpy.typing import NDArray
from scipy import special, stats

import sinsjax
from sinsjax import analysis
from sinsjax.analysis import Estimate
from sinsjax.analysis.estimates import bootstrap, place
from sinsjax.bench.timing import Row, conditions
from sinsjax.study.load import one_variant

SIZES = (8, 13, 16, 32, 64)
REPETITIONS = 2000
DRAWS = 4096
VARIANTS = 12
"""Runs of a draw where variants are pooled."""

STUDIES: dict[str, dict[str, Any]] = {
    "consistency": {"case": "Q as the noise"},
    "kalman_passes": {"phi_u0_deg": 1.5, "turn_covariance": "carried", "passes": 1},
    "reset_cycle_study": {
        "specific_force": "measured",
        "q_reading": "per_sample",
        "feedback_interval_s": 10,
        "phi_e0_deg": 20,
        "phi_u0_deg": 60,
        "reset_times_s": (300.0,),
    },
}
"""Shipped studies and the variant that is taken; of the last one two thirds of the runs diverge."""

SHARES = ("share, Wilson", "share by draw, 12 runs each", "difference of paired shares, Newcombe")
PAIRS = ("difference of paired medians, bootstrap", "ratio of paired medians, bootstrap")
BY_DRAW = tuple(f"{name} by draw, 12 runs each" for name in ("mean", "median", "90 %", "rms"))


class Population(NamedTuple):
    """A population of known numbers.

    Attributes:
        name: of it.
        sample: (random, shape) to values.
        truth: of a statistic's name.
        only_noise: whether it is normal by its making.
    """

    name: str
    sample: Callable[[np.random.Generator, tuple[int, ...]], NDArray]
    truth: Mapping[str, float]
    only_noise: bool = False


class Estimator(NamedTuple):
    """An interval.

    Attributes:
        name: in the table.
        of: the estimate of a sample (n,).
        truth: which number of the population it tells.
        is_used: whether reports print it; others stand beside it.
    """

    name: str
    of: Callable[[NDArray], Estimate]
    truth: str
    is_used: bool = True


def _std(values: NDArray) -> NDArray:
    return np.std(values, axis=-1, ddof=1)


def _rms(values: NDArray) -> NDArray:
    return np.sqrt(np.mean(values**2, axis=-1))


def percentile(statistic: Callable[..., NDArray]) -> Callable[[NDArray], Estimate]:
    """The percentile interval of the bootstrap."""
    return lambda x: Estimate(0.0, *bootstrap(statistic, x), x.size)


def bca(statistic: Callable[..., NDArray]) -> Callable[[NDArray], Estimate]:
    """SciPy's BCa interval."""

    def of(x: NDArray) -> Estimate:
        found = stats.bootstrap(
            (x,),
            lambda values, axis: statistic(np.moveaxis(values, axis, -1)),
            n_resamples=1000,
            rng=np.random.default_rng(0),
        ).confidence_interval
        return Estimate(0.0, float(found.low), float(found.high), x.size)

    return of


USED = (
    Estimator("mean, Student", analysis.mean, "mean"),
    Estimator("median, order statistics", analysis.quantile, "median"),
    Estimator("90 % quantile, order statistics", lambda x: analysis.quantile(x, 0.9), "q90"),
    Estimator("std, logarithmic", analysis.std, "std"),
    Estimator("rms, logarithmic", analysis.rms, "rms"),
)
OF_NOISE = Estimator("std of noise, chi-square", lambda x: analysis.std(x, is_normal=True), "std")
BESIDE = (
    Estimator("mean, percentile bootstrap", percentile(lambda x: x.mean(-1)), "mean", False),
    Estimator("std, percentile bootstrap", percentile(_std), "std", False),
    Estimator("std, BCa", bca(_std), "std", False),
    Estimator("rms, percentile bootstrap", percentile(_rms), "rms", False),
    Estimator("rms, BCa", bca(_rms), "rms", False),
)


def made() -> list[Population]:
    """The populations that are laws: normal, and Student's t with 5 degrees of freedom."""
    laws = {"normal": stats.norm(), "t, 5 degrees": stats.t(5, scale=0.6**0.5)}
    return [
        Population(
            name,
            lambda random, shape, law=law: law.ppf(random.random(shape)),  # type: ignore[misc]
            {
                "mean": 0.0,
                "median": 0.0,
                "q90": float(law.ppf(0.9)),
                "std": float(law.std()),
                "rms": float(law.std()),
            },
            only_noise=name == "normal",
        )
        for name, law in laws.items()
    ]


def drawn(name: str, values: NDArray) -> Population:
    """A population of given values, each as likely as the others."""
    ordered = np.sort(values)
    truth = {
        "mean": float(values.mean()),
        "median": float(ordered[place(values.size, 0.5)]),
        "q90": float(ordered[place(values.size, 0.9)]),
        "std": float(values.std()),
        "rms": float(_rms(values)),
    }
    return Population(name, lambda random, shape: random.choice(values, shape), truth)


def empirical(draws: int) -> Iterator[Population]:
    """Window means of the heading error over many draws of shipped studies."""
    for name, wanted in STUDIES.items():
        whole = sinsjax.load_study(common.ROOT / f"configs/{name}.toml")
        times = [tuple(resets) for resets in whole.reset_times()]
        values = whole.variant_values() | {"reset_times_s": times}
        study = one_variant(
            whole,
            next(
                variant
                for variant in range(whole.n_variants)
                if all(values[key][variant] == value for key, value in wanted.items())
            ),
        )
        settings = study.study.model_copy(update={"draws": draws, "curves": False})
        table = sinsjax.run(study.model_copy(update={"study": settings})).summary
        statuses = table["status"].value_counts().to_pylist()
        told = ", ".join(f"{100 * s['counts'] / draws:.0f} % {s['values']}" for s in statuses)
        errors = analysis.numbers(table, "phi_u_mean_arcmin")
        yield drawn(f"{name} ({told})", errors[np.isfinite(errors)])


def covers(found: Estimate, true: float) -> bool:
    """Whether an interval holds a number; an end that is NaN bounds nothing."""
    return not (found.low > true or found.high < true)


def coverage(
    estimator: Estimator, population: Population, n: int, repetitions: int = REPETITIONS
) -> float:
    """Share of samples whose interval holds the truth, the same at every call."""
    random = np.random.default_rng([n, len(population.name)])
    true = population.truth[estimator.truth]
    samples = population.sample(random, (repetitions, n))
    return float(np.mean([covers(estimator.of(x), true) for x in samples]))


def of_shares(n: int, repetitions: int = REPETITIONS) -> dict[str, float]:
    """Coverage of the intervals of shares, averaged over shares of 0.02 to 0.98.

    Runs of a draw are alike by half: their scores have a correlation of 0.5. Pairs share four
    fifths of their variance.
    """
    random = np.random.default_rng([n, 1])
    hits: dict[str, list[bool]] = {name: [] for name in SHARES}
    for share in np.tile(np.linspace(0.02, 0.98, 25), -(-repetitions // 25))[:repetitions]:
        below = special.ndtri(share)
        flags = random.normal(size=n) < below
        hits[SHARES[0]].append(covers(analysis.proportion(int(flags.sum()), n), share))
        common_part = random.normal(size=(n, 1))
        scores = np.sqrt(0.5) * (common_part + random.normal(size=(n, VARIANTS)))
        draws = np.repeat(np.arange(n), VARIANTS)
        hits[SHARES[1]].append(covers(analysis.share(scores.ravel() < below, draws), share))
        pair = np.sqrt(0.8) * common_part + np.sqrt(0.2) * random.normal(size=(n, 2))
        other = special.ndtri(max(share - 0.01, 0.01))
        found = analysis.proportion_difference(pair[:, 0] < below, pair[:, 1] < other)
        hits[SHARES[2]].append(covers(found, share - max(share - 0.01, 0.01)))
    return {name: float(np.mean(found)) for name, found in hits.items()}


def of_pairs(population: Population, n: int, repetitions: int = REPETITIONS) -> dict[str, float]:
    """Coverage of what compares medians of runs that share their noise: four fifths of it."""
    random = np.random.default_rng([n, 2])
    hits: dict[str, list[bool]] = {name: [] for name in PAIRS}

    def ratio(x: NDArray, y: NDArray) -> NDArray:
        at = place(n, 0.5)
        return np.partition(x, at)[..., at] / np.partition(y, at)[..., at]

    for _ in range(repetitions):
        shared, *own = population.sample(random, (3, n)) / population.truth["std"]
        a, b = (np.sqrt(0.8) * shared + np.sqrt(0.2) * one for one in own)
        hits[PAIRS[0]].append(covers(analysis.quantile_difference(a, b), 0.0))
        low, high = bootstrap(ratio, np.exp(a / 4), np.exp(b / 4))
        hits[PAIRS[1]].append(low <= 1.0 <= high)
    return {name: float(np.mean(found)) for name, found in hits.items()}


def by_draw(n: int, repetitions: int = REPETITIONS) -> dict[str, float]:
    """Coverage of means and quantiles where n draws have 12 runs each, alike by half."""
    random = np.random.default_rng([n, 3])
    draws = np.repeat(np.arange(n), VARIANTS)
    hits: dict[str, list[bool]] = {name: [] for name in BY_DRAW}
    for _ in range(repetitions):
        own, shared = random.normal(size=(n, VARIANTS)), random.normal(size=(n, 1))
        runs = (np.sqrt(0.5) * (own + shared)).ravel()
        found = (
            analysis.mean(runs, draws),
            analysis.quantile(runs, 0.5, draws),
            analysis.quantile(runs, 0.9, draws),
            analysis.rms(runs, draws),
        )
        truths = (0.0, 0.0, float(special.ndtri(0.9)), 1.0)
        for name, one, true in zip(BY_DRAW, found, truths, strict=True):
            hits[name].append(covers(one, true))
    return {name: float(np.mean(found)) for name, found in hits.items()}


def rows(quick: bool, repetitions: int, draws: int) -> list[Row]:
    """Measure the coverage of every estimator; on shipped studies, of those in use.

    Returns:
        A row an estimator and population: ``coverage`` in percent by n.
    """
    sizes: Sequence[int] = SIZES[::4] if quick else SIZES
    repetitions = min(repetitions, 20) if quick else repetitions
    laws = made()

    def row(name: str, population: str, found: Mapping[int, float]) -> Row:
        return {"name": name, "population": population} | {
            f"n = {n}": round(100 * share, 1) for n, share in found.items()
        }

    told = []
    for population in (*laws, *empirical(32 if quick else draws)):
        fitting = [OF_NOISE] if population.only_noise else []
        for one in (*USED, *fitting, *(BESIDE if population in laws else ())):
            each = {n: coverage(one, population, n, repetitions) for n in sizes}
            name = one.name if one.is_used else f"{one.name} (not in use)"
            told.append(row(name, population.name, each))
    for population in laws:
        paired = {n: of_pairs(population, n, repetitions) for n in sizes}
        told += [row(k, population.name, {n: paired[n][k] for n in sizes}) for k in PAIRS]
    for names, measure in ((SHARES, of_shares), (BY_DRAW, by_draw)):
        found = {n: measure(n, repetitions) for n in sizes}
        told += [row(name, "-", {n: found[n][name] for n in sizes}) for name in names]
    return told


def main() -> None:
    """Measure and print; no timing, so it is no set of the history."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="one JSON object a line")
    parser.add_argument("--quick", action="store_true", help="tiny sizes: does it work?")
    parser.add_argument("--repetitions", type=int, default=REPETITIONS, help="samples a number")
    parser.add_argument("--draws", type=int, default=DRAWS, help="draws of a shipped study")
    flags = parser.parse_args()
    sinsjax.configure()
    told = rows(flags.quick, flags.repetitions, flags.draws)
    common.show(told, conditions(), as_json=flags.json)


if __name__ == "__main__":
    main()

"""The verdict on a sweep: the best option, what it gains, how accurate it is, and what limits it.

A choice is judged on draws that did not make it. See `sinsjax.report.choices`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.analysis import Estimate, format_estimate
from sinsjax.analysis.words import heading, percent
from sinsjax.columns import FAILED
from sinsjax.execution import stopping
from sinsjax.execution.source import Source
from sinsjax.messages import counted
from sinsjax.report.base import ENOUGH_DRAWS, Fact, Table, Verdict
from sinsjax.report.choices import (
    LEAST_DRAWS,
    Choices,
    choose,
    choose_by_halves,
    name_and_unit,
)
from sinsjax.report.markup import said
from sinsjax.study.process_noise import noise_ratios_by_sensor
from sinsjax.study.success import FLOOR_COLUMNS, SuccessMeasure

_MOST_Q = 10.0  # times the sensors' noise that Q may be before the verdict cautions
_LIMITING = 0.7  # share of the rms error from which the bias floor is its cause
_RARE = 0.1  # of the successful runs: so many may be at the edge of both bands


def verdict(source: Source, *, warned: bool = False) -> Verdict:
    """Return the verdict on a simulated study, or on a recorded one with a reference.

    Args:
        source: the results; some run has a truth.
        warned: whether the user has seen the study's warnings.
    """
    outcome = Outcome.from_source(source)
    doubts = [*warnings_of(source, warned=warned), *doubts_of(outcome)]
    return Verdict(title_of(source), [*answer(outcome), *doubts], per_condition(outcome))


@dataclass(frozen=True)
class Outcome:
    """The runs of a study over its options, conditions and draws.

    Attributes:
        source: the results.
        choices: the options and conditions.
        yard: the criterion of success.
        time_s: (options, conditions, draws) settling times, infinite for runs without success, s.
        error: (options, conditions, draws) heading error from the truth at the end, arcmin.
        floor: (options, conditions, draws) bias floor, arcmin; NaN if there is none.
        off_floor: (options, conditions, draws) successes outside the band about the bias floor.
    """

    source: Source
    choices: Choices
    yard: SuccessMeasure
    time_s: NDArray
    error: NDArray
    floor: NDArray
    off_floor: NDArray

    @classmethod
    def from_source(cls, source: Source) -> "Outcome":
        """Read the columns of the summary that a verdict needs."""
        yards = source.success_measures
        table = source.rows(
            [*FLOOR_COLUMNS, *(n for y in yards for n in (y.ok_column, y.settle_column))]
        )
        # A criterion that some method does not have cannot compare the methods.
        yard = next((one for one in yards if table[one.ok_column].null_count == 0), yards[0])
        choices = Choices.from_study(source.study)

        def column(name: str) -> NDArray:
            return choices.runs(analysis.numbers(table, name))

        settle_s = np.where(column(yard.ok_column) > 0, column(yard.settle_column), np.inf)
        time_s = np.where(np.isnan(settle_s), np.inf, settle_s)
        error, floor = (column(name) for name in FLOOR_COLUMNS)
        return cls(source, choices, yard, time_s, error, floor, yard.outside_floor_band(column))

    @property
    def draws(self) -> int:
        """Number of draws, or of start times on a record."""
        return int(self.time_s.shape[-1])

    @cached_property
    def longest_s(self) -> float:
        """What a run that never settles counts when options are ranked, s."""
        return max(self.source.study.run_s, np.max(self.time_s, initial=0, where=self.settled))

    @property
    def settled(self) -> NDArray:
        """(options, conditions, draws) whether a run settles."""
        return np.isfinite(self.time_s)

    def best(self, options: Sequence[int] | None = None) -> "Choice":
        """Choose among some options, or among all."""
        wanted = np.arange(len(self.time_s)) if options is None else np.asarray(options)
        time_s = self.time_s[wanted]
        return Choice(
            int(wanted[choose(time_s, self.longest_s)]),
            wanted[choose_by_halves(time_s, self.longest_s)],
        )

    @property
    def best_variant(self) -> int:
        """The number of the best option's variant in the last condition."""
        return int(self.choices.variants[self.overall.option, -1])

    @cached_property
    def overall(self) -> "Choice":
        """The best of all options."""
        return self.best()

    def at(self, conditions: Sequence[int]) -> "Outcome":
        """The same in some conditions."""
        names = ("time_s", "error", "floor", "off_floor")
        return replace(self, **{name: getattr(self, name)[:, conditions] for name in names})

    def judged(self, choice: "Choice", values: NDArray) -> NDArray:
        """Values (options, conditions, draws) with the option chosen for each draw, flat."""
        return values[choice.places, :, np.arange(self.draws)].ravel()

    @property
    def cluster(self) -> NDArray:
        """The cluster of each of the values of `judged`."""
        draw = np.zeros if self.source.study.is_recorded else np.arange
        return np.repeat(draw(self.draws).astype(int), self.time_s.shape[1])

    def success(self, choice: "Choice") -> Estimate:
        """The share of runs that settle with a choice."""
        return analysis.share(np.isfinite(self.judged(choice, self.time_s)), self.cluster)

    def mean_s(self, choice: "Choice") -> Estimate:
        """The mean settling time of the runs that settle with a choice, s; never below 0."""
        found = analysis.mean(self.judged(choice, self.time_s), self.cluster)
        return found._replace(low=max(found.low, 0.0))

    def short(self, choice: "Choice", unit: str = "") -> str:
        """Settling with a choice in a few words: a mean time, ``never``, or how many settle."""
        settled = np.isfinite(self.judged(choice, self.time_s))
        if settled.all():
            return format_estimate(self.mean_s(choice), unit, 0)
        return f"{percent(self.success(choice))} % settle" if settled.any() else "never"


class Choice(NamedTuple):
    """The best of some options.

    Attributes:
        option: the best according to all draws, which names it.
        places: (draws,) the option that judges each draw, chosen by other draws.
    """

    option: int
    places: NDArray


def title_of(source: Source) -> str:
    """The name of a study, how many runs it has, how long they took, and how many failed."""
    study, runs = source.study, source.runs
    count = counted(runs, "run")
    if source.whole_draws is not None:
        count = f"unfinished, {runs:,} of {study.n_draws * study.n_variants:,} runs"
    if source.wall_s is not None:
        count += f" in {source.wall_s:,.{0 if source.wall_s > 9 else 1}f} s"
    kept = len({*study.duplicate_of}) * runs // study.n_variants
    count += f" ({kept:,} distinct)" if kept < runs else ""
    status = source.rows(["status"])
    failed = sum(int(analysis.has_status(status, one).sum()) for one in FAILED)
    return f"{study.name}: {count}, {f'{failed:,}' if failed else 'none'} failed"


def warnings_of(source: Source, *, warned: bool) -> Iterator[Fact]:
    """The warnings of a study, unless the user has seen them."""
    yield from (Fact("Warning", line, True) for line in (() if warned else source.warnings))


def q_doubt(source: Source) -> Iterator[Fact]:
    """A caution if the filter's Q is far larger than the noise of the sensors."""
    if source.study.is_recorded:
        return
    ratios = [ratio for found in noise_ratios_by_sensor(source.study).values() for ratio in found]
    most = max(ratios, default=0.0)
    if most > _MOST_Q:
        which = "Q" if min(ratios) > _MOST_Q else "Q of some variants"
        yield Fact(
            "Caution",
            f"{which} is {float(f'{most:.2g}'):,g} times the sensors' noise (sigma): a schedule"
            " that repairs a mistuned filter is not advice (leave Q's keys out)",
            True,
        )


def answer(outcome: Outcome) -> Iterator[Fact]:
    """The best option, its accuracy, and what the answer rests on."""
    yield from _best(outcome)
    yield _accuracy(outcome)
    yield from _basis(outcome)


def _best(outcome: Outcome) -> Iterator[Fact]:
    """The best option, and those that it is compared with."""
    options, best = outcome.choices.options, outcome.overall
    if len(options) == 1:
        yield Fact("Settling", _sentence(outcome, best))
        return
    yield Fact("Best", f"{options[best.option]}: {_sentence(outcome, best)}")
    rivals = list(_rivals(outcome, best))
    if rivals:
        text = "; ".join(f"{name}: {outcome.short(choice, 's')}" for name, choice in rivals)
        yield Fact("Others", text)


def _sentence(outcome: Outcome, choice: Choice) -> str:
    """How many runs settle with a choice, and when."""
    settled = np.isfinite(outcome.judged(choice, outcome.time_s))
    if not settled.any():
        return "no run settles"
    time = format_estimate(outcome.mean_s(choice), "s", 0)
    if settled.all():
        return f"{_every(outcome)} settles, after {time} on average"
    share = percent(outcome.success(choice))
    return f"{share} % of the runs settle, after {time} on average"


def _every(outcome: Outcome) -> str:
    """All runs in words: by the condition, if one number makes it."""
    axes = outcome.choices.condition_axes
    if len(axes) == 1 and len(axes[0]) == 1:
        values = [value for (value,) in outcome.choices.places(axes[0])]
        if all(isinstance(value, int | float) for value in values):
            name, unit = name_and_unit(axes[0][0])
            return f"every {name} from {min(values):g} to {max(values):g} {unit}".rstrip()
    return "every run"


def _rivals(outcome: Outcome, best: Choice) -> Iterator[tuple[str, Choice]]:
    """What the best option is compared with, each the best of its kind."""
    names = outcome.choices.options
    for kind in outcome.choices.rivals(best.option):
        found = outcome.best(kind)
        name = names[found.option]
        yield name if name != names[best.option] else "the next best", found


def _accuracy(outcome: Outcome) -> Fact:
    """The heading error at the end, and what limits it."""
    best = outcome.overall
    error, floor = (outcome.judged(best, one) for one in (outcome.error, outcome.floor))
    found = analysis.rms(error, outcome.cluster)
    aim = "the reference" if outcome.source.study.is_recorded else "true north"
    text = f"{heading(found)}' rms from {aim}"
    known = np.isfinite(error)
    never = np.isinf(outcome.judged(best, outcome.time_s))
    squares = float(np.sum(error[known] ** 2))
    if float(np.sum(error[known & never] ** 2)) > squares / 2:
        return Fact("Accuracy", f"{text}, mostly of runs that never settle")
    if outcome.source.study.is_recorded or not np.isfinite(floor).any():
        return Fact("Accuracy", text)
    lowest = analysis.rms(floor).value
    if lowest >= _LIMITING * found.value:
        return Fact("Accuracy", f"{text}, mostly bias floor ({lowest:.1f}')")
    return Fact("Accuracy", f"{text}, bias floor only {lowest:.1f}'")


def _basis(outcome: Outcome) -> Iterator[Fact]:
    """The success, and which draws chose and which judged."""
    study, draws, best = outcome.source.study, outcome.draws, outcome.overall
    yard, error = outcome.yard, outcome.judged(outcome.overall, outcome.error)
    text = f"{percent(outcome.success(best))} % {yard.description}"
    if not yard.truth:
        right = analysis.share(np.abs(error) <= yard.band_arcmin, outcome.cluster)
        text += f", {percent(right)} % of north"
    yield Fact("Success", text)
    names = outcome.choices.options
    text = f"{draws}{' (few)' if draws < ENOUGH_DRAWS else ''}"
    if len(names) > 1 and draws >= LEAST_DRAWS:
        text += ": each half judged what the other half chose"
        text += ", not the same" if len({*best.places[:2]}) > 1 else ""
    yield Fact("Starts" if study.is_recorded else "Draws", text)
    if study.stop_when and outcome.source.whole_draws is None:
        rows = outcome.source.rows(stopping.required_columns(study))
        found = stopping.analyse_interim(study, rows, draws)
        yield Fact("Stopped", said("stopped", rule=study.stop_when, found=found))


def doubts_of(outcome: Outcome) -> Iterator[Fact]:
    """Why the answer may mislead."""
    draws, study = outcome.draws, outcome.source.study
    several = len(outcome.choices.options) > 1
    unit = "start time" if study.is_recorded else "draw"
    if several and draws < LEAST_DRAWS:
        them = "it" if draws == 1 else "them"
        yield Fact(
            "Caution", f"only {counted(draws, unit)}: chosen and judged on {them} alike", True
        )
    if study.is_recorded:
        yield Fact("Caution", "no intervals, since all runs are on one record", True)
    best = outcome.overall
    ok = outcome.judged(best, outcome.settled)
    off = outcome.judged(best, outcome.off_floor)
    if off.sum() > _RARE * ok.sum():
        yield Fact(
            "Caution",
            said("off_floor", off=int(off.sum()), ok=int(ok.sum()), yard=outcome.yard),
            True,
        )
    yield from q_doubt(outcome.source)


def per_condition(outcome: Outcome) -> Table | None:
    """The best option at each point of the condition that matters most."""
    choices, overall = outcome.choices, outcome.overall
    time_s = np.minimum(outcome.time_s[overall.option], outcome.longest_s).mean(axis=-1)
    axis = choices.axis_that_matters(time_s)
    if axis is None:
        return None

    def row(conditions: list[int]) -> list[str]:
        here = outcome.at(conditions)
        if len(choices.options) == 1:
            error = analysis.rms(here.judged(overall, here.error), here.cluster)
            return [percent(here.success(overall)), here.short(overall), heading(error)]
        best = here.best()
        rival = here.best(choices.without_reset) if choices.without_reset else overall
        return [choices.options[best.option], here.short(best), here.short(rival)]

    return choices.table(axis, row, "settles after")

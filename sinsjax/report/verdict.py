"""The verdict on a sweep: the best option, its gain, its accuracy, and its limiting factor.

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
from sinsjax.analysis.formats import format_heading_error, format_percent
from sinsjax.columns import FAILED
from sinsjax.errors import InputError
from sinsjax.execution import stopping
from sinsjax.execution.source import Source
from sinsjax.messages import format_count
from sinsjax.methods.gravity_fit.method import REFITS
from sinsjax.report.base import MIN_DRAWS_FOR_INTERVALS, Fact, Table, Verdict
from sinsjax.report.choices import (
    MIN_DRAWS_TO_SPLIT,
    Choices,
    best_option,
    best_option_per_draw,
    condition_name_and_unit,
)
from sinsjax.report.markup import render_sentence
from sinsjax.study.filter_noise import noise_ratios_by_sensor
from sinsjax.study.success import FLOOR_COLUMNS, SuccessMeasure

_MAX_Q_RATIO = 10.0  # times the sensors' noise that Q may be before the verdict cautions
_LIMITING = 0.7  # share of the rms error from which the bias floor is its cause
_RARE = 0.1  # of the runs: so many may be at the edge of both bands, or have a doubtful fit
_FIT_DOUBTS = {
    "fit_misfit": (
        3.0,
        "the fit's residuals are {:.1f} times their sigma: do units, signs and [gravity_fit]"
        " describe these sensors?",
    ),
    "fit_prior_ratio": (
        3.0,
        "the fit finds a sensor error or lever arm of {:.1f} times its 1 sigma: is a sign wrong, or"
        " a number of [gravity_fit] too small?",
    ),
    "fit_change": (
        1.0,
        "the fit has not converged, its last pass changed it by {:.1f} sigma: the biases are too"
        " large, or the data too short",
    ),
}
"""Columns of a fit: above which value they are a doubt, and the doubt."""


def sweep_verdict(source: Source, *, warnings_shown: bool = False) -> Verdict:
    """Return the verdict on a simulated study, or on a recorded one with a reference.

    Args:
        source: the results; some run has a truth.
        warnings_shown: whether the user has seen the study's warnings.
    """
    outcome = SweepOutcome.from_source(source)
    doubts = [*warning_facts(source, warnings_shown=warnings_shown), *caution_facts(outcome)]
    doubts += fit_cautions(source, _RARE)
    return Verdict(study_title(source), [*answer_facts(outcome), *doubts], condition_table(outcome))


@dataclass(frozen=True)
class SweepOutcome:
    """The runs of a study over its options, conditions and draws.

    Attributes:
        source: the results.
        choices: the options and conditions.
        criterion: the criterion of success.
        time_s: (options, conditions, draws) settling times, infinite for runs without success, s.
        error: (options, conditions, draws) heading error from the truth at the end, arcmin.
        floor: (options, conditions, draws) bias floor, arcmin; NaN if there is none.
        off_floor: (options, conditions, draws) successes outside the band about the bias floor.
    """

    source: Source
    choices: Choices
    criterion: SuccessMeasure
    time_s: NDArray
    error: NDArray
    floor: NDArray
    off_floor: NDArray

    @classmethod
    def from_source(cls, source: Source) -> "SweepOutcome":
        """Read the columns of the summary that a verdict needs."""
        criteria = source.success_measures
        table = source.rows(
            [*FLOOR_COLUMNS, *(n for y in criteria for n in (y.ok_column, y.settle_column))]
        )
        # A criterion that some method does not have cannot compare the methods.
        criterion = next(
            (candidate for candidate in criteria if table[candidate.ok_column].null_count == 0),
            criteria[0],
        )
        choices = Choices.from_study(source.study)

        def column(name: str) -> NDArray:
            return choices.arrange_runs(analysis.numeric_column(table, name))

        settle_s = np.where(
            column(criterion.ok_column) > 0, column(criterion.settle_column), np.inf
        )
        time_s = np.where(np.isnan(settle_s), np.inf, settle_s)
        error, floor = (column(name) for name in FLOOR_COLUMNS)
        return cls(
            source, choices, criterion, time_s, error, floor, criterion.outside_floor_band(column)
        )

    @property
    def n_draws(self) -> int:
        """Number of draws, or of start times on a record."""
        return int(self.time_s.shape[-1])

    @cached_property
    def unsettled_time_s(self) -> float:
        """Time that a run without settling counts when options are ranked, s."""
        return max(self.source.study.run_s, np.max(self.time_s, initial=0, where=self.settled))

    @property
    def longest_time_s(self) -> float:
        """Longest time that a run can settle after, s."""
        return max(float(self.source.study.spans_s[:, 0].max()), self.unsettled_time_s)

    @property
    def settled(self) -> NDArray:
        """(options, conditions, draws) whether a run settles."""
        return np.isfinite(self.time_s)

    def choose_best(self, options: Sequence[int] | None = None) -> "Choice":
        """Choose among some options, or among all."""
        candidates = np.arange(len(self.time_s)) if options is None else np.asarray(options)
        time_s = self.time_s[candidates]
        return Choice(
            int(candidates[best_option(time_s, self.unsettled_time_s)]),
            candidates[best_option_per_draw(time_s, self.unsettled_time_s)],
        )

    @property
    def best_variant(self) -> int:
        """The number of the best option's variant in the last condition."""
        return int(self.choices.variants[self.overall_choice.option, -1])

    @cached_property
    def overall_choice(self) -> "Choice":
        """The best of all options."""
        return self.choose_best()

    def select_conditions(self, conditions: Sequence[int]) -> "SweepOutcome":
        """The same in some conditions."""
        names = ("time_s", "error", "floor", "off_floor")
        return replace(self, **{name: getattr(self, name)[:, conditions] for name in names})

    def held_out_values(self, choice: "Choice", values: NDArray) -> NDArray:
        """Values (options, conditions, draws) with the option chosen for each draw, flat."""
        return values[choice.option_per_draw, :, np.arange(self.n_draws)].ravel()

    @property
    def clusters(self) -> NDArray:
        """The cluster of each of the values of `judged`."""
        draw = np.zeros if self.source.study.is_recorded else np.arange
        return np.repeat(draw(self.n_draws).astype(int), self.time_s.shape[1])

    def success_share(self, choice: "Choice") -> Estimate:
        """The share of runs that settle with a choice."""
        return analysis.share(np.isfinite(self.held_out_values(choice, self.time_s)), self.clusters)

    def mean_settling_s(self, choice: "Choice") -> Estimate:
        """The mean settling time of the runs that settle with a choice, s."""
        return analysis.mean(
            self.held_out_values(choice, self.time_s),
            self.clusters,
            limits=(0.0, self.longest_time_s),
        )

    def format_settling(self, choice: "Choice", unit: str = "") -> str:
        """Return settling with a choice as text: mean time, ``never``, or share that settles."""
        settled = np.isfinite(self.held_out_values(choice, self.time_s))
        if settled.all():
            return format_estimate(self.mean_settling_s(choice), unit, 0)
        return (
            f"{format_percent(self.success_share(choice))} % settle" if settled.any() else "never"
        )


class Choice(NamedTuple):
    """The best of some options.

    Attributes:
        option: the best according to all draws, which names it.
        option_per_draw: (draws,) the option that judges each draw, chosen by other draws.
    """

    option: int
    option_per_draw: NDArray


def study_title(source: Source) -> str:
    """Return the name of a study with its numbers of runs and failures, and the computing time."""
    study, runs = source.study, source.runs
    count = format_count(runs, "run")
    if source.whole_draws is not None:
        count = f"unfinished, {runs:,} of {study.n_draws * study.n_variants:,} runs"
    if source.wall_s is not None:
        count += f" in {source.wall_s:,.{0 if source.wall_s > 9 else 1}f} s"
    kept = len({*study.duplicate_of}) * runs // study.n_variants
    count += f" ({kept:,} distinct)" if kept < runs else ""
    status = source.rows(["status"])
    counts = {outcome: int(analysis.status_mask(status, outcome).sum()) for outcome in FAILED}
    failed = {outcome: number for outcome, number in counts.items() if number}
    kinds = f" ({', '.join(failed)})" if failed else ""
    return (
        f"{study.name}: {count}, {f'{sum(failed.values()):,}' if failed else 'none'} failed{kinds}"
    )


def warning_facts(source: Source, *, warnings_shown: bool) -> Iterator[Fact]:
    """Yield the warnings of a study, unless the user has seen them."""
    yield from (Fact("Warning", line, True) for line in (() if warnings_shown else source.warnings))


def process_noise_caution(source: Source) -> Iterator[Fact]:
    """A caution if the filter's Q is far larger than the noise of the sensors."""
    if source.study.is_recorded:
        return
    ratios = [ratio for found in noise_ratios_by_sensor(source.study).values() for ratio in found]
    most = max(ratios, default=0.0)
    if most > _MAX_Q_RATIO:
        which = "Q" if min(ratios) > _MAX_Q_RATIO else "Q of some variants"
        yield Fact(
            "Caution",
            f"{which} is {float(f'{most:.2g}'):,g} times the sensors' noise (sigma): a schedule"
            " that repairs a mistuned filter is no recommendation (delete its q_ keys)",
            True,
        )


def fit_cautions(source: Source, rare: float = 0.0) -> Iterator[Fact]:
    """Yield doubts about fits, of which more than a share ``rare`` have too large a column."""
    if "gravity_fit" not in source.study.methods:
        return
    try:
        rows = source.rows(_FIT_DOUBTS)
    except InputError:  # results of a version that does not have these columns
        return
    for name, (limit, doubt) in _FIT_DOUBTS.items():
        values = analysis.numeric_column(rows, name)
        values = values[np.isfinite(values)]
        above = values[values > limit]
        if above.size > rare * values.size:
            which = f" ({above.size:,} of {values.size:,} fits)" if values.size > 1 else ""
            yield Fact("Caution", doubt.format(above.max()) + which, True)


def answer_facts(outcome: SweepOutcome) -> Iterator[Fact]:
    """Yield the best option, its accuracy, and the basis of the answer."""
    yield from _best_option_facts(outcome)
    if "gravity_fit" in outcome.source.study.methods:
        yield Fact("Refits", REFITS)
    yield _accuracy_fact(outcome)
    yield from _basis_facts(outcome)


def _best_option_facts(outcome: SweepOutcome) -> Iterator[Fact]:
    """Yield the best option and its rivals."""
    options, best = outcome.choices.options, outcome.overall_choice
    if len(options) == 1:
        yield Fact("Settling", _settling_sentence(outcome, best))
        return
    yield Fact("Best", f"{options[best.option]}: {_settling_sentence(outcome, best)}")
    rivals = list(_rival_choices(outcome, best))
    if rivals:
        text = "; ".join(
            f"{name}: {outcome.format_settling(choice, 's')}" for name, choice in rivals
        )
        yield Fact("Others", text)


def _settling_sentence(outcome: SweepOutcome, choice: Choice) -> str:
    """Return the share of runs that settle with a choice, and their mean time."""
    settled = np.isfinite(outcome.held_out_values(choice, outcome.time_s))
    if not settled.any():
        return "no run settles"
    time = format_estimate(outcome.mean_settling_s(choice), "s", 0)
    if settled.all():
        return f"{_describe_all_runs(outcome)} settles, after {time} on average"
    share = format_percent(outcome.success_share(choice))
    return f"{share} % of the runs settle, after {time} on average"


def _describe_all_runs(outcome: SweepOutcome) -> str:
    """All runs in words: by the condition, if one number makes it."""
    axes = outcome.choices.condition_axes
    if len(axes) == 1 and len(axes[0]) == 1:
        values = [value for (value,) in outcome.choices.conditions_by_point(axes[0])]
        if all(isinstance(value, int | float) for value in values):
            name, unit = condition_name_and_unit(axes[0][0])
            return f"every {name} from {min(values):g} to {max(values):g} {unit}".rstrip()
    return "every run"


def _rival_choices(outcome: SweepOutcome, best: Choice) -> Iterator[tuple[str, Choice]]:
    """Yield the rivals of the best option, each the best of its kind."""
    names = outcome.choices.options
    for kind in outcome.choices.rival_options(best.option):
        choice = outcome.choose_best(kind)
        name = names[choice.option]
        yield name if name != names[best.option] else "the next best", choice


def _accuracy_fact(outcome: SweepOutcome) -> Fact:
    """Return the heading error at the end, and its limiting factor."""
    best = outcome.overall_choice
    error, floor = (
        outcome.held_out_values(best, values) for values in (outcome.error, outcome.floor)
    )
    found = analysis.rms(error, outcome.clusters)
    aim = "the reference" if outcome.source.study.is_recorded else "true north"
    text = f"{format_heading_error(found)}' rms from {aim}"
    known = np.isfinite(error)
    never = np.isinf(outcome.held_out_values(best, outcome.time_s))
    squares = float(np.sum(error[known] ** 2))
    if float(np.sum(error[known & never] ** 2)) > squares / 2:
        return Fact("Accuracy", f"{text}, mostly of runs that never settle")
    if outcome.source.study.is_recorded or not np.isfinite(floor).any():
        return Fact("Accuracy", text)
    lowest = analysis.rms(floor).value
    if lowest >= _LIMITING * found.value:
        return Fact("Accuracy", f"{text}, mostly bias floor ({lowest:.1f}')")
    return Fact("Accuracy", f"{text}, bias floor only {lowest:.1f}'")


def _basis_facts(outcome: SweepOutcome) -> Iterator[Fact]:
    """The success, and which draws chose and which judged."""
    study, draws, best = outcome.source.study, outcome.n_draws, outcome.overall_choice
    criterion, error = (
        outcome.criterion,
        outcome.held_out_values(outcome.overall_choice, outcome.error),
    )
    text = f"{format_percent(outcome.success_share(best))} % {criterion.description}"
    if not criterion.truth:
        right = analysis.share(np.abs(error) <= criterion.band_arcmin, outcome.clusters)
        text += f", {format_percent(right)} % of north"
    yield Fact("Success", text)
    names = outcome.choices.options
    text = f"{draws}{' (few)' if draws < MIN_DRAWS_FOR_INTERVALS else ''}"
    if len(names) > 1 and draws >= MIN_DRAWS_TO_SPLIT:
        text += ": each half evaluates the choice of the other"
        text += ", and they chose differently" if len({*best.option_per_draw[:2]}) > 1 else ""
    yield Fact("Starts" if study.is_recorded else "Draws", text)
    if study.stop_when and outcome.source.whole_draws is None:
        rows = outcome.source.rows(stopping.required_columns(study))
        found = stopping.analyse_interim(study, rows, draws)
        yield Fact("Stopped", render_sentence("stopped", rule=study.stop_when, reached=found))


def caution_facts(outcome: SweepOutcome) -> Iterator[Fact]:
    """Yield why the answer may mislead."""
    draws, study = outcome.n_draws, outcome.source.study
    several = len(outcome.choices.options) > 1
    unit = "start time" if study.is_recorded else "draw"
    if several and draws < MIN_DRAWS_TO_SPLIT:
        text = f"only {format_count(draws, unit)}: no other {unit}s evaluate the choice"
        yield Fact("Caution", text, True)
    if study.is_recorded:
        yield Fact("Caution", "no intervals, since all runs are on one record", True)
    best = outcome.overall_choice
    ok = outcome.held_out_values(best, outcome.settled)
    off_floor = outcome.held_out_values(best, outcome.off_floor)
    if off_floor.sum() > _RARE * ok.sum():
        yield Fact(
            "Caution",
            render_sentence(
                "off_floor", off=int(off_floor.sum()), ok=int(ok.sum()), criterion=outcome.criterion
            ),
            True,
        )
    yield from process_noise_caution(outcome.source)


def condition_table(outcome: SweepOutcome) -> Table | None:
    """The best option at each point of the condition that matters most."""
    choices, overall = outcome.choices, outcome.overall_choice
    time_s = np.minimum(outcome.time_s[overall.option], outcome.unsettled_time_s).mean(axis=-1)
    axis = choices.most_influential_axis(time_s)
    if axis is None:
        return None

    def format_row(conditions: list[int]) -> list[str]:
        outcome_here = outcome.select_conditions(conditions)
        if len(choices.options) == 1:
            error = analysis.rms(
                outcome_here.held_out_values(overall, outcome_here.error), outcome_here.clusters
            )
            return [
                format_percent(outcome_here.success_share(overall)),
                outcome_here.format_settling(overall),
                format_heading_error(error),
            ]
        best = outcome_here.choose_best()
        rival = (
            outcome_here.choose_best(choices.options_without_reset)
            if choices.options_without_reset
            else overall
        )
        return [
            choices.options[best.option],
            outcome_here.format_settling(best),
            outcome_here.format_settling(rival),
        ]

    return choices.condition_table(axis, format_row, "settles after, mean")

"""The verdict on a sweep: the best option, those like it, its accuracy, and its limiting factor.

An axis with a starting error, a motion, a sensor or a site is a condition, which is imposed. Any
other axis, such as a reset schedule, a filter key or the method, is a choice of the engineer.
Options are compared over all conditions. The best has the fewest runs that never settle and, of
equals, settles soonest on average, over all draws; its numbers are those of its own runs, as
anybody computes them from the summary.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.analysis import Estimate, Grid, format_estimate
from sinsjax.analysis.labels import (
    describe_point,
    describe_schedule,
    format_heading_error,
    format_percent,
    format_value,
    name_and_unit,
    value_with_unit,
)
from sinsjax.columns import FAILED
from sinsjax.errors import InputError
from sinsjax.execution.prepare import iter_warnings_of_bands_below_noise
from sinsjax.execution.results import Results
from sinsjax.messages import format_count
from sinsjax.methods.filters.keys import SCHEDULE_KEYS
from sinsjax.methods.gravity_fit.method import REFITS
from sinsjax.report.attitude import (
    attitude_facts,
    filter_sigma_cautions,
    finds_heading,
    last_attitude_table,
)
from sinsjax.report.document import MIN_DRAWS_FOR_INTERVALS, Fact, Report, Table, caution
from sinsjax.study.filter_noise import noise_ratios_by_sensor
from sinsjax.study.keys import is_condition_key
from sinsjax.study.success import FLOOR_COLUMNS, SuccessMeasure

_MAX_Q_RATIO = 10.0  # times the sensors' noise that Q may be before the verdict cautions
_FAILED_ARCMIN = 180 * 60.0  # of a program's run without a result
_LIMITING = 0.7  # share of the rms error from which the bias floor is its cause
_MOST_LIKE = 3  # options that are listed as not told apart from the best
_MIN_DRAWS_TO_SPLIT = 8  # fewest draws of which each half is judged by the choice of the other
_RARE = 0.1  # of the runs: so many may be at the edge of both bands, or have a doubtful fit
_FIT_DOUBTS = {
    "fit_misfit": (3.0, "residuals of {:.1f} sigma: are units, signs and [gravity_fit] right?"),
    "fit_prior_ratio": (3.0, "an error of {:.1f} times its 1 sigma: is a sign or the sigma wrong?"),
    "fit_change": (1.0, "not converged, by {:.1f} sigma: biases too large or data too short?"),
}
"""Columns of a fit: above which value they are a doubt, and the doubt."""


@dataclass(frozen=True)
class SweepOutcome:
    """The results of a sweep by option, condition and draw, by one criterion of success.

    Copies of variants are left out. An axis is given by the keys that identify its points.
    """

    source: Results
    criterion: SuccessMeasure
    grid: Grid
    option_axes: list[tuple[str, ...]]
    condition_axes: list[tuple[str, ...]]

    @classmethod
    def from_source(cls, source: Results) -> "SweepOutcome":
        """Read the columns of the summary that a verdict needs, and sort the axes of its study."""
        criteria, study = source.success_measures, source.study
        columns = [name for y in criteria for name in (y.ok_column, y.settle_column)]
        table = source.rows([*FLOOR_COLUMNS, *columns])
        # A criterion that some method does not have cannot compare the methods.
        complete = [one for one in criteria if table[one.ok_column].null_count == 0]
        imposed = [
            any(is_condition_key(key) or key == "start_s" for key in axis)
            for axis in study.dimensions
        ]
        sizes = [len(next(iter(axis.values()))) for axis in study.dimensions]
        choices_first = np.argsort(imposed, kind="stable")
        variants = np.arange(study.n_variants).reshape(sizes).transpose(choices_first)
        chosen = [size for size, is_imposed in zip(sizes, imposed, strict=True) if not is_imposed]
        variants = variants.reshape(int(np.prod(chosen)), -1)
        first = study.duplicate_of[variants] == variants
        variants = variants[first.any(axis=1)][:, first.any(axis=0)]
        draws = np.arange(table.num_rows // study.n_variants)
        grid = Grid({}, table, variants[..., None] + study.n_variants * draws)
        axes: tuple[list[tuple[str, ...]], ...] = ([], [])
        for keys, is_imposed in zip(study.axes_shown, imposed, strict=True):
            axes[is_imposed].append(keys)
        return cls(source, (complete or criteria)[0], grid, *axes)

    @property
    def variants(self) -> NDArray:
        """Number of the variant, (options, conditions)."""
        return self.grid.rows[..., 0]

    @cached_property
    def _reset_times(self) -> list[tuple[float, ...]]:
        return self.source.study.reset_times()

    @property
    def without_resets(self) -> list[int]:
        """The options without scheduled resets; none if no axis is a schedule."""
        if not any({*keys} <= {*SCHEDULE_KEYS} for keys in self.option_axes):
            return []
        first = self.variants[:, 0].tolist()
        return [option for option, variant in enumerate(first) if not self._reset_times[variant]]

    @cached_property
    def options(self) -> list[str]:
        """Each option in words."""
        options = []
        for variant in self.variants[:, 0].tolist():
            words, times_s = [], self._reset_times[variant]
            for keys in self.option_axes:
                for key in keys:
                    value = self.source.study.values(key)[variant]
                    if key == "method":
                        words.append(format_value(value))
                    elif key not in SCHEDULE_KEYS:
                        words.append(describe_point({key: value}))
                    elif times_s or {*keys} <= {*SCHEDULE_KEYS}:
                        words.append(describe_schedule(times_s))
            options.append(", ".join(dict.fromkeys(words)))
        return options

    def select_conditions(self, conditions: Sequence[int]) -> "SweepOutcome":
        """The same in some conditions."""
        return replace(self, grid=self.grid._replace(rows=self.grid.rows[:, conditions]))

    @cached_property
    def time_s(self) -> NDArray:
        """Settling times of successes, infinite for others, s; (options, conditions, draws)."""
        settled = self.grid.column(self.criterion.ok_column) > 0
        times_s = np.where(settled, self.grid.column(self.criterion.settle_column), np.inf)
        return np.where(np.isnan(times_s), np.inf, times_s)

    @property
    def n_draws(self) -> int:
        """Number of draws, or of start times on a record."""
        return int(self.time_s.shape[-1])

    @cached_property
    def unsettled_time_s(self) -> float:
        """Time that a run without settling counts when options are ranked, s."""
        settled = np.isfinite(self.time_s)
        return max(self.source.study.run_s, np.max(self.time_s, initial=0, where=settled))

    @cached_property
    def best(self) -> int:
        """The best option; every number about it is that of its own runs."""
        return self.best_of(range(len(self.time_s)))

    def best_of(self, options: Sequence[int], draws: slice = slice(None)) -> int:
        """The option with the fewest runs that never settle; of equals, the fastest on average."""
        time_s = self.time_s[list(options)][..., draws]
        never = np.isinf(time_s).sum(axis=(1, 2))
        mean = np.minimum(time_s, self.unsettled_time_s).mean(axis=(1, 2))
        return options[int(np.lexsort((mean, never))[0])]

    @property
    def best_variant(self) -> int:
        """The number of the best option's variant in the last condition."""
        return int(self.variants[self.best, -1])

    def flat(self, column: str, option: int) -> NDArray:
        """A column of an option's runs."""
        return self.grid.column(column)[option].ravel()

    @property
    def clusters(self) -> NDArray:
        """The cluster of each run of an option, flat."""
        draws = np.arange(self.n_draws) * (not self.source.study.is_recorded)
        return np.tile(draws, self.time_s.shape[1])

    def success_share(self, option: int) -> Estimate:
        """The share of an option's runs that settle."""
        return analysis.share(np.isfinite(self.time_s[option]).ravel(), self.clusters)

    def mean_settling_s(self, option: int) -> Estimate:
        """The mean settling time of the runs that settle, s."""
        longest_s = max(float(self.source.study.spans_s[:, 0].max()), self.unsettled_time_s)
        times_s = self.time_s[option].ravel()
        return analysis.mean(times_s, self.clusters, limits=(0.0, longest_s))

    def heading_error(self, option: int) -> Estimate:
        """The rms heading error from the truth at the end, arcmin."""
        return analysis.rms(self.flat("phi_u_arcmin", option), self.clusters)

    def format_settling(self, option: int, unit: str = "") -> str:
        """Return settling with an option as text: mean time, ``never``, or share that settles."""
        settled = np.isfinite(self.time_s[option])
        if settled.all():
            return format_estimate(self.mean_settling_s(option), unit, 0)
        share = format_percent(self.success_share(option))
        return f"{share} % settle" if settled.any() else "never"

    def options_tied_with_best(self) -> list[int]:
        """The options that the draws do not tell apart from the best, the fastest first.

        Neither fewer of the best's runs never settle, by the interval of the paired difference, nor
        do they settle sooner on average, where a run that never settles counts its whole length.
        """
        if self.source.study.is_recorded or np.isinf(self.time_s[self.best]).all():
            return []
        capped_s = np.minimum(self.time_s, self.unsettled_time_s).mean(axis=1)
        settled = np.isfinite(self.time_s).mean(axis=1)
        found = []
        for option in (option for option in range(len(self.time_s)) if option != self.best):
            later = analysis.mean_difference(capped_s[option], capped_s[self.best])
            fewer = analysis.mean_difference(settled[self.best], settled[option])
            if later.low <= 0 and not fewer.low > 0:
                found.append(option)
        return sorted(found, key=lambda option: capped_s[option].mean())

    @cached_property
    def held_out_settling_and_agreement(self) -> tuple[str, bool]:
        """Settling on draws that did not choose the option, and whether the best's agrees.

        Each half of the draws is judged with the option that is best on the other half. No text
        with one option, with few draws or on a record.
        """
        few = self.n_draws < _MIN_DRAWS_TO_SPLIT or self.source.study.is_recorded
        if few or len(self.time_s) == 1:
            return "", True
        chosen = np.empty(self.n_draws, dtype=int)
        halves = slice(0, None, 2), slice(1, None, 2)
        for choosing, judging in (halves, halves[::-1]):
            chosen[judging] = self.best_of(range(len(self.time_s)), choosing)
        times_s = self.time_s[chosen, :, np.arange(self.n_draws)].ravel()
        draws = np.repeat(np.arange(self.n_draws), self.time_s.shape[1])
        share, mean_s = analysis.share(np.isfinite(times_s), draws), analysis.mean(times_s, draws)
        text = f"{format_percent(share)} % of the runs settle"
        text += f", after {format_estimate(mean_s, 's', 0)}" if share.value else ""
        own = self.success_share(self.best), self.mean_settling_s(self.best)
        agrees = not any(
            found.value < best.low or found.value > best.high
            for found, best in zip((share, mean_s), own, strict=True)
        )
        return f"on draws that did not choose the option, {text}", agrees


def find_outcome(source: Results) -> SweepOutcome | None:
    """The outcome of a sweep; None if no run has a truth."""
    heading = analysis.numeric_column(source.rows(["phi_u_arcmin"]), "phi_u_arcmin")
    return SweepOutcome.from_source(source) if np.isfinite(heading).any() else None


def build_short_report(
    source: Results, outcome: SweepOutcome | None = None, *, warnings_shown: bool = False
) -> Report:
    """Return the report without its figures and tables.

    It states the best option if a truth is known, and the attitude on a record, without a truth or
    without a heading. The outcome is that of the sweep, if it was found before. A band out of reach
    is the first line, also for users who have seen the warnings.
    """
    study, outcome = source.study, outcome or find_outcome(source)
    bands = [] if study.is_recorded else [*iter_warnings_of_bands_below_noise(study)]
    band = [caution(line, "Band") for line in bands]
    others = [] if warnings_shown else [line for line in source.warnings if line not in bands]
    doubts = [*(caution(line, "Warning") for line in others), *_gravity_fit_cautions(source)]
    if outcome and finds_heading(source) and not study.is_recorded:
        facts = [*band, *_external_program_heading_error_facts(outcome), *_answer_facts(outcome)]
        facts += [*doubts, *_caution_facts(outcome)]
        return Report(_title_with_counts(source), facts, _most_influential_condition_table(outcome))
    table = last_attitude_table(source) if source.runs > 1 else None
    variant, judged = None, []
    if outcome and finds_heading(source) and study.n_variants > 1:
        variant, table = outcome.best_variant, _most_influential_condition_table(outcome)
        judged = [*_answer_facts(outcome), *_caution_facts(outcome)]
    facts = [*attitude_facts(source, variant), *judged, *doubts, *filter_sigma_cautions(source)]
    return Report(_title_with_counts(source), facts, table)


def _title_with_counts(source: Results) -> str:
    """Return the name of a study with its numbers of runs and failures, and the computing time."""
    study, runs = source.study, source.runs
    count = format_count(runs, "run")
    if source.unfinished:
        count = f"unfinished, {runs:,} of {study.n_draws * study.n_variants:,} runs"
    if source.wall_s is not None:
        count += f" in {source.wall_s:,.{0 if source.wall_s > 9 else 1}f} s"
    kept = len({*study.duplicate_of}) * runs // study.n_variants
    count += f" ({kept:,} distinct)" if kept < runs else ""
    status = source.rows(["status"])
    failed = {kind: int(analysis.numeric_column(status, f"status={kind}").sum()) for kind in FAILED}
    kinds = ", ".join(kind for kind, number in failed.items() if number)
    text = f"{sum(failed.values()):,} failed ({kinds})" if kinds else "none failed"
    return f"{study.name}: {count}, {text}"


def _answer_facts(outcome: SweepOutcome) -> Iterator[Fact]:
    """Yield the best option, those like it, its rivals, its accuracy and the basis."""
    best, source, criterion = outcome.best, outcome.source, outcome.criterion
    settled, share = np.isfinite(outcome.time_s[best]), format_percent(outcome.success_share(best))
    sentence = "no run settles"
    if settled.any():
        runs = "every run settles" if settled.all() else f"{share} % of the runs settle"
        sentence = (
            f"{runs}, after {format_estimate(outcome.mean_settling_s(best), 's', 0)} on average"
        )
    if len(outcome.options) == 1:
        yield Fact("Settling", sentence)
    else:
        yield Fact("Best", f"{outcome.options[best]}: {sentence}")
        yield from _comparison_facts(outcome)
    if "gravity_fit" in source.study.methods:
        yield Fact("Refits", REFITS)
    yield Fact("Accuracy", _describe_accuracy(outcome))
    text = f"{share} % {criterion.description}"
    if not criterion.truth:
        error = outcome.flat("phi_u_arcmin", best)
        right = analysis.share(np.abs(error) <= criterion.band_arcmin, outcome.clusters)
        text += f", {format_percent(right)} % of north"
    yield Fact("Success", text)
    few = " (few)" if outcome.n_draws < MIN_DRAWS_FOR_INTERVALS else ""
    yield Fact("Starts" if source.study.is_recorded else "Draws", f"{outcome.n_draws}{few}")
    if (rule := source.study.stop_when) and not source.unfinished:
        text = f"every half-width of {rule.statistic} is at most {rule.half_width:g}"
        stopped = outcome.n_draws < source.study.n_draws
        yield Fact("Stopped", text if stopped else "after the last draw, not by [stop_when]")


def _comparison_facts(outcome: SweepOutcome) -> Iterator[Fact]:
    """Yield the options that are not told apart from the best, the next best and no resets."""
    names, like = outcome.options, outcome.options_tied_with_best()
    if like:
        listed = "; ".join(names[option] for option in like[:_MOST_LIKE])
        more = f"; {len(like) - _MOST_LIKE} more" if len(like) > _MOST_LIKE else ""
        yield Fact("Not told apart", f"{listed}{more} (on {format_count(outcome.n_draws, 'draw')})")
    others = [option for option in range(len(names)) if option not in (outcome.best, *like)]
    without = [option for option in outcome.without_resets if option in others]
    rivals = dict.fromkeys(outcome.best_of(kind) for kind in (others, without) if kind)
    if rivals:
        texts = (f"{names[rival]}: {outcome.format_settling(rival, 's')}" for rival in rivals)
        yield Fact("Others", "; ".join(texts))


def _describe_accuracy(outcome: SweepOutcome) -> str:
    """Return the heading error at the end, and its limiting factor."""
    error, floor = (outcome.flat(name, outcome.best) for name in FLOOR_COLUMNS)
    found, recorded = outcome.heading_error(outcome.best), outcome.source.study.is_recorded
    text = (
        f"{format_heading_error(found)}' rms from {'the reference' if recorded else 'true north'}"
    )
    squares = np.where(np.isfinite(error), error, 0.0) ** 2
    never = np.isinf(outcome.time_s[outcome.best].ravel())
    if squares[never].sum() > squares.sum() / 2:
        return f"{text}, mostly of runs that never settle"
    if recorded or not np.isfinite(floor).any():
        return text
    lowest = analysis.rms(floor).value
    if lowest >= _LIMITING * found.value:
        return f"{text}, mostly bias floor ({lowest:.1f}')"
    return f"{text}, bias floor only {lowest:.1f}'"


def _external_program_heading_error_facts(outcome: SweepOutcome) -> Iterator[Fact]:
    """Yield the mean heading error of each program outside sinsjax, and that of the best method.

    A run without a result counts 180 deg. The best is that of all draws.
    """
    external = outcome.source.study.study.external or ()
    methods = np.array(outcome.source.study.values("method"))[outcome.variants[:, 0]]
    errors = [np.abs(outcome.flat("phi_u_arcmin", option)) for option in range(len(methods))]
    errors = [np.where(np.isnan(error), _FAILED_ARCMIN, error) for error in errors]
    means = [np.inf if m in external else e.mean() for m, e in zip(methods, errors, strict=True)]
    best = int(np.argmin(means))
    for program in (option for option, mean in enumerate(means) if np.isinf(mean)):
        own = analysis.mean(errors[program], outcome.clusters, limits=(0.0, _FAILED_ARCMIN))
        text = f"{methods[program]}: mean heading error {format_heading_error(own)}'"
        larger, smaller, word = errors[program], errors[best], "more"
        if own.value < means[best]:
            larger, smaller, word = smaller, larger, "less"
        difference = analysis.mean_difference(larger, smaller, outcome.clusters)
        text += f", on the same draws {format_heading_error(difference)}' {word} than that of"
        yield Fact("Program", f"{text} {outcome.options[best]}, the most accurate of sinsjax")


def _caution_facts(outcome: SweepOutcome) -> Iterator[Fact]:
    """Yield why the answer may mislead."""
    best, criterion = outcome.best, outcome.criterion
    text, agrees = outcome.held_out_settling_and_agreement
    if outcome.source.study.is_recorded:
        yield caution("no intervals, since all runs are on one record")
    elif not agrees:
        yield caution(text)
    ok = int(np.isfinite(outcome.time_s[best]).sum())
    off = int(criterion.outside_floor_band(lambda name: outcome.flat(name, best)).sum())
    if off > _RARE * ok:
        number = "All" if off == ok else f"{off:,} of the"
        yield caution(
            f"{number} {format_count(ok, 'successful run')} of the best end more than"
            f" {criterion.band_arcmin:g}' from their bias floors: they have not converged,"
            " and their errors happen to be small"
        )
    yield from excessive_process_noise_caution(outcome.source)


def excessive_process_noise_caution(source: Results) -> Iterator[Fact]:
    """A caution if the filter's Q is far larger than the noise of the sensors."""
    if source.study.is_recorded:
        return
    ratios = [ratio for found in noise_ratios_by_sensor(source.study).values() for ratio in found]
    most = max(ratios, default=0.0)
    if most > _MAX_Q_RATIO:
        which = "Q" if min(ratios) > _MAX_Q_RATIO else "Q of some variants"
        yield caution(
            f"{which} is {float(f'{most:.2g}'):,g} times the sensors' noise (sigma): a schedule"
            " that repairs a mistuned filter is no recommendation (delete its q_ keys)"
        )


def _gravity_fit_cautions(source: Results) -> Iterator[Fact]:
    """Yield doubts about fits; about draws, if too large a share of them is doubtful."""
    if "gravity_fit" not in source.study.methods:
        return
    try:
        rows = source.rows(_FIT_DOUBTS)
    except InputError:  # results of a version that does not have these columns
        return
    rare = 0.0 if source.study.is_recorded else _RARE
    for name, (limit, doubt) in _FIT_DOUBTS.items():
        values = analysis.numeric_column(rows, name)
        values = values[np.isfinite(values)]
        above = values[values > limit]
        if above.size > rare * values.size:
            which = f" ({above.size:,} of {values.size:,} fits)" if values.size > 1 else ""
            yield caution(f"the fit has {doubt.format(above.max())}{which}")


def _most_influential_condition_table(outcome: SweepOutcome) -> Table | None:
    """The best option at each point of the condition along which its settling varies most."""
    time_s = np.minimum(outcome.time_s[outcome.best], outcome.unsettled_time_s).mean(axis=-1)
    points: dict[tuple[str, ...], dict[tuple[Any, ...], list[int]]] = {}
    for keys in outcome.condition_axes:
        columns, points[keys] = [outcome.source.study.values(key) for key in keys], {}
        for place, variant in enumerate(outcome.variants[0].tolist()):
            point = tuple(values[variant] for values in columns)
            points[keys].setdefault(point, []).append(place)
    spread = {
        keys: np.ptp([time_s[conditions].mean() for conditions in found.values()])
        for keys, found in points.items()
        if len(found) > 1
    }
    if not spread:
        return None
    axis, names = max(spread, key=spread.__getitem__), outcome.options
    header = ["settled (%)", "settles after, mean (s)", "error, rms (arcmin)"]
    if len(names) > 1:
        rival = "no reset (s)" if outcome.without_resets else "best overall (s)"
        header = ["best option", "settles after, mean (s)", rival]
    rows = []
    for point, conditions in points[axis].items():
        here = outcome.select_conditions(conditions)
        if len(names) > 1:
            best, other = here.best, here.best_of(outcome.without_resets or [outcome.best])
            cells = [names[best], here.format_settling(best), here.format_settling(other)]
        else:
            share = format_percent(here.success_share(0))
            cells = [share, here.format_settling(0), format_heading_error(here.heading_error(0))]
        rows.append([", ".join(map(value_with_unit, axis, point)), *cells])
    first = ", ".join(name_and_unit(key)[0].removeprefix("initial ") for key in axis)
    return Table(f"Per {first}", [first, *header], rows)

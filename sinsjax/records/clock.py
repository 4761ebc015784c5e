"""The clock of a file without a description: every column that may be a time is tried."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sinsjax.errors import InputError
from sinsjax.records.column_names import Clock, find_clocks, is_counter
from sinsjax.records.layout import TIME_UNITS, FloatArray, Note, RecordLayout
from sinsjax.records.stamps import Sampling, find_sampling
from sinsjax.records.tabular import combine_times, find_repeated_rows

_USUAL_HZ = 4.0, 4000.0  # rates of IMUs
_POSSIBLE_HZ = 0.05, 20e3
_SHORTEST_S, _LONGEST_S = 10.0, 6 * 3600.0  # lengths of records that somebody aligns
_PLACEHOLDER_HZ = 100.0
_MAX_SPARSENESS = 1.5  # samples between the first and the last stamp, over their number
_WINDOWS = 8
_EVEN = 0.01  # relative scatter of the rates of windows whose stamps lack no samples


class Timing(NamedTuple):
    """Timing of a file.

    Attributes:
        clock: the time column with its unit, or None.
        rate_hz: sample rate, Hz; a placeholder if unknown.
        notes: reasons, doubts and questions by key of the layout.
    """

    clock: Clock | None
    rate_hz: float
    notes: dict[str, Note]

    def complete(self, layout: RecordLayout) -> RecordLayout:
        """Return a layout with this timing."""
        if self.clock is None:
            return layout._replace(rate_hz=self.rate_hz)
        return with_clock(layout, self.clock)


def with_clock(layout: RecordLayout, clock: Clock) -> RecordLayout:
    """Return a layout with a clock, whose unit is known."""
    return layout._replace(
        time_column=clock.name,
        time_unit=clock.unit[0],
        time_scale=clock.unit[1],
        time_fraction_column=clock.fraction,
        time_fraction_unit=clock.fraction_unit,
    )


class _Trial(NamedTuple):
    """A possible clock, tried.

    Attributes:
        clock: with its unit.
        time_s: (N,) its stamps, without missing ones and repeated rows.
        note: reason, doubt and question about its unit.
        sampling: sampling times if the stamps can be read; None otherwise.
        problem: why they cannot be read.
    """

    clock: Clock
    time_s: FloatArray
    note: Note
    sampling: Sampling | None
    problem: str

    @property
    def rank(self) -> tuple[float, float]:
        """Missing samples, and the scatter of the stamps in samples: less is better."""
        assert self.sampling is not None
        number = self.sampling.number
        line = self.sampling.t0_s + (number + 1) / self.sampling.rate_hz
        scatter = float(np.std(self.time_s - line)) * self.sampling.rate_hz
        return float(number[-1] + 1 - len(number)), round(scatter, 1)

    @property
    def mean_hz(self) -> float:
        """The rate of the mean step, Hz; 0 if the stamps do not increase."""
        span_s = float(self.time_s[-1] - self.time_s[0])
        return (len(self.time_s) - 1) / span_s if span_s > 0 else 0.0

    @property
    def resolution_s(self) -> float:
        """The longest step that occurs again and again, s: that of coarse stamps or of bursts."""
        return float(np.sort(np.diff(self.time_s))[-min(_WINDOWS, len(self.time_s) - 1)])

    @property
    def is_even(self) -> bool:
        """Whether all parts of the record have the same mean step, so that no sample is missing."""
        if np.diff(self.time_s).min() < 0 or len(self.time_s) < 4 * _WINDOWS or not self.mean_hz:
            return False
        ends = np.linspace(0, len(self.time_s) - 1, _WINDOWS + 1).astype(int)
        spans_s = np.diff(self.time_s[ends])
        coarse_s = self.resolution_s
        even_s = np.diff(ends) / self.mean_hz
        return bool((np.abs(spans_s - even_s) < _EVEN * even_s + coarse_s).all())


def find_timing(
    path: Path,
    clocks: Sequence[Clock],
    values: Mapping[str, FloatArray],
    samples: Sequence[FloatArray],
    row_number: Callable[[int], int],
    unread: str = "",
) -> Timing:
    """Find the timing of a file.

    Args:
        path: the file, for messages.
        clocks: possible time columns.
        values: (T,) values by column, in its unit, nan if missing.
        samples: (T,) values of the sensors, to recognise repeated rows.
        row_number: function of sample k that returns its row, for messages.
        unread: message about a column of times in another format; "" for none.

    Raises:
        InputError: no column can be read, and one that is named as time runs backward.
    """
    trials = [
        trial
        for clock in clocks
        if not is_counter(clock.name)
        and (trial := _try_clock(path, clock, values, samples, row_number)) is not None
    ]
    readable = [trial for trial in trials if trial.sampling is not None]
    if readable:
        named = {clock.name for clock in clocks if clock.unit[0]}

        def rank(trial: _Trial) -> tuple[object, ...]:  # a T that rises evenly may be a temperature
            return *trial.rank, trial.clock.name not in named, len(trial.clock.name) == 1

        best = min(readable, key=rank)
        return _readable_timing(best, [trial for trial in trials if trial is not best])
    for trial in trials:
        if trial.is_even and not trial.note.question:
            return _mean_timing(trial)
    for trial in trials:
        steps = np.diff(trial.time_s)
        if (steps < 0).sum() > (steps > 0).sum() and find_clocks([trial.clock.name]):
            raise InputError(f"{trial.problem} (sort the rows, or split the file there)")
    problems = [unread, *(trial.problem.removeprefix(f"{path}: ") for trial in trials)]
    question = "; ".join(filter(None, problems)) or "no column has times"
    rates = [
        rate for trial in trials if _POSSIBLE_HZ[0] < (rate := trial.mean_hz) < _POSSIBLE_HZ[1]
    ]
    if rates:
        question += f"; the mean step would give {' or '.join(f'{rate:.6g}' for rate in rates)} Hz"
    assumed_hz = rates[0] if rates else _PLACEHOLDER_HZ
    question += f": give the true rate; times in this file assume {assumed_hz:.6g} Hz"
    return Timing(None, assumed_hz, {"rate_hz": Note("Hz", "", question)})


def _try_clock(
    path: Path,
    clock: Clock,
    values: Mapping[str, FloatArray],
    samples: Sequence[FloatArray],
    row_number: Callable[[int], int],
) -> _Trial | None:
    """Try a possible clock; None if it has less than two stamps."""
    stamps = values[clock.name]
    steps = np.diff(stamps[np.isfinite(stamps)])
    if not steps.any():
        problem = f"{path}: column {clock.name!r}: its stamps do not change"
        return _Trial(clock, np.zeros(2), Note(""), None, problem)
    if clock.fraction or clock.unit[0] == "iso":
        note = Note("seconds and their fraction" if clock.fraction else "dates or times of day")
    else:
        clock, note = _find_unit(clock, steps)
    layout = with_clock(RecordLayout("csv"), clock)
    columns = [values[name].copy() for name in (clock.name, clock.fraction) if name]
    time_s = combine_times(columns, layout)
    kept = np.isfinite(time_s) & ~find_repeated_rows(time_s, samples)
    rows, time_s = np.flatnonzero(kept), time_s[kept]
    if len(time_s) < 2:
        return None
    try:
        sampling = find_sampling(str(path), layout, time_s, lambda k: row_number(int(rows[k])))
    except InputError as error:
        return _Trial(clock, time_s, note, None, str(error).partition(" (drop time_column")[0])
    if sampling.number[-1] > _MAX_SPARSENESS * len(time_s):
        problem = f"{path}: column {clock.name!r}: its stamps come in bursts, or most are missing"
        return _Trial(clock, time_s, note, None, problem)
    return _Trial(clock, time_s, note, sampling, "")


def _find_unit(clock: Clock, steps: FloatArray) -> tuple[Clock, Note]:
    """Return a clock with the unit that its name, or else the rates of IMUs, indicate."""
    span = float(np.abs(steps).sum())
    step = span / len(steps)  # the mean is right for coarse stamps and for bursts, too
    median = float(np.median(steps))
    if abs(median - step) < 0.2 * step:  # unlike the mean it is right despite gaps
        step = median
    rates = {(unit, 1.0): 1 / (step * f) for unit, f in TIME_UNITS.items() if unit != "iso"}
    usual = [unit for unit, rate in rates.items() if _USUAL_HZ[0] <= rate <= _USUAL_HZ[1]]
    lengths = {unit: span * TIME_UNITS[unit[0]] for unit in rates}
    usual.sort(key=lambda unit: not _SHORTEST_S <= lengths[unit] <= _LONGEST_S)

    def describe(unit: tuple[str, float]) -> str:
        step_text = f"steps of {float(f'{step * unit[1]:.4g}'):g} {unit[0]}"
        return f"{step_text}: {1 / (step * TIME_UNITS[unit[0]] * unit[1]):.4g} Hz"

    named = clock.unit
    if named[0]:
        named_hz = 1 / (step * TIME_UNITS[named[0]] * named[1])
        if _POSSIBLE_HZ[0] <= named_hz <= _POSSIBLE_HZ[1] or not usual:
            return clock, Note(describe(named))
        doubt = f"the name states {named[0]}, which would be {named_hz:.3g} samples per second"
        return clock._replace(unit=usual[0]), Note(describe(usual[0]), doubt)
    likely = [
        unit
        for unit, rate in rates.items()
        if _POSSIBLE_HZ[0] <= rate <= _POSSIBLE_HZ[1] and lengths[unit] >= 1.0
    ] or [("s", 1.0)]
    if usual and (lengths[usual[0]] >= _SHORTEST_S or likely == usual):
        return clock._replace(unit=usual[0]), Note(describe(usual[0]))
    evidence = "; ".join(
        f'"{unit[0]}": {describe(unit)} over {lengths[unit]:.3g} s' for unit in likely
    )
    question = f"neither the name {clock.name!r} nor a usual rate gives the unit: {evidence}"
    return clock._replace(unit=likely[0]), Note("", "", question)


def _readable_timing(best: _Trial, others: Sequence[_Trial]) -> Timing:
    assert best.sampling is not None
    rejected = [
        f"{trial.clock.name!r} "
        + ("scatters more" if trial.sampling is not None else "cannot be read as such")
        for trial in others
        if trial.sampling is None or trial.rank > best.rank
    ]
    reason = "it increases from row to row; the stamps are taken for the ends of the samples"
    if rejected:
        reason += f"; {', '.join(rejected)}"
    notes = {"time_column": Note(reason), "time_unit": best.note}
    return Timing(best.clock, best.sampling.rate_hz, notes)


def _mean_timing(trial: _Trial) -> Timing:
    """Return the timing by the mean step of stamps that cannot be read one by one."""
    rate = trial.mean_hz
    steps = np.diff(trial.time_s)
    if abs(round(rate) - rate) <= rate * trial.resolution_s / math.fsum(steps):
        rate = float(round(rate))  # within the resolution of the stamps
    kind = "coarse" if (steps == 0).any() else "uneven"
    doubt = (
        f"the stamps of {trial.clock.name!r} are too {kind} to be read one by one, so they are"
        " ignored and times count from the beginning of the record; their mean step over"
        f" {math.fsum(steps):.4g} s gives this rate: write the true one here"
    )
    return Timing(None, rate, {"rate_hz": Note("Hz", doubt)})

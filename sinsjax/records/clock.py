"""Detection of the time column of a file without a description, with its unit and rate."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from sinsjax.errors import InputError
from sinsjax.records.column_names import Clock, find_clocks, is_counter
from sinsjax.records.layout import TIME_UNITS, FloatArray, Note

_FASTEST_S, _SLOWEST_S = (
    0.5e-3,
    0.5,
)  # range of sample intervals of IMUs, less than a factor of 1000
_PLACEHOLDER_HZ = 100.0
_MAX_COARSENESS = 0.01  # of the span, which limits the error of their mean rate

EXAMINED_S = 300.0
"""Length of a record that is examined to find its units, axes and rate, s."""


class Timing(NamedTuple):
    """Timing of a file.

    Attributes:
        clock: the time column with its unit, or None.
        rate_hz: sample rate, Hz; a placeholder if unknown.
        is_known: whether the file determines the rate.
        notes: reasons and doubts by key of the layout.
    """

    clock: Clock | None
    rate_hz: float
    is_known: bool
    notes: dict[str, Note]


def find_timing(
    path: Path, times: Mapping[Clock, FloatArray], row_number: Callable[[int], int]
) -> Timing:
    """Timing of a file.

    Args:
        path: the file, for messages.
        times: (T,) values of each possible time column, in its unit, nan if missing.
        row_number: function of sample k that returns its row, for messages.

    Raises:
        InputError: none increases, and a column named as time decreases; names the row.
    """
    candidates = {clock: values for clock, values in times.items() if not is_counter(clock.name)}
    columns = [_Column(clock, values, row_number) for clock, values in candidates.items()]
    for column in columns:
        if timing := column.read_timing():
            return timing
    for column in columns:
        if timing := column.average_timing():
            return timing
    for column in columns:
        if column.decreases.size and find_clocks([column.clock.name]):
            column.raise_backward_error(path)
    reason = next((column.describe_repeat() for column in columns if column.repeats.size), "")
    doubt = f"{reason or 'no column has times'}, so the rate is unknown: write it here, and remove"
    doubt += f" the comment mark; times in this file assume {_PLACEHOLDER_HZ:g} Hz"
    return Timing(None, _PLACEHOLDER_HZ, False, {"rate_hz": Note("", doubt)})


class _Column:
    """A possible time column.

    Attributes:
        clock: its name, and the unit in its name.
        decreases: indices of finite values that are less than the preceding one.
        repeats: indices of finite values that equal the preceding one.
    """

    def __init__(self, clock: Clock, values: FloatArray, row_number: Callable[[int], int]) -> None:
        self.clock, self._row_number = clock, row_number
        self._samples = np.flatnonzero(np.isfinite(values))
        self._finite_values = values[self._samples]
        self._steps = np.diff(self._finite_values)
        self.decreases = np.flatnonzero(self._steps < 0) + 1
        self.repeats = np.flatnonzero(self._steps == 0) + 1

    def read_timing(self) -> Timing | None:
        """Return the timing of increasing stamps from their median step; None otherwise."""
        steps = self._steps
        if not len(steps) or np.mean(steps > 0) < 0.99:
            return None
        step = float(np.median(steps))
        unit, doubt = self._find_unit(step)
        if not unit:
            return None
        rate = 1 / (step * TIME_UNITS[unit])
        description = (
            "dates with time" if unit == "iso" else f"steps of {float(f'{step:.4g}'):g} {unit}"
        )
        assumption = "the stamps are taken for the ends of the samples"
        notes = {
            "time_column": Note(f"it increases from row to row; {assumption}"),
            "time_unit": Note(f"{description}: {rate:.4g} Hz", doubt),
        }
        return Timing(Clock(self.clock.name, unit), rate, True, notes)

    def average_timing(self) -> Timing | None:
        """Return the timing of coarse stamps, which repeat but never decrease, from their mean."""
        values = self._finite_values
        if self.decreases.size or len(values) < 2 or values[-1] == values[0]:
            return None
        unit, _ = self._find_unit(float(np.ptp(values)) / (len(values) - 1))
        if not unit:
            return None
        factor = TIME_UNITS[unit]
        last = int(np.searchsorted(values, values[0] + EXAMINED_S / factor, side="right")) - 1
        span_s = float(values[last] - values[0]) * factor
        coarse_s = float(self._steps[self._steps > 0].min()) * factor
        if coarse_s > _MAX_COARSENESS * span_s:
            return None
        rate = last / span_s
        if abs(round(rate) - rate) <= rate * coarse_s / span_s:
            rate = float(round(rate))  # within the resolution of the stamps
        doubt = f"{self.describe_repeat()}: its stamps are too coarse, so it is ignored and"
        doubt += " times count from the beginning of the record; the mean step over"
        doubt += f" {span_s:.4g} s gives this rate: write the true one here"
        return Timing(None, rate, True, {"rate_hz": Note("Hz", doubt)})

    def describe_repeat(self) -> str:
        """Return the first repetition as text."""
        return (
            f"{self.clock.name!r} repeats itself at row {self._row_in_file(int(self.repeats[0]))}"
        )

    def raise_backward_error(self, path: Path) -> NoReturn:
        """Raise the error of a column that decreases."""
        k = int(self.decreases[0])
        place = f"{path}: column {self.clock.name!r}: row {self._row_in_file(k)}"
        before, after = self._finite_values[k - 1 : k + 1].tolist()
        text = f"time runs backward, from {before!r} to {after!r}"
        raise InputError(f"{place}: {text} (sort the rows, or split the file there)")

    def _row_in_file(self, place: int) -> int:
        return self._row_number(int(self._samples[place]))

    def _find_unit(self, step: float) -> tuple[str, str]:
        """Return the unit in which a step is plausible for an IMU, "" for none, and its doubt."""
        named_unit = self.clock.unit
        plausible = list(_plausible_units(step))
        unit = named_unit if named_unit in (*plausible, "iso") or not plausible else plausible[0]
        if not unit:
            return "", ""
        rate = 1 / (step * TIME_UNITS[unit])
        if named_unit and unit != named_unit:
            named_rate = 1 / (step * TIME_UNITS[named_unit])
            return (
                unit,
                f"the name states {named_unit}, which would be {named_rate:.3g} samples per second",
            )
        if not plausible and unit != "iso":
            return unit, f"{rate:.3g} samples per second are unusual"
        return unit, ""


def _plausible_units(step: float) -> Iterator[str]:
    for unit, factor in TIME_UNITS.items():
        if unit != "iso" and _FASTEST_S <= step * factor < _SLOWEST_S:
            yield unit

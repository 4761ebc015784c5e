"""Which column of a file that nobody described tells the time, in what unit, and at what rate."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from sinsjax.errors import InputError
from sinsjax.records.layout import TIME_UNITS, FloatArray, Note
from sinsjax.records.names import Clock, clocks, is_counter

_FASTEST_S, _SLOWEST_S = 0.5e-3, 0.5  # steps of inertial units: a factor of 1000, as between units
_STAND_IN_HZ = 100.0
_COARSEST = 0.01  # of the span: their mean tells the rate to as much

LOOKED_AT_S = 300.0
"""Of a record, to find its units, axes and rate."""


class Timing(NamedTuple):
    """What a file tells of its times.

    Attributes:
        clock: the column of time with its unit, or None.
        rate_hz: sample rate, Hz; one that stands for it where nothing tells it.
        known: whether the file tells the rate.
        notes: by key of the layout.
    """

    clock: Clock | None
    rate_hz: float
    known: bool
    notes: dict[str, Note]


def timing_of(path: Path, times: Mapping[Clock, FloatArray], row: Callable[[int], int]) -> Timing:
    """What a file tells of its times.

    Args:
        path: the file, for messages.
        times: (T,) of each column that may hold them, in its unit, nan where missing.
        row: the row to name in a message about sample k.

    Raises:
        InputError: none increases, and one that is named as time decreases; names the row.
    """
    maybe = {clock: values for clock, values in times.items() if not is_counter(clock.name)}
    columns = [_Column(clock, values, row) for clock, values in maybe.items()]
    for column in columns:
        if timing := column.read():
            return timing
    for column in columns:
        if timing := column.averaged():
            return timing
    for column in columns:
        if column.decreases.size and clocks([column.clock.name]):
            column.refuse(path)
    why = next((column.repeating() for column in columns if column.repeats.size), "")
    doubt = f"{why or 'no column holds times'}, so nothing tells the rate: put it here, and take"
    doubt += f" the mark away; seconds in this file are those of {_STAND_IN_HZ:g} Hz"
    return Timing(None, _STAND_IN_HZ, False, {"rate_hz": Note("", doubt)})


class _Column:
    """A column that may hold times.

    Attributes:
        clock: its name, and the unit that its name tells.
        decreases: places among its finite values before which it decreases.
        repeats: likewise, repeats itself.
    """

    def __init__(self, clock: Clock, values: FloatArray, row: Callable[[int], int]) -> None:
        self.clock, self._row = clock, row
        self._samples = np.flatnonzero(np.isfinite(values))
        self._known = values[self._samples]
        self._steps = np.diff(self._known)
        self.decreases = np.flatnonzero(self._steps < 0) + 1
        self.repeats = np.flatnonzero(self._steps == 0) + 1

    def read(self) -> Timing | None:
        """Of a column that can be read as the time: its median step tells unit and rate."""
        steps = self._steps
        if not len(steps) or np.mean(steps > 0) < 0.99:
            return None
        step = float(np.median(steps))
        unit, doubt = self._unit(step)
        if not unit:
            return None
        rate = 1 / (step * TIME_UNITS[unit])
        told = "dates with time" if unit == "iso" else f"steps of {float(f'{step:.4g}'):g} {unit}"
        ends = "the stamps are taken for the ends of the samples"
        notes = {
            "time_column": Note(f"it increases from row to row; {ends}"),
            "time_unit": Note(f"{told}: {rate:.4g} Hz", doubt),
        }
        return Timing(Clock(self.clock.name, unit), rate, True, notes)

    def averaged(self) -> Timing | None:
        """Of stamps that are too coarse, so that they repeat but never decrease: their mean."""
        known = self._known
        if self.decreases.size or len(known) < 2 or known[-1] == known[0]:
            return None
        unit, _ = self._unit(float(np.ptp(known)) / (len(known) - 1))
        if not unit:
            return None
        factor = TIME_UNITS[unit]
        last = int(np.searchsorted(known, known[0] + LOOKED_AT_S / factor, side="right")) - 1
        span_s = float(known[last] - known[0]) * factor
        coarse_s = float(self._steps[self._steps > 0].min()) * factor
        if coarse_s > _COARSEST * span_s:
            return None
        rate = last / span_s
        if abs(round(rate) - rate) <= rate * coarse_s / span_s:
            rate = float(round(rate))  # the stamps cannot tell it from that
        doubt = f"{self.repeating()}: its stamps are too coarse to be read and it is left out, so"
        doubt += " that times count from the beginning of the record; their mean over"
        doubt += f" {span_s:.4g} s tells this rate: put the true one here"
        return Timing(None, rate, True, {"rate_hz": Note("Hz", doubt)})

    def repeating(self) -> str:
        """Where it repeats itself first, in words."""
        return f"{self.clock.name!r} repeats itself at row {self._row_of(int(self.repeats[0]))}"

    def refuse(self, path: Path) -> NoReturn:
        """Raise the error of a column that decreases."""
        k = int(self.decreases[0])
        where = f"{path}: column {self.clock.name!r}: row {self._row_of(k)}"
        before, after = self._known[k - 1 : k + 1].tolist()
        text = f"time runs backward, from {before!r} to {after!r}"
        raise InputError(f"{where}: {text} (sort the rows, or split the file there)")

    def _row_of(self, place: int) -> int:
        return self._row(int(self._samples[place]))

    def _unit(self, step: float) -> tuple[str, str]:
        """The unit in which a step is one of an inertial unit, "" for none, and its doubt."""
        named = self.clock.unit
        fits = list(_fitting(step))
        unit = named if named in (*fits, "iso") or not fits else fits[0]
        if not unit:
            return "", ""
        rate = 1 / (step * TIME_UNITS[unit])
        if named and unit != named:
            there = 1 / (step * TIME_UNITS[named])
            return (
                unit,
                f"the name tells {named}, in which there would be {there:.3g} samples a second",
            )
        if not fits and unit != "iso":
            return unit, f"{rate:.3g} samples a second are unusual"
        return unit, ""


def _fitting(step: float) -> Iterator[str]:
    for unit, factor in TIME_UNITS.items():
        if unit != "iso" and _FASTEST_S <= step * factor < _SLOWEST_S:
            yield unit

"""The study: its sections, the axes it sweeps, the variants that they span.

The rules between its keys stand in `rules`.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any, NamedTuple

from pydantic import BaseModel, ConfigDict

from sinsjax.sections import (
    Alignment,
    Coarse,
    Compass,
    Earth,
    Filter,
    Motion,
    Passes,
    Record,
    Report,
    Resets,
    Section,
    Sensors,
    Settings,
    Statements,
)

SECTIONS: dict[str, type[Section]] = {
    "study": Settings,
    "earth": Earth,
    "motion": Motion,
    "sensors": Sensors,
    "alignment": Alignment,
    "filter": Filter,
    "resets": Resets,
    "compass": Compass,
    "passes": Passes,
    "record": Record,
    "coarse": Coarse,
    "report": Report,
    "statements": Statements,
}
"""Every section of leaf keys by its name in the file."""

SWEEPABLE = (
    "earth",
    "motion",
    "sensors",
    "alignment",
    "filter",
    "resets",
    "compass",
    "passes",
)
"""The sections whose keys may be axes."""

SIMULATED_ONLY = ("motion", "sensors")
"""The sections that have no place in a recorded study."""

SECTION_OF = {key: name for name, model in SECTIONS.items() for key in model.model_fields}
"""The section of every leaf key."""

EARTH_CONSTANTS = {
    "gravity_m_per_s2": 9.8,
    "radius_m": 6378137.0,
    "earth_rate_deg_per_h": 15.041067,
}
"""The keys of [earth] that only ``earth = "constants"`` has, with their defaults."""

PASS_KEYS = ("tape_s", "passes", "ending")
"""The keys that decide which sample of the tape an update reads, and how many there are."""

ROUNDING = 1e-9
"""Relative; how far a product of two decimal numbers may be off."""


class Span(NamedTuple):
    """How long a variant runs, in record intervals.

    Attributes:
        records: in the run.
        tape: in a pass over its tape; all of the run where it is gone over once.
    """

    records: int
    tape: int

    @property
    def read(self) -> int:
        """Record intervals of data that the run reads."""
        return min(self.records, self.tape)


class Study(BaseModel):
    """A checked study: its sections with all defaults filled in, its axes and its cases.

    A variant is one point of the sweep: cases outermost, then the axes as written, the last one
    fastest. A section that does not apply is None: ``motion`` and ``sensors`` of a recorded study,
    ``record`` and ``coarse`` of a simulated one, ``filter``, ``resets`` and ``compass`` where no
    method reads them, ``passes`` where no tape is gone over again. So is a key that does not apply,
    such as ``gravity_m_per_s2`` where no variant has constants.

    Attributes:
        axes: values by leaf key, in the order written.
        cases: one table of leaf keys a case, all with the same keys, ``case`` being its label.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    study: Settings
    earth: Earth
    motion: Motion | None = None
    sensors: Sensors | None = None
    alignment: Alignment
    filter: Filter | None = None
    resets: Resets | None = None
    compass: Compass | None = None
    passes: Passes | None = None
    record: Record | None = None
    coarse: Coarse | None = None
    report: Report
    statements: Statements
    axes: dict[str, tuple[Any, ...]]
    cases: tuple[dict[str, Any], ...]

    @property
    def is_recorded(self) -> bool:
        """Whether the sensors come from a record and not from a simulation."""
        return self.record is not None

    @property
    def n_draws(self) -> int:
        """Number of sensor realisations: noise draws, or the start times in a record."""
        return len(self.record.start_s) if self.record else self.study.draws or 1

    @property
    def n_variants(self) -> int:
        """Number of points of the sweep; 1 without axes and cases."""
        return (len(self.cases) or 1) * math.prod(map(len, self.axes.values()))

    @property
    def record_every(self) -> int:
        """Samples in a record interval."""
        return round(self.study.record_interval_s * self.study.rate_hz)

    @property
    def records(self) -> int:
        """Whole record intervals in the duration; a last partial one is not run."""
        samples = self.study.duration_s * self.study.rate_hz
        return math.floor(samples * (1 + ROUNDING)) // self.record_every

    @property
    def spans(self) -> list[Span]:
        """How long every variant runs."""
        if self.passes is None:
            return [self.span()] * self.n_variants
        return [self.span(*values) for values in zip(*map(self.values, PASS_KEYS), strict=True)]

    @property
    def distinct_spans(self) -> set[Span]:
        """How long variants run, each length once, from the axes alone."""
        points = self.combinations(*PASS_KEYS) if self.passes else [{}]
        return {self.span(**point) for point in points}

    def span(
        self, tape_s: float | None = None, passes: int | None = None, ending: str = "duration"
    ) -> Span:
        """How long a variant with some values of `PASS_KEYS` runs."""
        if tape_s is None:
            return Span(self.records, self.records)
        tape = max(1, round(tape_s * self.study.rate_hz / self.record_every))
        if passes is None:
            whole = self.records // tape
            passes = whole - (whole + 1) % 2 if ending == "forward" else None
        return Span(self.records if passes is None else passes * tape, tape)

    @property
    def run_s(self) -> float:
        """Length of the shortest run, whole record intervals, s."""
        return min(s.records for s in self.distinct_spans) * self.record_every / self.study.rate_hz

    @property
    def dropped_s(self) -> float:
        """Length of the last partial record interval, which is not run, s."""
        left = self.study.duration_s - self.records * self.record_every / self.study.rate_hz
        return left if left > ROUNDING * self.study.duration_s else 0.0

    def reset_times(self) -> list[tuple[float, ...]]:
        """Reset times of every variant, s."""
        if self.resets is None:
            return [()] * self.n_variants
        keys = ("reset_times_s", "reset_count", "reset_cycle_s")
        return [
            tuple((i + 1) * cycle for i in range(count or 0)) if times is None else tuple(times)
            for times, count, cycle in zip(*map(self.values, keys), strict=True)
        ]

    @property
    def axis_keys(self) -> tuple[str, ...]:
        """Every key that varies: ``case`` if labelled, the keys of the cases, the axes."""
        keys = dict.fromkeys(self.cases[0] if self.cases else ())
        label = ("case",) if "case" in keys else ()
        return (*label, *(key for key in keys if key != "case"), *self.axes)

    def variant_values(self) -> dict[str, list[Any]]:
        """The values of every axis key, one a variant, in variant order."""
        return {key: self._swept(key) for key in self.axis_keys}

    def values(self, key: str) -> list[Any]:
        """The values of a sweepable leaf key, one a variant, in the units of the file.

        Args:
            key: leaf key of a section in `SWEEPABLE`.

        Raises:
            KeyError: no sweepable section of this study has the key.
        """
        if key in self.axis_keys:
            return self._swept(key)
        return [self._constant(key)] * self.n_variants

    def combinations(self, *keys: str) -> Iterator[dict[str, Any]]:
        """The distinct values that sweepable keys take together over all variants."""
        fixed = {key: self._constant(key) for key in keys if key not in self.axis_keys}
        zipped = [key for key in keys if key in self.axis_keys and key not in self.axes]
        grid = [key for key in keys if key in self.axes]
        rows = dict.fromkeys(tuple(case[key] for key in zipped) for case in self.cases) or [()]
        for row, point in product(rows, product(*(self.axes[key] for key in grid))):
            yield fixed | dict(zip((*zipped, *grid), (*row, *point), strict=True))

    def _constant(self, key: str) -> Any:
        section = getattr(self, SECTION_OF[key])
        if SECTION_OF[key] not in SWEEPABLE or section is None:
            raise KeyError(key)
        return getattr(section, key)

    def _swept(self, key: str) -> list[Any]:
        if key in self.axes:
            values: Sequence[Any] = self.axes[key]
            names = list(self.axes)
            fastest = math.prod(len(self.axes[name]) for name in names[names.index(key) + 1 :])
        else:
            values = [case[key] for case in self.cases]
            fastest = math.prod(map(len, self.axes.values()))
        once = [value for value in values for _ in range(fastest)]
        return once * (self.n_variants // len(once))

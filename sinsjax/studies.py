"""The study: its sections, the axes it sweeps, the variants that they span.

Rules between keys are checked here, for every variant, over the distinct values that the keys of a
rule take together: a sweep of a million variants costs no more than its axes.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any, NoReturn

from pydantic import BaseModel, ConfigDict

from sinsjax.sections import (
    Alignment,
    Coarse,
    Earth,
    Filter,
    Motion,
    Record,
    Report,
    Resets,
    Section,
    Sensors,
    Settings,
    Statements,
)
from sinsjax.types import InputError

SECTIONS: dict[str, type[Section]] = {
    "study": Settings,
    "earth": Earth,
    "motion": Motion,
    "sensors": Sensors,
    "alignment": Alignment,
    "filter": Filter,
    "resets": Resets,
    "record": Record,
    "coarse": Coarse,
    "report": Report,
    "statements": Statements,
}
"""Every section of leaf keys by its name in the file."""

SWEEPABLE = ("earth", "motion", "sensors", "alignment", "filter", "resets")
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

Where = dict[str, str]
"""The table, in brackets, of every key that a file gives: that of the axes or cases if swept."""

RESET = "5 with resets"
CONDITIONS = ("1", "2", "3", "4", "5", RESET)
"""Paper 1's conditions; its layouts want the cases labelled ``condition 1`` and so on."""

_LAYOUT_CONDITIONS = {
    "paper1_conditions": CONDITIONS[:-1],
    "paper1_resets": ("1", "5", RESET),
    "paper1_readings": CONDITIONS,
}
_READINGS = ("q_reading", "r_reading", "feedback_interval_s")
_MAX_SAMPLES, _MAX_RUNS = 10**8, 10**9
_ROUNDING = 1e-9  # relative; how far a product of two decimal numbers may be off


class Study(BaseModel):
    """A checked study: its sections with all defaults filled in, its axes and its cases.

    A variant is one point of the sweep: cases outermost, then the axes as written, the last one
    fastest. A section that does not apply is None: ``motion`` and ``sensors`` of a recorded study,
    ``record`` and ``coarse`` of a simulated one. So is a key that does not apply, such as
    ``gravity_m_per_s2`` where no variant has constants.

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
    filter: Filter
    resets: Resets
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
        """Whole record intervals in the study; a last partial one is not run."""
        samples = self.study.duration_s * self.study.rate_hz
        return math.floor(samples * (1 + _ROUNDING)) // self.record_every

    @property
    def run_s(self) -> float:
        """Length that is run, whole record intervals, s."""
        return self.records * self.record_every / self.study.rate_hz

    @property
    def dropped_s(self) -> float:
        """Length of the last partial record interval, which is not run, s."""
        left = self.study.duration_s - self.run_s
        return left if left > _ROUNDING * self.study.duration_s else 0.0

    def reset_times(self) -> list[tuple[float, ...]]:
        """Reset times of every variant, s."""
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


def check_study(study: Study, where: Where) -> None:
    """Checks the rules between keys for every variant.

    Args:
        study: sections, axes and cases, each value checked.
        where: the keys that the file gives.

    Raises:
        InputError: ``[section] key: what is wrong (hint)``.
    """
    _check_required(study, where)
    _check_layout(study, where)
    _check_size(study, where)
    _check_intervals(study, where)
    _check_window(study, where)
    for point in study.combinations("reset_count", "reset_cycle_s", "reset_times_s"):
        if point["reset_times_s"] is not None:
            _check_times(study, where, point["reset_times_s"])
        elif point["reset_count"]:
            _check_cycle(study, where, point["reset_count"], point["reset_cycle_s"])


def _refuse(key: str, where: Where, text: str) -> NoReturn:
    raise InputError(f"{where.get(key, f'[{SECTION_OF[key]}]')} {key}: {text}")


def _check_required(study: Study, where: Where) -> None:
    """Refuses a key that is missing, or given for nothing, because of another key's value."""
    simulated = not study.is_recorded
    for key in ("latitude_deg", "yaw_center_deg") if simulated else ():
        if key not in where:
            description = SECTIONS[SECTION_OF[key]].model_fields[key].description
            _refuse(key, where, f"required ({description})")
    for angle in ("pitch", "roll", "yaw") if simulated else ():
        amplitude, period = f"{angle}_amplitude_deg", f"{angle}_period_s"
        if period not in where and any(p[amplitude] for p in study.combinations(amplitude)):
            _refuse(period, where, f"required where {amplitude} > 0")
    if all(point["earth"] != "constants" for point in study.combinations("earth")):
        for key in EARTH_CONSTANTS:
            if key in where:
                _refuse(key, where, "has no place without earth = 'constants'")


def _check_layout(study: Study, where: Where) -> None:
    """Refuses a study that the layout of its report cannot show."""
    layout = study.report.layout
    kind = "recorded" if layout == "car_test" else "simulated"
    if layout != "auto" and study.is_recorded != (kind == "recorded"):
        _refuse("layout", where, f"'{layout}' needs a {kind} study")
    labels = [case.get("case") for case in study.cases]
    for name in _LAYOUT_CONDITIONS.get(layout, ()):
        if f"condition {name}" not in labels:
            _refuse("layout", where, f"'{layout}' needs [[cases]] with case = 'condition {name}'")
    if layout == "paper1_readings":
        if not study.axes or not set(study.axes) <= set(_READINGS):
            _refuse("layout", where, f"'{layout}' needs [axes] among {', '.join(_READINGS)}")
    elif layout in _LAYOUT_CONDITIONS and study.n_variants > len(study.cases):
        _refuse("layout", where, f"'{layout}' takes no [axes] ({', '.join(study.axes)})")


def _check_size(study: Study, where: Where) -> None:
    """Refuses what no machine could run, from the lengths of the axes alone."""
    settings = study.study
    if settings.duration_s * settings.rate_hz > _MAX_SAMPLES * (1 + _ROUNDING):
        text = f"{settings.duration_s:.12g} s at rate_hz = {settings.rate_hz:.12g}"
        _refuse("duration_s", where, f"{text} is more than {_MAX_SAMPLES} samples a run")
    if study.n_draws * study.n_variants > _MAX_RUNS:
        key = "start_s" if study.is_recorded else "draws"
        text = f"{study.n_draws} draws x {study.n_variants} variants of [axes] and [[cases]]"
        _refuse(key, where, f"{text} are more than {_MAX_RUNS} runs")


def _check_intervals(study: Study, where: Where) -> None:
    """Refuses times that are no whole number of samples, and a study shorter than a record."""
    rate, record = study.study.rate_hz, study.study.record_interval_s
    _check_whole(study, where, "record_interval_s", record)
    for point in study.combinations("feedback_interval_s"):
        _check_whole(study, where, "feedback_interval_s", point["feedback_interval_s"])
    if study.coarse:
        _check_whole(study, where, "coarse_duration_s", study.coarse.coarse_duration_s, least=2)
    taken: dict[int, float] = {}
    for start in study.record.start_s if study.record else ():
        _check_whole(study, where, "start_s", start, least=0)
        if taken.setdefault(round(start * rate), start) != start:
            _refuse("start_s", where, f"{start!r} s falls on the sample of another start time")
    if study.study.duration_s < record * (1 - _ROUNDING):
        duration = f"duration_s = {study.study.duration_s:.12g}"
        _refuse("record_interval_s", where, f"{record:.12g} s is longer than the study, {duration}")


def _check_whole(study: Study, where: Where, key: str, time: float, *, least: int = 1) -> None:
    """Refuses a time that is no whole number of samples, or less than ``least`` of them."""
    rate, samples = study.study.rate_hz, time * study.study.rate_hz
    if abs(samples - round(samples)) > _ROUNDING * samples or round(samples) < least:
        whole = {max(least, math.floor(samples)), max(least, math.ceil(samples))}
        near = " or ".join(f"{n / rate:.12g}" for n in sorted(whole))
        more = f", {least} or more" if least > 1 else ""
        text = f"{time:.12g} s is no whole number of samples of {1 / rate:.12g} s{more}"
        _refuse(key, where, f"{text} (nearest: {near})")


def _check_window(study: Study, where: Where) -> None:
    """Refuses a window without a standard deviation: one of fewer than two record times."""
    (start, end), every, rate = study.study.window_s, study.record_every, study.study.rate_hz
    last = min(study.records, int(end * rate / every) + 1)
    # Compared as the engine does, rounding and all.
    while last * every / rate > end:
        last -= 1
    if (last - 1) * every / rate <= start:
        text = f"fewer than 2 records are after {start:.12g} s and up to {end:.12g} s"
        _refuse("window_s", where, f"{text} ({_end(study)})")


def _end(study: Study) -> str:
    """Where a study ends, in words."""
    after = f"; the last partial record interval, after {study.run_s:.12g} s, is not run"
    return f"duration_s = {study.study.duration_s:.12g}{after if study.dropped_s else ''}"


def _check_times(study: Study, where: Where, times: tuple[float, ...]) -> None:
    """Refuses explicit resets after the end, on the start, or two on one sample."""
    rate = study.study.rate_hz
    earlier, taken = 0.0, 0
    for time in times:
        if time > study.run_s * (1 + _ROUNDING):
            text = f"{time:.12g} s is after the study's end ({_end(study)})"
            _refuse("reset_times_s", where, text)
        sample = round(time * rate)
        if sample == taken:
            other = f"the reset at {earlier:.12g} s" if taken else "the start"
            text = f"{time:.12g} s falls on the sample of {other} ({1 / rate:.12g} s a sample)"
            _refuse("reset_times_s", where, text)
        earlier, taken = time, sample


def _check_cycle(study: Study, where: Where, count: int, cycle: float | None) -> None:
    """Refuses counted resets after the end, on the start, or two on one sample."""
    rate = study.study.rate_hz
    if cycle is None:
        _refuse("reset_cycle_s", where, f"required where reset_count > 0 (it is {count})")
    if count * cycle > study.run_s * (1 + _ROUNDING):
        key = "reset_cycle_s" if where.get("reset_count") == "[resets]" else "reset_count"
        text = f"{count} resets every {cycle:.12g} s last {count * cycle:.12g} s"
        _refuse(key, where, f"{text}, longer than the study ({_end(study)})")
    if cycle * rate < 1 - _ROUNDING:
        text = f"{cycle:.12g} s is shorter than a sample of {1 / rate:.12g} s"
        _refuse("reset_cycle_s", where, text)

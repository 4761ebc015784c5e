"""The study: its sections, its axes, and the variants that they span.

`load` builds a study from a file or tables, and checks all `rules`.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from operator import itemgetter
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, NoReturn

import numpy as np
from pydantic import create_model

from sinsjax.errors import InputError
from sinsjax.messages import format_count, format_facts
from sinsjax.methods.filters.keys import SCHEDULE_KEYS, scheduled_reset_times
from sinsjax.methods.method import INITIAL_KEYS
from sinsjax.methods.registry import SECTIONS_OF_METHODS
from sinsjax.study.changes import copy_tables
from sinsjax.study.keys import (
    COARSE_KEYS,
    PASS_KEYS,
    SECTION_OF,
    SECTIONS,
    SWEEPABLE,
    TomlTable,
    deciding_keys,
    has_effect,
)
from sinsjax.study.reset_schedules import DERIVED, LAW_KEYS, expand_named_schedule
from sinsjax.study.schema import (
    AlignmentSection,
    CoarseSection,
    EarthSection,
    MotionSection,
    PassesSection,
    RecordSection,
    SensorsSection,
    StopWhenSection,
    StudySection,
    TuneSection,
)
from sinsjax.study.sweep import CodedColumn, Sweep, iter_points, point_codes
from sinsjax.value_types import ROUNDING

_USER_NAMES = (
    *("axes", "axis_keys", "cases", "drawn_keys", "duration_s", "is_recorded"),
    *("methods", "n_draws", "n_variants", "name", "rate_hz", "replace", "seed", "to_dict"),
    *("values", "variant_values", "zips"),
)
"""Names of a study that users need, in addition to its sections."""

COARSE_START = ("coarse_method", "coarse_then")
"""Keys that determine whether a run starts with coarse alignment."""


class Span(NamedTuple):
    """The length of a variant's runs, and of a pass over its stored record, in record intervals."""

    records: int
    pass_records: int

    @property
    def records_read(self) -> int:
        """Record intervals of data that the run reads."""
        return min(self.records, self.pass_records)

    def pass_numbers(self) -> np.ndarray:
        """Return the number, from 1, of the pass of each record interval; (records,)."""
        return np.arange(self.records) // self.pass_records + 1


if TYPE_CHECKING:  # their attributes are read by name, after `Study.has`
    _SectionsOfMethods = Sweep
else:
    _SectionsOfMethods = create_model(
        "_SectionsOfMethods",
        __base__=Sweep,
        **{name: (section | None, None) for name, section in SECTIONS_OF_METHODS.items()},
    )


class Study(_SectionsOfMethods):
    """A checked study: its sections with all defaults, and what varies in it, see `Sweep`.

    A variant is one point of the sweep: cases outermost, then the zips, then the axes in the order
    of the file, the last one fastest. A section that does not apply is None: ``motion`` and
    ``sensors`` of a recorded study, ``record`` of a simulated one, those of methods if no method
    reads them, ``passes`` if the record is used once; also ``drawn``, ``stop_when``, ``tune`` and,
    in a simulated study, ``coarse`` if they are not given. A key that does not apply is None too,
    such as ``gravity_m_per_s2`` if no variant has constants.

    Examples:
        >>> study = sinsjax.load_study("reset_sweep")
        >>> study.n_variants, study.n_draws, study.axis_keys
        (448, 16, ('reset_count', 'reset_cycle_s', 'phi_u0_deg'))
        >>> study.alignment.method
        'kalman5'
    """

    study: StudySection
    earth: EarthSection
    motion: MotionSection | None = None
    sensors: SensorsSection | None = None
    alignment: AlignmentSection
    passes: PassesSection | None = None
    record: RecordSection | None = None
    coarse: CoarseSection | None = None
    stop_when: StopWhenSection | None = None
    tune: TuneSection | None = None

    from_tables: ClassVar[Callable[[TomlTable, str, Mapping[str, Any]], "Study"]]
    """Function of tables, a name and changes, which `load` sets."""

    def replace(self, changes: Mapping[str, Any]) -> "Study":
        """Return the study with some values changed, and the defaults that depend on these.

        Args:
            changes: values by ``section.key``, such as ``{"alignment.phi_u0_deg": 12.0}``; each
                replaces the value, the axis and the distribution of the key in the study;
                ``cases`` replaces all cases.

        Raises:
            InputError: the result is not a valid study.

        Examples:
            >>> study = sinsjax.load_study("reset_sweep")
            >>> study.n_variants, study.replace({"alignment.phi_u0_deg": 12.0}).n_variants
            (448, 56)
        """
        return type(self).from_tables(self.to_dict(), self.name, changes)

    def to_dict(self) -> TomlTable:
        """Return the study as nested tables, as in its TOML file: the keys that it gives.

        `study_from_dict` makes an equal study of them.

        Examples:
            >>> study = sinsjax.load_study("reset_sweep")
            >>> study.to_dict()["alignment"]["phi_e0_deg"]
            5.0
            >>> sinsjax.study_from_dict(study.to_dict()) == study
            True
        """
        tables: TomlTable = copy_tables(study_to_tables(self, exclude_unset=True))
        return tables

    def __repr__(self) -> str:
        """Return five short lines: runs, axes, method and length."""
        return format_facts(f"Study {self.name}", self.facts)

    __str__ = __repr__

    def __dir__(self) -> list[str]:
        """Return the names that a user needs, for the completion of interactive sessions."""
        return sorted((*_USER_NAMES, *(name for name in SECTIONS if self.has(name))))

    @property
    def facts(self) -> dict[str, str]:
        """Runs, axes, methods and length of runs, in words."""
        variants = format_count(self.n_variants, "variant")
        draws = format_count(self.n_draws, "start time" if self.is_recorded else "draw")
        runs = f"{variants} x {draws} = {format_count(self.n_draws * self.n_variants, 'run')}"
        axes = (f"{', '.join(keys)} ({len(values)})" for keys, values in self.axes_shown.items())
        rate = f"{self.rate_hz:g} Hz" if self.rate_hz else "the rate of its record"
        several = len(self.methods) > 1
        return {
            "runs": runs,
            "axes": "; ".join(axes) or "none",
            "methods" if several else "method": ", ".join(self.methods),
            "length": f"{self.duration_s:g} s at {rate}",
        }

    @property
    def name(self) -> str:
        """Name of the study."""
        return self.study.name

    @property
    def rate_hz(self) -> float:
        """Sample rate, Hz; None until the record of a recorded study is read."""
        return self.study.rate_hz

    @property
    def duration_s(self) -> float:
        """Length of a run, s."""
        return self.study.duration_s

    @property
    def seed(self) -> int:
        """Seed of all random numbers."""
        return self.study.seed

    @property
    def is_recorded(self) -> bool:
        """Return whether the sensor data are from a record instead of a simulation."""
        return self.record is not None

    @property
    def n_draws(self) -> int:
        """Number of draws, or of start times in a record; with ``stop_when`` the maximum."""
        return len(self.record.start_s) if self.record else self.study.draws or 1

    @property
    def n_variants(self) -> int:
        """Number of points of the sweep; 1 without a sweep."""
        return math.prod(len(next(iter(dimension.values()))) for dimension in self.dimensions)

    @property
    def record_every(self) -> int:
        """Samples per record interval."""
        return round(self.study.record_interval_s * self.rate_hz)

    @property
    def records(self) -> int:
        """Number of whole record intervals in the duration; a last partial one is not run."""
        samples = self.duration_s * self.rate_hz
        return math.floor(samples * (1 + ROUNDING)) // self.record_every

    @property
    def lengths(self) -> CodedColumn:
        """The length of each variant's runs, as a column of `Span`."""
        return self._points(PASS_KEYS if self.passes else ()).map(lambda values: self.span(*values))

    @property
    def distinct_spans(self) -> set[Span]:
        """The distinct lengths of the variants' runs, from the axes alone."""
        points = self.combinations(*(PASS_KEYS if self.passes else ()))
        return {self.span(**point) for point in points}

    def span(
        self,
        stored_s: float | None = None,
        passes: int | None = None,
        ending: str = "duration",
    ) -> Span:
        """Return the length of the runs of a variant with some values of `PASS_KEYS`."""
        if stored_s is None:
            return Span(self.records, self.records)
        pass_records = max(1, round(stored_s * self.rate_hz / self.record_every))
        if passes is None:
            whole_passes = self.records // pass_records
            backward_last = (whole_passes + 1) % 2
            passes = whole_passes - backward_last if ending == "forward" else None
        records = self.records if passes is None else passes * pass_records
        return Span(records, pass_records)

    @property
    def spans_s(self) -> np.ndarray:
        """Length of each variant's runs and of a pass over its stored record, s; (variants, 2)."""
        lengths = self.lengths.compute(lambda span: (span.records, span.pass_records), int)
        return lengths * self.record_every / self.rate_hz

    def update_times(self, span: Span) -> np.ndarray:
        """Return the update time of each record time of a run, from its start, s; (records,)."""
        return np.arange(1, span.records + 1) * self.record_every / self.rate_hz

    def stored_times(self, span: Span) -> np.ndarray:
        """Return the position in the stored record of each record time, s from its beginning."""
        position = np.arange(span.records) % span.pass_records + 1
        position = np.where(span.pass_numbers() % 2 == 1, position, span.pass_records - position)
        return position * self.record_every / self.rate_hz

    def samples_before(
        self, rate_hz: float, coarse_method: str, coarse_duration_s: float, coarse_then: str | None
    ) -> int:
        """Return the number of samples that are coarsely aligned before a run starts.

        The values are those of `COARSE_KEYS`; ``rate_hz`` is the rate of the record.
        """
        is_stage = self.has_coarse_stage(coarse_method, coarse_then)
        return 0 if is_stage else round(coarse_duration_s * rate_hz)

    @property
    def counts_before(self) -> bool:
        """Whether data before t = 0 count, as other runs start at the first sample of data."""
        return self.is_recorded and bool(self.coarse_stages)

    @property
    def report_times_s(self) -> tuple[float, ...]:
        """Times of data at which runs are reported in addition to their end, s."""
        return self.study.report_times_s or ()

    def has_coarse_stage(self, coarse_method: str, coarse_then: str | None) -> bool:
        """Return whether coarse alignment is a stage of runs; handing over, it precedes them."""
        return coarse_method != "none" and (not self.is_recorded or coarse_then == "replay")

    @property
    def coarse_stages(self) -> tuple[dict[str, Any], ...]:
        """Combinations of the values of `COARSE_KEYS` with coarse alignment as a stage of runs."""
        if self.coarse is None:
            return ()
        points = self.combinations(*COARSE_KEYS)
        return tuple(p for p in points if self.has_coarse_stage(*(p[key] for key in COARSE_START)))

    @property
    def run_s(self) -> float:
        """Length of the shortest run in whole record intervals, s."""
        return min(s.records for s in self.distinct_spans) * self.record_every / self.study.rate_hz

    @property
    def dropped_s(self) -> float:
        """Length of the last partial record interval, which is not run, s."""
        remainder_s = self.duration_s - self.records * self.record_every / self.rate_hz
        return remainder_s if remainder_s > ROUNDING * self.duration_s else 0.0

    def has(self, section: str) -> bool:
        """Return whether it has a section; otherwise the keys of the section must not be read."""
        return getattr(self, section) is not None

    @property
    def methods(self) -> tuple[str, ...]:
        """The distinct methods of its variants."""
        return tuple(point["method"] for point in self.combinations("method"))

    @property
    def schedules(self) -> CodedColumn:
        """Times of the scheduled resets of each variant, s."""
        points = self._points(SCHEDULE_KEYS if self.has("resets") else ())
        return points.map(lambda values: scheduled_reset_times(*values) if values else ())

    def reset_times(self) -> list[tuple[float, ...]]:
        """Return the reset times of each variant, s."""
        return self.schedules.to_list()

    def is_active(self, *keys: str) -> bool:
        """Return whether one of some keys is drawn, or not zero in some variant."""
        return any(
            key in self.drawn_keys or any(np.any(p[key] or 0) for p in self.combinations(key))
            for key in filter(self.is_readable, keys)
        )

    @property
    def axes_shown(self) -> dict[tuple[str, ...], tuple[Any, ...]]:
        """The axes for a reader: the values of each axis by the keys that identify its points.

        Keys that vary together are one axis. It is identified by the label or its first key if no
        two points share that value, otherwise by all its keys, with tuples as values.
        """
        axes: dict[tuple[str, ...], tuple[Any, ...]] = {}
        for dimension in self.dimensions:
            first, values = next(iter(dimension.items()))
            if len(set(values)) == len(values):
                axes[(first,)] = tuple(values)
                continue
            derived = {*DERIVED} - {*LAW_KEYS} if self.names_schedules else ()
            given = {key: v for key, v in dimension.items() if key not in derived}
            axes[tuple(given)] = tuple(zip(*given.values(), strict=True))
        return axes

    @property
    def keys_shown(self) -> tuple[str, ...]:
        """The swept keys that distinguish variants, see `axes_shown`."""
        return tuple(key for keys in self.axes_shown for key in keys)

    def given_in(self, key: str) -> str | None:
        """Return the table, in brackets, that gives, sweeps or draws a key; None if none does."""
        if table := self.table_of.get(key):
            return table
        name = SECTION_OF[key]
        section = getattr(self, name)
        return f"[{name}]" if section and key in section.model_fields_set else None

    def gives(self, *keys: str) -> bool:
        """Return whether it gives, sweeps or draws one of some keys, instead of its default."""
        return any(self.given_in(key) for key in keys)

    def refuse(self, key: str, text: str) -> NoReturn:
        """Raise the error of a key: ``[table] key: what is wrong (way on)``."""
        raise InputError(f"{self.given_in(key) or f'[{SECTION_OF[key]}]'} {key}: {text}")

    @property
    def end(self) -> str:
        """The end of the study and of its shortest run, in words."""
        text = f"duration_s = {self.duration_s:.12g}"
        is_shorter = self.run_s < self.duration_s * (1 - ROUNDING)
        return f"{text}; the shortest run ends at {self.run_s:.12g} s" if is_shorter else text

    def without_effect(self, key: str) -> np.ndarray:
        """Return whether a swept key has no effect on each variant; (variants,)."""
        return self._column_merging_ineffective_values(key).compute(lambda value: not value, bool)

    @property
    def duplicate_of(self) -> np.ndarray:
        """The first variant with the same values of all effective keys, per variant; (variants,).

        Such variants have the same runs. The label of a case is ignored.
        """
        codes = np.zeros(self.n_variants, np.int64)
        for key in self.axis_keys:
            if key != "case":
                column = self._column_merging_ineffective_values(key)
                codes = codes * len(column.choices) + column.codes
                codes = np.unique(codes, return_inverse=True)[1]
        _, first = np.unique(codes, return_index=True)
        return first[codes]

    def _column_merging_ineffective_values(self, key: str) -> CodedColumn:
        """Return the values of a key over the variants; all values without effect are equal."""
        coarse = COARSE_START if key in INITIAL_KEYS and self.coarse else ()
        keys = tuple(dict.fromkeys((key, *deciding_keys(key), *coarse)))

        def value(values: tuple[Any, ...]) -> tuple[Any, ...]:
            point = dict(zip(keys, values, strict=True))
            # Coarse alignment replaces the initial attitude that is given.
            is_replaced = coarse and self.has_coarse_stage(*(point[key] for key in coarse))
            return (point[key],) if has_effect(key, point) and not is_replaced else ()

        return self._points(keys).map(value).merged()

    def variant_values(self) -> dict[str, list[Any]]:
        """Return the values of each axis key, one per variant.

        Examples:
            >>> sinsjax.load_study("paper1_resets").variant_values()["phi_u0_deg"]
            [0.0, 30.0, 30.0]
        """
        return {key: self.values(key) for key in self.axis_keys}

    def values(self, key: str) -> list[Any]:
        """Return the values of a sweepable leaf key, one per variant, in the units of the file.

        The values of a drawn key are None.

        Examples:
            >>> sinsjax.load_study("paper1_resets").values("latitude_deg")
            [32.0, 32.0, 32.0]
        """
        return self.coded(key).to_list()

    def coded(self, *keys: str) -> CodedColumn:
        """Return the column of a sweepable key, or of combinations of several keys, as tuples."""
        points = self._points(keys)
        return points.map(itemgetter(0)) if len(keys) == 1 else points

    def combinations(self, *keys: str) -> Iterator[dict[str, Any]]:
        """Yield the distinct combinations of the values of sweepable keys over all variants.

        The value of a drawn key is None. Schedules that `schedule` names are derived.
        """
        if not self._follow_schedule(keys):
            yield from self.given_combinations(*keys)
            return
        for values in self._points(keys).choices:
            yield dict(zip(keys, values, strict=True))

    def given_combinations(self, *keys: str) -> Iterator[dict[str, Any]]:
        """Yield combinations of values as the file gives them, before `expand_named_schedule`."""
        fixed = {key: self._constant(key) for key in keys if key not in self.axis_keys}
        for point in iter_points(self.dimensions, keys):
            yield fixed | point

    @cached_property
    def _cached_points(self) -> dict[tuple[str, ...], CodedColumn]:
        return {}

    def _points(self, keys: tuple[str, ...]) -> CodedColumn:
        """Return the column of the combinations of some keys, as tuples also of one key or none."""
        if keys not in self._cached_points:
            inputs = dict.fromkeys(keys)
            if self._follow_schedule(keys):
                inputs |= dict.fromkeys(filter(self.is_readable, (*LAW_KEYS, *DERIVED)))
            choices = tuple(self.given_combinations(*inputs))
            points = CodedColumn(point_codes(self.dimensions, inputs), choices)
            if self._follow_schedule(keys):
                points = points.map(self._derive)
            of_keys = points.map(lambda point: tuple(point[key] for key in keys))
            self._cached_points[keys] = of_keys.merged()
        return self._cached_points[keys]

    def _follow_schedule(self, keys: tuple[str, ...]) -> bool:
        return not {*keys}.isdisjoint(DERIVED) and self.names_schedules

    def _derive(self, point: dict[str, Any]) -> dict[str, Any]:
        # The rate of a recorded study is known, and its schedule final, once its record is read.
        known = dict.fromkeys((*LAW_KEYS, *DERIVED)) | point
        return point | expand_named_schedule(self.study.rate_hz or 100.0, known)

    @cached_property
    def names_schedules(self) -> bool:
        """Whether `schedule` decides what the keys of some resets are."""
        if not self.has("resets"):
            return False
        return any(point["schedule"] != "times" for point in self.given_combinations("schedule"))

    def is_readable(self, key: str) -> bool:
        """Return whether this study has the section of a sweepable key."""
        return SECTION_OF[key] in SWEEPABLE and self.has(SECTION_OF[key])

    def _constant(self, key: str) -> Any:
        if not self.is_readable(key):
            raise KeyError(key)
        return None if key in self.drawn_keys else getattr(getattr(self, SECTION_OF[key]), key)


def study_to_tables(study: Study, *, exclude_unset: bool = False) -> TomlTable:
    """Return the resolved study as nested dictionaries, the inverse of `study_from_dict`.

    With ``exclude_unset`` without the keys that the study does not give.
    """
    content = study.model_dump(exclude_none=True, exclude_unset=exclude_unset)
    for key in study.drawn_keys:
        content[SECTION_OF[key]].pop(key, None)
    content["axes"] |= content.pop("zips")
    content["cases"] = [
        {key: value for key, value in case.items() if value is not None} for case in study.cases
    ]
    names = (*SECTIONS, "axes", "cases", "drawn")
    return {n: content[n] for n in names if content.get(n) or (n in SECTIONS and n in content)}

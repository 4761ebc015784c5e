"""The study: its sections, the axes it sweeps, the variants that they span.

`load` makes one from a file or tables, with all `rules` checked.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, create_model

from sinsjax.alignment.description import INITIAL_KEYS
from sinsjax.alignment.filters.section import OF_SCHEDULES, reset_times
from sinsjax.alignment.methods import SECTIONS_OF_METHODS
from sinsjax.alignment.sections import AlignmentSection, CoarseSection, PassesSection
from sinsjax.errors import InputError
from sinsjax.study.keys import (
    COARSE_KEYS,
    PASS_KEYS,
    SECTION_OF,
    SWEEPABLE,
    TomlTable,
    acts,
    deciding,
)
from sinsjax.study.resolved import Coded, Dimension, Resolved, distinct, same
from sinsjax.study.schema import (
    DrawnSection,
    EarthSection,
    MotionSection,
    RecordSection,
    SensorsSection,
    StopWhenSection,
    StudySection,
    TuneSection,
)
from sinsjax.study.sweep import dimensions_of
from sinsjax.value_types import ROUNDING

COARSE_START = ("coarse_method", "coarse_then")
"""The keys that decide whether a run begins with coarse alignment."""

SEQUENTIAL_KEYS = (
    *("surge_m_per_s", "vibration_ug_rms", "vibration_deg_per_h_rms"),
    *("gyro_instability_deg_per_h", "accel_instability_ug"),
    *("gyro_rrw_deg_per_h_per_sqrt_h", "accel_rrw_ug_per_sqrt_h"),
    *("gyro_quantisation_arcsec", "accel_quantisation_um_per_s"),
)
"""The keys with which a sample of a simulation depends on those before it."""


class Span(NamedTuple):
    """How long a variant runs, in record intervals.

    Attributes:
        records: in the run.
        pass_records: in a pass over the stored record; the whole run if there is only one pass.
        rewinds: whether every pass is forward.
    """

    records: int
    pass_records: int
    rewinds: bool = False

    @property
    def read(self) -> int:
        """Record intervals of data that the run reads."""
        return min(self.records, self.pass_records)

    def pass_numbers(self) -> np.ndarray:
        """Return the pass, from 1, that each record of the run ends or lies in; (records,)."""
        return np.arange(self.records) // self.pass_records + 1


if TYPE_CHECKING:  # asked for by name, with `Study.has`
    _SectionsOfMethods = BaseModel
else:
    _SectionsOfMethods = create_model(
        "_SectionsOfMethods",
        **{name: (section | None, None) for name, section in SECTIONS_OF_METHODS.items()},
    )


class Study(_SectionsOfMethods):
    """A checked study: its sections with all defaults filled in, and what it sweeps and draws.

    A variant is one point of the sweep: cases outermost, then the zips, then the axes, each as
    written, the last one fastest. A section that does not apply is None: ``motion`` and ``sensors``
    of a recorded study, ``record`` of a simulated one, those of methods where no method reads them,
    ``passes`` where the record is used once, ``drawn``, ``stop_when``, ``tune`` and, in a simulated
    study, ``coarse`` where not given. So is a key that does not apply, such as
    ``gravity_m_per_s2`` where no variant has constants.

    Attributes:
        axes: values by leaf key, in the order written, of the axes that stand alone.
        zips: axes that go together, by the name of their table: values by leaf key, of one length.
        cases: one table of leaf keys a case, all with the same keys, ``case`` being its label.
        drawn: how the keys are drawn whose value differs from draw to draw; no section, axis or
            case has them.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    study: StudySection
    earth: EarthSection
    motion: MotionSection | None = None
    sensors: SensorsSection | None = None
    alignment: AlignmentSection
    passes: PassesSection | None = None
    record: RecordSection | None = None
    coarse: CoarseSection | None = None
    drawn: DrawnSection | None = None
    stop_when: StopWhenSection | None = None
    tune: TuneSection | None = None
    axes: Dimension
    zips: dict[str, Dimension] = {}
    cases: tuple[TomlTable, ...]

    rebuild: ClassVar[Callable[["Study", Mapping[str, Any]], "Study"]]
    """Set by `load`, which builds studies."""

    def replace(self, changes: Mapping[str, Any]) -> "Study":
        """Return the study with the values of some ``section.key`` changed, see `load.replaced`."""
        return type(self).rebuild(self, changes)

    @property
    def name(self) -> str:
        """Its name."""
        return self.study.name

    @property
    def rate_hz(self) -> float:
        """Sample rate, Hz; None until the record of a recorded study is read."""
        return self.study.rate_hz

    @property
    def duration_s(self) -> float:
        """Length of the fine alignment, s."""
        return self.study.duration_s

    @property
    def seed(self) -> int:
        """Of all that is drawn."""
        return self.study.seed

    @property
    def is_estimated(self) -> bool:
        """Whether its results are estimates of variants, and no runs."""
        return self.study.estimate == "covariance"

    @property
    def checks_linearity(self) -> bool:
        """Whether draws tell how far its estimates hold."""
        return self.is_estimated and bool(self.study.check_linearity)

    @property
    def is_recorded(self) -> bool:
        """Whether the sensors come from a record and not from a simulation."""
        return self.record is not None

    @property
    def n_draws(self) -> int:
        """Number of draws, or of the start times in a record; with ``stop_when`` the most.

        1 where one noise-free run stands for all.
        """
        if self.is_estimated:
            return 1
        return len(self.record.start_s) if self.record else self.study.draws or 1

    @property
    def n_variants(self) -> int:
        """Number of points of the sweep; 1 where nothing is swept."""
        return math.prod(map(_length, self.dimensions))

    @property
    def dimensions(self) -> list[Dimension]:
        """What the sweep is the product of, as `dimensions_of` gives it."""
        return dimensions_of(self.cases, self.zips.values(), self.axes)

    @property
    def record_every(self) -> int:
        """Samples in a record interval."""
        return round(self.study.record_interval_s * self.rate_hz)

    @property
    def records(self) -> int:
        """Whole record intervals in the duration; a last partial one is not run."""
        samples = self.duration_s * self.rate_hz
        return math.floor(samples * (1 + ROUNDING)) // self.record_every

    @property
    def resolved(self) -> Resolved:
        """Its columns, made once."""
        return _resolved(_Itself(self))

    @property
    def lengths(self) -> Coded:
        """How long every variant runs, as a column of `Span`."""
        if self.passes is None:
            return same(self.n_variants, self.span())
        return self.resolved.column(*PASS_KEYS).map(lambda values: self.span(*values))

    @property
    def spans(self) -> list[Span]:
        """How long every variant runs."""
        return self.lengths.to_list()

    @property
    def distinct_spans(self) -> set[Span]:
        """How long variants run, each length once, from the axes alone."""
        points = self.combinations(*PASS_KEYS) if self.passes else [{}]
        return {self.span(**point) for point in points}

    def span(
        self,
        stored_s: float | None = None,
        passes: int | None = None,
        ending: str = "duration",
        direction: str | None = None,
    ) -> Span:
        """How long a variant with some values of `PASS_KEYS` runs."""
        rewinds = direction == "rewind"
        if stored_s is None:
            return Span(self.records, self.records)
        pass_records = max(1, round(stored_s * self.rate_hz / self.record_every))
        if passes is None:
            whole = self.records // pass_records
            backward_last = 0 if rewinds else (whole + 1) % 2
            passes = whole - backward_last if ending == "forward" else None
        records = self.records if passes is None else passes * pass_records
        return Span(records, pass_records, rewinds)

    @property
    def spans_s(self) -> np.ndarray:
        """Lengths of every variant's run and of a pass over its stored record, s; (variants, 2)."""
        lengths = self.lengths.each(lambda span: (span.records, span.pass_records), int)
        return lengths * self.record_every / self.rate_hz

    def update_times(self, span: Span) -> np.ndarray:
        """Return the update times of a run's records from the start of fine alignment, s."""
        return np.arange(1, span.records + 1) * self.record_every / self.rate_hz

    def stored_times(self, span: Span) -> np.ndarray:
        """Return the place in its stored record of each record of a run, s from the beginning."""
        place = np.arange(span.records) % span.pass_records + 1
        forward = span.rewinds | (span.pass_numbers() % 2 == 1)
        place = np.where(forward, place, span.pass_records - place)
        return place * self.record_every / self.rate_hz

    def samples_before(
        self, rate_hz: float, coarse_method: str, coarse_duration_s: float, coarse_then: str | None
    ) -> int:
        """Return the samples of a record that are coarsely aligned before runs begin.

        Args:
            rate_hz: sample rate of the record, Hz.
            coarse_method: as all that follow, of `COARSE_KEYS`.
            coarse_duration_s: length of coarse alignment, s.
            coarse_then: where fine alignment begins.
        """
        if self.has_coarse_stage(coarse_method, coarse_then):
            return 0
        return round(coarse_duration_s * rate_hz)

    @property
    def counts_before(self) -> bool:
        """Whether data before t = 0 of some runs count, because other runs begin with the first.

        If none does, data are counted from t = 0 too.
        """
        return self.is_recorded and bool(self.coarse_stages)

    @property
    def report_times_s(self) -> tuple[float, ...]:
        """Times at which runs are reported in addition to their end, s of data; none by default."""
        return self.study.report_times_s or ()

    def report_samples(self, before: int) -> np.ndarray:
        """Return the numbers, from 1, of the samples of a run at the report times; (times,).

        Args:
            before: samples of data that count before the run's first, see `counts_before`.
        """
        samples = np.asarray(self.report_times_s) * self.rate_hz - before
        return np.round(samples / self.record_every) * self.record_every

    def has_coarse_stage(self, coarse_method: str, coarse_then: str | None) -> bool:
        """Whether runs with some values of these keys begin with coarse alignment.

        The hand-over of a record is made before its runs.
        """
        return coarse_method != "none" and (not self.is_recorded or coarse_then == "replay")

    @property
    def coarse_stages(self) -> tuple[dict[str, Any], ...]:
        """The values that `COARSE_KEYS` take together where coarse alignment is a stage of runs."""
        if self.coarse is None:
            return ()
        points = self.combinations(*COARSE_KEYS)
        return tuple(p for p in points if self.has_coarse_stage(*(p[key] for key in COARSE_START)))

    @property
    def run_s(self) -> float:
        """Length of the shortest run, whole record intervals, s."""
        return min(s.records for s in self.distinct_spans) * self.record_every / self.study.rate_hz

    @property
    def dropped_s(self) -> float:
        """Length of the last partial record interval, which is not run, s."""
        left = self.duration_s - self.records * self.record_every / self.rate_hz
        return left if left > ROUNDING * self.duration_s else 0.0

    def has(self, section: str) -> bool:
        """Whether it has a section; without it none of its keys may be asked for."""
        return getattr(self, section) is not None

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods of its variants, each once."""
        return tuple(point["method"] for point in self.combinations("method"))

    @property
    def schedules(self) -> Coded:
        """The schedule of resets of every variant: their times, s."""
        if not self.has("resets"):
            return same(self.n_variants, ())
        return self.resolved.column(*OF_SCHEDULES).map(lambda values: reset_times(*values))

    def reset_times(self) -> list[tuple[float, ...]]:
        """Reset times of every variant, s."""
        return self.schedules.to_list()

    @property
    def axis_keys(self) -> tuple[str, ...]:
        """Every key that varies over the variants: ``case`` if labelled, then as they number them.

        Those of the cases, of the zips, the axes.
        """
        return tuple(key for dimension in self.dimensions for key in dimension)

    @property
    def drawn_keys(self) -> tuple[str, ...]:
        """Every key whose value differs from draw to draw, in the order written."""
        return tuple(self.drawn.laws) if self.drawn else ()

    @property
    def sequential_keys(self) -> list[str]:
        """The `SEQUENTIAL_KEYS` that some variant has."""
        if self.is_recorded:
            return []

        def is_taken(key: str) -> bool:
            values = (point[key] for point in self.combinations(key))
            return any(value is None or np.any(value) for value in values)

        return [key for key in SEQUENTIAL_KEYS if is_taken(key)]

    @property
    def requires_sequential(self) -> bool:
        """Whether a sample of some variant depends on those before it."""
        return bool(self.sequential_keys)

    @property
    def axes_shown(self) -> dict[tuple[str, ...], tuple[Any, ...]]:
        """What is swept as a reader counts it: the values of each axis by the keys that name it.

        Keys that go together, in cases or in axes, are one axis. Its name is the label or the first
        of its keys if no two of its points share that value, otherwise all of them; its values are
        tuples then.
        """
        axes: dict[tuple[str, ...], tuple[Any, ...]] = {}
        for dimension in self.dimensions:
            first, values = next(iter(dimension.items()))
            if len(set(values)) == len(values):
                axes[(first,)] = tuple(values)
            else:
                axes[tuple(dimension)] = tuple(zip(*dimension.values(), strict=True))
        return axes

    @property
    def keys_shown(self) -> tuple[str, ...]:
        """The swept keys that distinguish variants, see `axes_shown`."""
        return tuple(key for keys in self.axes_shown for key in keys)

    @property
    def figure_axes(self) -> tuple[dict[str, tuple[Any, ...]], list[str]]:
        """The axes of the study's figures with their values, and all other swept keys.

        They are the first two swept numbers; without any the first key whose values are lists, such
        as reset times.
        """
        numeric, listed = {}, {}
        for (key, *more), values in self.axes_shown.items():
            if all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
                numeric[key] = tuple(map(float, values))
            elif not more and all(isinstance(v, tuple) for v in values):
                listed[key] = values
        shown = dict([*numeric.items()][:2] or [*listed.items()][:1])
        return shown, [key for key in self.keys_shown if key not in shown]

    def only(self, key: str) -> Any:
        """Return the one value of a key.

        Raises:
            InputError: the study sweeps it.
        """
        first, *rest = self.combinations(key)
        if rest:
            raise InputError(f"{self.name}: one {key} is needed, not a sweep of it")
        return first[key]

    def without_effect(self, key: str) -> np.ndarray:
        """Return whether a swept key has no effect on each variant; (variants,)."""
        return self._effective(key).each(lambda value: not value, bool)

    @property
    def duplicate_of(self) -> np.ndarray:
        """The first variant that equals each one in every key with an effect; (variants,).

        Such variants have the same runs: ``reset_count = 0`` is one schedule whatever the cycle.
        The label of a case is no key.
        """
        alike = np.zeros(self.n_variants, np.int64)
        for key in self.axis_keys:
            if key != "case":
                column = self._effective(key)
                alike = distinct(alike * len(column.choices) + column.codes)[1]
        _, first = np.unique(alike, return_index=True)
        return first[alike]

    def idle_keys(self) -> list[str]:
        """Return the swept keys whose values differ between variants with the same runs."""
        first = self.duplicate_of
        swept = {key: self.values(key) for key in self.axis_keys if key != "case"}
        return [k for k, v in swept.items() if any(v[i] != v[at] for i, at in enumerate(first))]

    def _effective(self, key: str) -> Coded:
        """Return the values of a key over the variants, those without an effect being equal."""
        coarse = COARSE_START if key in INITIAL_KEYS and self.coarse else ()
        keys = tuple(dict.fromkeys((key, *deciding(key), *coarse)))

        def value(values: tuple[Any, ...]) -> tuple[Any, ...]:
            given = dict(zip(keys, values, strict=True))
            # Coarse alignment replaces the initial attitude that is given.
            found = coarse and self.has_coarse_stage(*(given[key] for key in coarse))
            return (given[key],) if acts(key, given) and not found else ()

        codes, choices = self.resolved.column(*keys).map(value if len(keys) > 1 else lambda v: (v,))
        place = {choice: code for code, choice in enumerate(dict.fromkeys(choices))}
        return Coded(np.asarray([place[choice] for choice in choices])[codes], tuple(place))

    def variant_values(self) -> dict[str, list[Any]]:
        """The values of every axis key, one a variant, in variant order."""
        return {key: self.values(key) for key in self.axis_keys}

    def values(self, key: str) -> list[Any]:
        """The values of a sweepable leaf key, one a variant, in the units of the file.

        Args:
            key: leaf key of a section in `SWEEPABLE`; one that is drawn is None.

        Raises:
            KeyError: no sweepable section of this study has the key.
        """
        return self.resolved.column(key).to_list()

    def combinations(self, *keys: str) -> Iterator[dict[str, Any]]:
        """The distinct values that sweepable keys take together over all variants.

        A drawn key is None.
        """
        points = []
        for dimension in self.dimensions:
            if here := [key for key in keys if key in dimension]:
                rows = dict.fromkeys(zip(*(dimension[key] for key in here), strict=True))
                points.append([dict(zip(here, row, strict=True)) for row in rows])
        swept = {key for rows in points for key in rows[0]}
        fixed = {key: self._constant(key) for key in keys if key not in swept}
        for parts in product(*points):
            yield fixed | {key: value for part in parts for key, value in part.items()}

    def _constant(self, key: str) -> Any:
        section = getattr(self, SECTION_OF[key])
        if SECTION_OF[key] not in SWEEPABLE or section is None:
            raise KeyError(key)
        return None if key in self.drawn_keys else getattr(section, key)


@dataclass(frozen=True, eq=False)
class _Itself:
    """A study as a key, told from others by identity: it never changes, and copies are others."""

    study: Study

    def __hash__(self) -> int:
        return id(self.study)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Itself) and self.study is other.study


@lru_cache(maxsize=4)
def _resolved(key: _Itself) -> Resolved:
    return Resolved(key.study.dimensions, key.study._constant)


def _length(dimension: Dimension) -> int:
    return len(next(iter(dimension.values())))

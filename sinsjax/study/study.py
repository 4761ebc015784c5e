"""The study: its sections, the axes it sweeps, the variants that they span.

The rules between its keys stand in `checks`.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple

from pydantic import BaseModel, ConfigDict, create_model

from sinsjax.alignment.filters.section import OF_SCHEDULES, reset_times
from sinsjax.alignment.methods import SECTIONS_OF_METHODS
from sinsjax.alignment.sections import AlignmentSection, CoarseSection, PassesSection
from sinsjax.study.distributions import DrawnSection, StopWhenSection
from sinsjax.study.keys import COARSE_KEYS, PASS_KEYS, SECTION_OF, SWEEPABLE, TomlTable
from sinsjax.study.ranges import TuneSection
from sinsjax.study.recorded import RecordSection
from sinsjax.study.resolved import Coded, Dimension, Resolved, same
from sinsjax.study.schema import (
    EarthSection,
    MotionSection,
    SensorsSection,
    StudySection,
)
from sinsjax.value_types import ROUNDING


def dimensions_of(
    cases: Sequence[TomlTable], zips: Iterable[Dimension], axes: Dimension
) -> list[Dimension]:
    """What a sweep is the product of: values by key, those of one dimension going together.

    Args:
        cases: one table a case.
        zips: values by key of every zip.
        axes: values by key, each a dimension of its own.

    Returns:
        The cases first, as the slowest, a label before their keys; then the zips; then the axes.
    """
    keys = sorted(cases[0] if cases else (), key=lambda key: key != "case")
    joint = {key: tuple(case[key] for case in cases) for key in keys}
    return [*([joint] if joint else ()), *zips, *({key: axes[key]} for key in axes)]


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

    def replace(self, changes: Mapping[str, Any]) -> "Study":
        """The study with the values of some ``section.key`` changed, see `load.replaced`."""
        made: Study = import_module("sinsjax.study.load").replaced(self, changes)
        return made  # `load` imports this module

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
        given = ("coarse_method", "coarse_then")
        return tuple(p for p in points if self.has_coarse_stage(*(p[key] for key in given)))

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

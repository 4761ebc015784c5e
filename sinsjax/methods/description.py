"""The description of a method: its keys, columns and properties, free of JAX.

Studies are read, checked and reported with it alone; the code that computes is loaded on demand.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple, NoReturn, Protocol, runtime_checkable

from numpy.typing import NDArray

from sinsjax.columns import Column
from sinsjax.methods.parameters import Columns
from sinsjax.value_types import Section

INITIAL_KEYS = (
    *("phi_e0_deg", "phi_n0_deg", "phi_u0_deg", "misalignment"),
    *("ve0_m_per_s", "vn0_m_per_s"),
)
"""The keys of [alignment] for a method that starts from an attitude and a velocity."""

COMMON_KEYS = ("position",)
"""The keys of [alignment] that act on all methods but those with them in `without_effect`."""


@runtime_checkable
class StudyView(Protocol):
    """The part of a study that a method may read."""

    @property
    def rate_hz(self) -> float:
        """Samples per second."""
        ...

    @property
    def is_recorded(self) -> bool:
        """Return whether its sensors come from a record."""
        ...

    @property
    def run_s(self) -> float:
        """Length of the shortest run, s."""
        ...

    def has(self, section: str) -> bool:
        """Return whether it has a section; its keys may be read only then."""
        ...

    def combinations(self, *keys: str) -> Iterator[dict[str, Any]]:
        """Yield the distinct combinations of some keys over all variants; a drawn key is None."""
        ...


@runtime_checkable
class CheckedStudy(StudyView, Protocol):
    """A study whose rules between keys are being checked."""

    @property
    def record_interval_s(self) -> float:
        """Time between two record times, s."""
        ...

    @property
    def end(self) -> str:
        """End of its shortest run, in words."""
        ...

    def given_combinations(self, *keys: str) -> Iterator[dict[str, Any]]:
        """Yield combinations of keys as the file gives them, before others decide their values."""
        ...

    def place(self, key: str) -> str | None:
        """Return the table, in brackets, that gives a key; None if it is left out."""
        ...

    def refuse(self, key: str, text: str) -> NoReturn:
        """Raise the error of a key: `InputError`, ``[section] key: what is wrong (hint)``."""
        ...


class OwnColumn(NamedTuple):
    """A result column that belongs to one method.

    Attributes:
        column: name, type, unit and meaning.
        value: (`Method.results` of runs, samples a second) -> values, (runs,), NaN for none.
        missing: value of runs whose method has no such column; NaN for none.
        applies_to: study -> whether it has the column.
    """

    column: Column
    value: Callable[[Any, float], NDArray]
    missing: float = float("nan")
    applies_to: Callable[[StudyView], bool] = lambda study: True


def no_check(columns: Columns, site: Any) -> None:
    """Accept all params."""


class Implementation(NamedTuple):
    """The code of a method; types in quotes are those of `methods.base`.

    Attributes:
        build: ``Options`` -> ``Method``.
        parameters: (columns of a study, ``Site``, a micro-g in m/s^2) -> the method's numbers,
            leaves (variants, ...).
        check: (columns, ``Site``): refuses numbers that cannot be run, by `InputError`.
        relaxation: ``Relaxation``, dependence of its params on keys; None if the method has none.
    """

    build: Callable[[Any], Any]
    parameters: Callable[[Columns, Any, float], Any]
    check: Callable[[Columns, Any], None] = no_check
    relaxation: Any = None


@dataclass(frozen=True)
class Description:
    """An alignment method as studies, results and the documentation know it.

    Attributes:
        name: in ``[alignment] method``.
        summary: half a line on the method.
        source: paper and equation.
        sections: its sections of a study file, by name; methods may share one.
        reads: keys of [alignment] and [passes] that act on it, but for those that act on all.
        load: makes its `Implementation`, importing JAX.
        without_effect: keys of its sections, of ``reads`` and of `COMMON_KEYS` that change nothing.
        has_covariance: whether it has a covariance P.
        has_floor: whether constant sensor biases leave its heading a bias floor that is known.
        finds_heading: whether it finds a heading. If not, only its pitch and roll are observed, and
            its runs have the status ``no_north``.
        gyro_bias_keys: pairs of keys, the sigma of the gyro bias states and the sigma of heading.
            Such a filter distinguishes gyro biases from heading once the base moves. Empty if the
            method has no such states.
        turning: the turns of a base over which its heading averages constant gyro biases: "any", if
            a single turn is enough, "many", as of a carousel, or "none"; None if that is unknown.
        stores_blocks: whether it stores blocks of samples, see `methods.base.BlockFit`.
        rules: check the rules between its keys.
        columns: its own result columns.
        last_triggered_sample: (`Method.results` of runs) -> sample of the last reset by a trigger,
            0 for none; None where there is no trigger.
        step_s: time of a sample of one run on one core, s, roughly; see `docs/performance.md`.
        is_external: whether it is a program outside sinsjax, whose runs cannot be repeated here.
    """

    name: str
    summary: str
    source: str
    sections: Mapping[str, type[Section]]
    reads: tuple[str, ...]
    load: Callable[[], Implementation]
    without_effect: tuple[str, ...] = ()
    has_covariance: bool = True
    has_floor: bool = True
    finds_heading: bool = True
    gyro_bias_keys: tuple[tuple[str, str], ...] = ()
    turning: Literal["any", "many", "none"] | None = None
    stores_blocks: bool = False
    rules: tuple[Callable[[CheckedStudy], None], ...] = ()
    columns: tuple[OwnColumn, ...] = ()
    last_triggered_sample: Callable[[Any], NDArray | None] = lambda results: None
    step_s: float = 20e-9
    is_external: bool = False

    @cached_property
    def keys(self) -> frozenset[str]:
        """Every key of a study that it reads, except those of all methods."""
        own = (key for section in self.sections.values() for key in section.model_fields)
        return frozenset([*own, *self.reads])

    def own_columns(self, study: StudyView) -> tuple[OwnColumn, ...]:
        """Return its own result columns in a study."""
        return tuple(own for own in self.columns if own.applies_to(study))

    @cached_property
    def implementation(self) -> Implementation:
        """The code of the method; imports JAX."""
        return self.load()

    def __call__(self, options: Any) -> Any:
        """Build the method: ``Options`` -> ``Method``, see `methods.base`."""
        return self.implementation.build(options)

"""The kinds of values that a study's keys take: types with their bounds and rules.

Values stay in the file's units. A rule that is broken raises `invalid`, whose text says what is
wrong in the words of a user.
"""

from collections.abc import Callable, Iterable
from itertools import pairwise
from typing import Annotated, Any, ClassVar, NamedTuple, TypeVar, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
)
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError

from sinsjax import columns
from sinsjax.messages import is_control


def invalid(text: str, key: str | None = None) -> PydanticCustomError:
    """The error of a rule inside a section.

    Args:
        text: what is wrong.
        key: the key to name, where the rule concerns the whole section.
    """
    return PydanticCustomError("invalid", text, {"key": key} if key else None)


class Usual(NamedTuple):
    """What a number of a study usually is; one outside is asked about, see `usual`.

    Attributes:
        low: the least, in the unit of the key.
        high: the greatest.
    """

    low: float
    high: float


class Default(NamedTuple):
    """What a key is that a study leaves out, where a method of the study reads it.

    It is filled in unless a key that says the same in another way is given.

    Attributes:
        value: in the unit of the key.
        beside: a key that has to have a value, other than 'none', for this one to be read.
    """

    value: Any
    beside: str | None = None


class SameAs(NamedTuple):
    """What the lack of a key stands for: the value of another key, or a number."""

    other: str | float


class Whole(NamedTuple):
    """Of what a time is a whole number, where a search gives it any value.

    Attributes:
        interval: 'sample', or 'record' interval.
        merged: whether times of a list that fall on one sample are one; else they are put a sample
            apart.
    """

    interval: str
    merged: bool = False


class RunTime(NamedTuple):
    """That a number, or the last one of a list, is a time of a run: refused after its end.

    Attributes:
        unit: 's', or 'pass' of a number of passes.
    """

    unit: str = "s"


class ActsWhere(NamedTuple):
    """When keys act on a run at all, whatever their values.

    Attributes:
        keys: that act, or do not.
        given: keys that decide it.
        acts: their values -> whether the keys act; a drawn one is None.
        refused: whether a value of theirs is refused where it does not act.
    """

    keys: tuple[str, ...]
    given: tuple[str, ...]
    acts: Callable[..., bool]
    refused: bool = False


ROUNDING = 1e-9
"""Relative; how far a product of two decimal numbers may be off."""

Marks = TypeVar("Marks")


def mark(field: FieldInfo, kind: type[Marks]) -> Marks | None:
    """The mark of some kind beside a key's type, the outermost of several; None without one."""
    return _first([*field.metadata, field.annotation], kind)


def _first(parts: Iterable[Any], kind: type[Marks]) -> Marks | None:
    for part in parts:
        found = part if isinstance(part, kind) else _first(reversed(get_args(part)), kind)
        if found is not None:
            return found
    return None


def _shape(value: Any) -> str:
    return "list" if isinstance(value, tuple) else "number"


def unique(values: tuple[Any, ...]) -> tuple[Any, ...]:
    """Refuses a list that names a value twice."""
    if len(set(values)) < len(values):
        raise invalid("names a value twice")
    return values


def _own_columns(bands: tuple[float, ...]) -> tuple[float, ...]:
    """Refuses bands whose result columns would have one name."""
    if len({columns.settle_column(band).name for band in bands}) < len(bands):
        raise invalid("names a value twice, to the 6 digits that its column shows")
    return bands


def _increasing(times: tuple[Any, ...]) -> tuple[Any, ...]:
    if any(late <= early for early, late in pairwise(times)):
        raise invalid("must increase")
    return times


def _ordered(ends: tuple[float, float]) -> tuple[float, float]:
    low, high = ends
    if low > high:
        raise invalid(f"must be [low, high] with low <= high, not [{low:g}, {high:g}]")
    return ends


def _legible(name: str) -> str:
    """Refuses letters that a terminal or an editor obeys and nobody sees."""
    if found := next(filter(is_control, name), None):
        raise invalid(f"must not hold control characters (\\u{ord(found):04x})")
    return name


# Ceilings far above any use keep every product of two values finite.
Finite = Annotated[float, Field(ge=-1e12, le=1e12)]
Positive = Annotated[float, Field(gt=0, le=1e12)]
NonNegative = Annotated[float, Field(ge=0, le=1e12)]
Count = Annotated[int, Field(ge=0, le=10**9)]
Share = Annotated[float, Field(ge=0, le=1)]
Angle = Annotated[float, Field(ge=-360, le=360)]
HalfTurn = Annotated[float, Field(ge=-180, le=180)]
Elevation = Annotated[float, Field(gt=-90, lt=90)]
# What is usual is generous: outside it a number is rather one of another unit.
Seconds = Annotated[Positive, Usual(1e-9, 1e8)]
SecondsOrZero = Annotated[NonNegative, Usual(0, 1e8)]
Period = Annotated[Positive, Usual(1e-4, 1e7)]
Band = Annotated[Positive, Usual(1e-6, 180 * 60)]
Amplitude = Annotated[NonNegative, Usual(0, 360)]
Speed = Annotated[Finite, Usual(-1e4, 1e4)]
SpeedSigma = Annotated[Positive, Usual(1e-12, 1e4)]
AngleSigma = Annotated[Positive, Usual(1e-9, 360)]
GyroSigma = Annotated[Positive, Usual(1e-9, 1e6)]
AccelSigma = Annotated[Positive, Usual(1e-6, 1e7)]
GyroNoise = Annotated[NonNegative, Usual(0, 1e6)]
AccelNoise = Annotated[NonNegative, Usual(0, 1e7)]
GyroWalk = Annotated[NonNegative, Usual(0, 1e4)]
Bandwidth = Annotated[Positive, Usual(1e-6, 1e4)]
Factor = Annotated[Positive, Usual(1e-9, 1e9)]
IncreasingPair = Annotated[tuple[Finite, Finite], AfterValidator(_ordered)]
Normal = tuple[Finite, NonNegative]
Name = Annotated[str, Field(min_length=1), AfterValidator(_legible)]
Triad = tuple[Name, Name, Name]
Times = Annotated[tuple[Seconds, ...], AfterValidator(_increasing)]
Bands = Annotated[tuple[Band, ...], AfterValidator(unique), AfterValidator(_own_columns)]
Starts = Annotated[
    tuple[SecondsOrZero, ...],
    Field(min_length=1),
    BeforeValidator(lambda value: value if isinstance(value, tuple) else (value,)),
    AfterValidator(unique),
]
Vector = Annotated[
    Annotated[Finite, Tag("number")] | Annotated[tuple[Finite, Finite, Finite], Tag("list")],
    Discriminator(_shape),
]
NoisePerAxis = Annotated[
    Annotated[NonNegative, Tag("number")]
    | Annotated[tuple[NonNegative, NonNegative, NonNegative], Tag("list")],
    Discriminator(_shape),
]
CrossAxis = Annotated[
    Annotated[Finite, Tag("number")]
    | Annotated[tuple[Finite, Finite, Finite, Finite, Finite, Finite], Tag("list")],
    Discriminator(_shape),
]
PassNumbers = Annotated[
    tuple[Annotated[int, Field(ge=1, le=10**9)], ...], AfterValidator(_increasing)
]
Factors = Annotated[tuple[Factor, ...], Field(min_length=1)]
Damping = Annotated[float, Field(ge=0.01, lt=1)]


class Section(BaseModel):
    """A table of keys: frozen, no key unknown, no value coerced, NaN and infinity refused.

    Attributes:
        exclusive: pairs of keys that say the same thing in two ways: a study gives one of them.
        conditions: when keys of it act; without one a key always does.
    """

    exclusive: ClassVar[tuple[tuple[str, str], ...]] = ()
    conditions: ClassVar[tuple[ActsWhere, ...]] = ()

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

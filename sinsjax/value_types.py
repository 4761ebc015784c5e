"""Types of the values that a study's keys take, with their bounds and rules.

Values stay in the file's units. A broken rule raises `rule_error` with a message in a user's terms.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from inspect import signature
from itertools import combinations, pairwise
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, TypeVar, get_args

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

from sinsjax.messages import CONTROL
from sinsjax.units import si_factor


def rule_error(text: str, key: str | None = None) -> PydanticCustomError:
    """The error of a broken rule within a section; of a rule about the whole it names a key."""
    return PydanticCustomError("invalid", text, {"key": key} if key else None)


Effect = Literal["sway", "noise", "bias", "distortion", "quantum", "process", "process_shape"]


class KeyInfo(NamedTuple):
    """Properties of a study key in addition to its type and meaning.

    It is written in `key_field`, or in the annotation of a type; the outermost value of
    each attribute counts.

    Attributes:
        usual_range: lowest and highest usual value in the unit of the key; `rules` refuses others.
        default: value of a key that a study omits although one of its methods reads it. Not filled
            in if the study gives an alternative key, see `Section.exclusive`.
        beside: a key that must be given, not as 'none', for the default to be filled in.
        same_as: meaning of an omitted key: the value of another key, or a number.
        otherwise: meaning of an omitted key for a reader: a number, or words.
        in_simulation: value of an omitted key in a simulation; a record determines its own.
        whole: interval that a time must be a multiple of, to which a search rounds it: 'sample',
            or 'record' interval.
        time: 's' for a time within a run, which must not be after its end.
        alternative_to: key of the same quantity in another unit, of which a study gives one.
        acts_as: what the engine makes of a key of [motion] or [sensors]; zero or left out, it makes
            nothing of it. 'sway': amplitude of an angle. 'distortion': constant error in proportion
            to what a sensor measures. 'quantum': resolution. 'process': size of a random process.
    """

    usual_range: tuple[float, float] | None = None
    default: Any = None
    beside: str | None = None
    same_as: str | float | None = None
    otherwise: str | float | None = None
    in_simulation: float | None = None
    whole: str | None = None
    time: str | None = None
    alternative_to: str | None = None
    acts_as: Effect | None = None


@cache
def keys_of(function: Callable[..., Any]) -> tuple[str, ...]:
    """Return the keys of a study that a function takes: its parameters but ``rate_hz``."""
    return tuple(name for name in signature(function).parameters if name != "rate_hz")


class KeyCondition(NamedTuple):
    """Condition under which keys affect a run at all, whatever their values."""

    keys: tuple[str, ...]
    given: tuple[str, ...]  # keys that it depends on
    acts: Callable[..., bool]  # of the values of ``given``, None if drawn
    refused: bool = False  # whether a value that no run reads is an error

    def acts_at(self, points: Iterable[Mapping[str, Any]]) -> bool:
        """Return whether ``keys`` act with the values of ``given`` at one of some points."""
        return any(self.acts(*(point[key] for key in self.given)) for point in points)


def key_field(meaning: str, default: Any = None, /, **properties: Any) -> Any:
    """Return the field of a key, whose name ends in its unit.

    Args:
        meaning: description, without unit and default.
        default: value of an omitted key in the study; ``...`` if it is required.
        properties: those of `KeyInfo`, and further arguments of pydantic's ``Field``.
    """
    info = {name: properties.pop(name) for name in KeyInfo._fields if name in properties}
    extra: Any = {"info": KeyInfo(**info)}
    if "default_factory" not in properties:
        properties["default"] = default
    return Field(description=meaning, json_schema_extra=extra, **properties)


ROUNDING = 1e-9
"""Relative tolerance for the rounding of a product of two decimal numbers."""


def key_info(field: FieldInfo) -> KeyInfo:
    """Return the properties of a key, the outermost value of each attribute."""
    extra, given = field.json_schema_extra, dict[str, Any]()
    own = [extra["info"]] if isinstance(extra, dict) and "info" in extra else []
    for info in _iterate_key_infos([*own, *field.metadata, field.annotation]):
        for name, value in info._asdict().items():
            if value != KeyInfo._field_defaults[name]:
                given.setdefault(name, value)
    return KeyInfo(**given)


def otherwise(section: "type[Section]", key: str) -> Any:
    """Return what an omitted key means, see `KeyInfo.otherwise`."""
    return key_info(section.model_fields[key]).otherwise


def _iterate_key_infos(parts: Iterable[Any]) -> Iterator[KeyInfo]:
    for part in parts:
        if isinstance(part, KeyInfo):
            yield part
        else:
            yield from _iterate_key_infos(reversed(get_args(part)))


def _vector_tag(value: Any) -> str:
    return "list" if isinstance(value, tuple) else "number"


def require_unique(values: tuple[Any, ...]) -> tuple[Any, ...]:
    """Reject a list with a repeated value."""
    if len(set(values)) < len(values):
        raise rule_error("repeats a value (drop one)")
    return values


def _require_distinct_columns(values: tuple[float, ...]) -> tuple[float, ...]:
    """Reject bands or report times whose result columns would share a name."""
    if len({f"{value:g}" for value in values}) < len(values):
        raise rule_error("repeats a value, to the 6 digits in its column name (drop one)")
    return values


def _require_increasing(times: tuple[Any, ...]) -> tuple[Any, ...]:
    if any(late <= early for early, late in pairwise(times)):
        raise rule_error("must increase")
    return times


def _require_ordered(ends: tuple[float, float]) -> tuple[float, float]:
    low, high = ends
    if low > high:
        raise rule_error(f"must be [low, high] with low <= high, not [{low:g}, {high:g}]")
    return ends


def _require_printable(name: str) -> str:
    """Reject invisible characters that act on a terminal or an editor."""
    if found := CONTROL.search(name):
        raise rule_error(f"must not contain control characters (\\u{ord(found[0]):04x})")
    return name


# Bounds far beyond any use keep every product of two values finite.
Finite = Annotated[float, Field(ge=-1e12, le=1e12)]
Positive = Annotated[float, Field(gt=0, le=1e12)]
NonNegative = Annotated[float, Field(ge=0, le=1e12)]
Count = Annotated[int, Field(ge=0, le=10**9)]
Angle = Annotated[float, Field(ge=-360, le=360)]
HalfTurn = Annotated[float, Field(ge=-180, le=180)]
Elevation = Annotated[float, Field(gt=-90, lt=90)]
# The usual ranges are generous: a number outside is most likely in another unit.
Seconds = Annotated[Positive, KeyInfo(usual_range=(1e-9, 1e8))]
SecondsOrZero = Annotated[NonNegative, KeyInfo(usual_range=(0, 1e8))]
Period = Annotated[Positive, KeyInfo(usual_range=(1e-2, 1e5))]
Band = Annotated[Positive, KeyInfo(usual_range=(1e-6, 180 * 60))]
Amplitude = Annotated[NonNegative, KeyInfo(usual_range=(0, 180), acts_as="sway")]
Speed = Annotated[Finite, KeyInfo(usual_range=(-100, 100))]
SpeedSigma = Annotated[Positive, KeyInfo(usual_range=(1e-12, 100))]
AngleSigma = Annotated[Positive, KeyInfo(usual_range=(1e-6, 180))]
# Beyond a turn, next to nothing is known.
HeadingSigma = Annotated[Positive, KeyInfo(usual_range=(1e-6, 1e4))]
GyroSigma = Annotated[Positive, KeyInfo(usual_range=(1e-9, 36e3))]
AccelSigma = Annotated[Positive, KeyInfo(usual_range=(1e-6, 2e5))]
GyroNoise = Annotated[NonNegative, KeyInfo(usual_range=(0, 1e5))]
AccelNoise = Annotated[NonNegative, KeyInfo(usual_range=(0, 1e6))]
GyroWalk = Annotated[NonNegative, KeyInfo(usual_range=(0, 30))]
Bandwidth = Annotated[Positive, KeyInfo(usual_range=(1e-4, 1e4))]
Factor = Annotated[Positive, KeyInfo(usual_range=(1e-9, 1e9))]
IncreasingPair = Annotated[tuple[Finite, Finite], AfterValidator(_require_ordered)]
Normal = tuple[Finite, NonNegative]
Name = Annotated[str, Field(min_length=1), AfterValidator(_require_printable)]
Triad = tuple[Name, Name, Name]
Columns = Annotated[tuple[Name, ...], Field(min_length=6), AfterValidator(require_unique)]
Times = Annotated[tuple[Seconds, ...], AfterValidator(_require_increasing)]
ReportTimes = Annotated[
    tuple[Seconds, ...],
    Field(min_length=1),
    AfterValidator(_require_increasing),
    AfterValidator(_require_distinct_columns),
]
Bands = Annotated[tuple[Band, ...], AfterValidator(_require_distinct_columns)]
Starts = Annotated[
    tuple[SecondsOrZero, ...],
    Field(min_length=1),
    BeforeValidator(lambda value: value if isinstance(value, tuple) else (value,)),
    AfterValidator(require_unique),
]
EventTimes = Annotated[tuple[SecondsOrZero, ...], AfterValidator(_require_increasing)]
_N = TypeVar("_N")
_List = TypeVar("_List")
_NumberOr = Annotated[
    Annotated[_N, Tag("number")] | Annotated[_List, Tag("list")], Discriminator(_vector_tag)
]
Numbers = _NumberOr[Finite, tuple[Finite, ...]]
Vector = _NumberOr[Finite, tuple[Finite, Finite, Finite]]
NoisePerAxis = _NumberOr[NonNegative, tuple[NonNegative, NonNegative, NonNegative]]
CrossAxis = _NumberOr[Finite, tuple[Finite, Finite, Finite, Finite, Finite, Finite]]
Factors = Annotated[tuple[Factor, ...], Field(min_length=1)]
Damping = Annotated[float, Field(ge=0.01, lt=1)]


class Section(BaseModel):
    """A table of keys: frozen, without unknown keys, coercion, NaN or infinity.

    Attributes:
        exclusive: pairs of alternative keys, of which a study gives one.
        conditions: conditions under which keys act; other keys always do.
    """

    exclusive: ClassVar[tuple[tuple[str, str], ...]] = ()
    conditions: ClassVar[tuple[KeyCondition, ...]] = ()

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Make the alternatives of a quantity exclusive."""
        infos = [key_info(field) for field in cls.model_fields.values()]
        groups = dict.fromkeys(info.alternative_to for info in infos if info.alternative_to)
        pairs = (pair for first in groups for pair in combinations(cls.alternatives(first), 2))
        cls.exclusive = (*cls.exclusive, *pairs)

    @classmethod
    @cache
    def alternatives(cls, first: str) -> Mapping[str, float]:
        """Return the keys that give a quantity, with their factors to the unit of the first."""
        infos = {key: key_info(field) for key, field in cls.model_fields.items()}
        keys = [first, *(key for key, info in infos.items() if info.alternative_to == first)]
        return MappingProxyType({key: si_factor(key) / si_factor(first) for key in keys})

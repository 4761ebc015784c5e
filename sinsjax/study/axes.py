"""Reading the tables that vary a study: [axes] with their zips, [[cases]] and [drawn].

Every value is checked as the key that it stands for. One that is wrong is named by its place, from
0: ``[axes] phi_u0_deg[3]``, ``[axes.level] phi_e0_deg[0]``, ``[drawn] phi_u0_deg.values[2]``.
"""

import functools
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import ConfigDict, TypeAdapter, ValidationError

from sinsjax.errors import InputError
from sinsjax.messages import explained, index, near, rule
from sinsjax.study import sampling as draw_sampling
from sinsjax.study import usual
from sinsjax.study.distributions import INITIAL_KEYS, NUMBERS_DRAWN, Distribution, DrawnSection
from sinsjax.study.keys import SECTION_OF, SECTIONS, SIMULATED_ONLY, SWEEPABLE, TomlTable, unknown
from sinsjax.study.resolved import Dimension
from sinsjax.study.study import Study, dimensions_of
from sinsjax.value_types import Name

_LAWS = tuple(Distribution.model_fields)
_BLOCK = 2**19  # draws that are looked at together, which bounds the memory
_MOST_LOOKED_AT = 2**22  # a second; with more of them, what a law could give counts
_SIGMAS = 8.3  # the furthest of 2^52 points of a normal law


class Sweep(NamedTuple):
    """What varies a study; attributes as those of `Study`."""

    axes: Dimension
    zips: dict[str, Dimension]
    cases: tuple[TomlTable, ...]
    drawn: DrawnSection | None

    @property
    def where(self) -> dict[str, str]:
        """The table, in brackets, of every key that is swept or drawn."""
        return {
            **dict.fromkeys(self.axes, "[axes]"),
            **{key: f"[axes.{name}]" for name, keys in self.zips.items() for key in keys},
            **dict.fromkeys(self.cases[0] if self.cases else (), "[cases]"),
            **dict.fromkeys(self.drawn.laws if self.drawn else (), "[drawn]"),
        }

    def values(self, key: str) -> set[Any]:
        """The values that a key is swept over; empty where it is not swept."""
        dimensions = dimensions_of(self.cases, self.zips.values(), self.axes)
        return {value for dimension in dimensions for value in dimension.get(key, ())}


def read(tables: TomlTable) -> Sweep:
    """The axes, zips, cases and drawn keys of a study.

    Args:
        tables: of the file, lists as tuples.

    Raises:
        InputError: ``[table] key: what is wrong (hint)``.
    """
    axes, zips = _axes(tables)
    cases = _cases(tables, {*axes, *(key for keys in zips.values() for key in keys)})
    swept = Sweep(axes, zips, cases, None)
    taken = {key: f"[{name}]" for name in SWEEPABLE for key in tables.get(name, ())}
    return swept._replace(drawn=_drawn(tables, taken | swept.where))


def check_draws(study: Study) -> None:
    """Refuses a draw that gives a value that its key does not take, and what no draw comes to.

    Draws are looked at one by one where their law leaves it open, and where they are not too many.

    Raises:
        InputError: ``[drawn] key: draw N gives X: what is wrong``.
    """
    laws = study.drawn.laws if study.drawn else {}
    _check_lists(study, laws)
    unchecked = bool(study.study.unchecked)
    open_ = {}
    for key, law in laws.items():
        for value in _ends(law):
            if text := _wrong(key, value, unchecked):
                open_[key] = value, text
    if study.n_draws > _MOST_LOOKED_AT:
        for key in open_:
            for value in _ends(laws[key], _reached(study.n_draws)):
                if text := _wrong(key, value, unchecked):
                    told = f"one of so many draws may give {value:.6g}: {text}"
                    raise InputError(f"[drawn] {key}: {told}")
        return
    for first in range(0, study.n_draws if open_ else 0, _BLOCK):
        count = min(_BLOCK, study.n_draws - first)
        drawn = draw_sampling.values(study, count, first=first)
        for key, rows in ((key, drawn[key]) for key in open_):
            for at in map(int, (rows.argmin(), rows.argmax())):
                value = float(rows.flat[at])
                if text := _wrong(key, value, unchecked):
                    draw = first + at // NUMBERS_DRAWN[key]
                    raise InputError(f"[drawn] {key}: draw {draw} gives {value!r}: {text}")


def _check_lists(study: Study, laws: Mapping[str, Distribution]) -> None:
    """Refuses lists of values, and a grid, that are longer than the draws."""
    there = f"{study.n_draws} {'start times' if study.is_recorded else 'draws'}"
    for key, law in laws.items():
        if law.values and len(law.values) > study.n_draws:
            text = f"has {len(law.values)} entries for {there}"
            raise InputError(f"[drawn] {key}.values: {text}: the last ones are never drawn")
    grids = {key: len(law.grid) for key, law in laws.items() if law.grid}
    if math.prod(grids.values()) > study.n_draws and grids:
        text = f"{math.prod(grids.values())} points of the grid of {', '.join(grids)}"
        raise InputError(f"[drawn] {next(iter(grids))}.grid: {text} are more than {there}")


def _reached(draws: int) -> float:
    """Standard deviations that any of so many normal draws exceeds in one study of a thousand."""
    return min(_SIGMAS, statistics.NormalDist().inv_cdf(1 - 1e-3 / draws))


def _ends(law: Distribution, sigmas: float = _SIGMAS) -> tuple[float, ...]:
    """The least and the greatest number that a law can give, a normal one within some sigmas."""
    if law.uniform:
        return law.uniform
    if law.normal:
        mean, deviation = law.normal
        return mean - sigmas * deviation, mean + sigmas * deviation
    numbers = [n for entry in law.values or law.grid or () for n in np.ravel(entry).tolist()]
    return min(numbers), max(numbers)


def _wrong(key: str, value: float, unchecked: bool) -> str | None:
    """What is wrong with a drawn number."""
    try:
        _validator(key)(value)
    except ValidationError as error:
        return rule(error.errors()[0])
    return None if unchecked else usual.doubt(key, value)


def checked(value: Any, key: str, place: str) -> Any:
    """A value of a key, as a study holds it.

    Args:
        value: to check.
        key: leaf key, or ``case``.
        place: what an error names.

    Raises:
        InputError: it is none.
    """
    if value is None:
        raise InputError(f"{place}: None is no value")
    try:
        return _validator(key)(value)
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"{place}{index(first)}: {explained(first)}") from None


def _axes(tables: TomlTable) -> tuple[Dimension, dict[str, Dimension]]:
    """The axes that stand alone, and the zips."""
    axes, zips = {}, {}
    for key, values in tables.get("axes", {}).items():
        if isinstance(values, Mapping):
            zips[key] = _zip(tables, key, values)
        else:
            axes[key] = _axis("axes", key, values, "record" in tables)
            _refuse_repeated(axes[key], f"[axes] {key}")
    taken = set(axes)
    for name, keys in zips.items():
        for key in keys:
            if key in taken:
                raise InputError(f"[axes.{name}] {key}: is an axis already (drop one of them)")
        taken |= keys.keys()
    return axes, zips


def _zip(tables: TomlTable, name: str, keys: Mapping[str, Any]) -> Dimension:
    """The axes of a table, which go together."""
    table = f"axes.{name}"
    if not keys:
        raise InputError(f"[{table}]: must not be empty")
    joint = {key: _axis(table, key, values, "record" in tables) for key, values in keys.items()}
    first = next(iter(joint))
    for key, values in joint.items():
        if len(values) != len(joint[first]):
            text = f"has {len(values)} values, {first} has {len(joint[first])}"
            raise InputError(f"[{table}] {key}: {text} (the axes of a table go together)")
    _refuse_repeated(list(zip(*joint.values(), strict=True)), f"[{table}] {', '.join(joint)}")
    return joint


def _axis(table: str, key: str, values: Any, recorded: bool) -> tuple[Any, ...]:
    _check_sweepable(table, key, recorded)
    if not isinstance(values, tuple):
        raise InputError(f"[{table}] {key}: must be a list of values, not {values!r}")
    if not values:
        raise InputError(f"[{table}] {key}: must not be empty")
    return tuple(checked(value, key, f"[{table}] {key}[{i}]") for i, value in enumerate(values))


def _cases(tables: TomlTable, axes: set[str]) -> tuple[TomlTable, ...]:
    """The cases, none of whose keys is an axis."""
    rows = tables.get("cases", ())
    if not isinstance(rows, tuple) or not all(isinstance(row, Mapping) for row in rows):
        raise InputError("[cases]: must be tables that each begin with [[cases]]")
    if "cases" in tables and not any(rows):
        raise InputError("[cases]: must not be empty")
    keys = list(rows[0]) if rows else []
    for key in keys:
        if key != "case":
            _check_sweepable("cases", key, "record" in tables)
        if key in axes:
            raise InputError(f"[cases] {key}: is an axis already (drop one of them)")
    for i, row in enumerate(rows):
        for key in (*keys, *row):
            if key not in row or key not in keys:
                raise InputError(f"[cases] {key}[{i}]: all cases must set the same keys")
    cases = tuple(
        {key: checked(row[key], key, f"[cases] {key}[{i}]") for key in keys}
        for i, row in enumerate(rows)
    )
    values = [key for key in keys if key != "case"]
    place = f"[cases] {', '.join(values) or 'case'}"
    _refuse_repeated([tuple(case[key] for key in values) for case in cases], place)
    if "case" in keys:
        _refuse_repeated([case["case"] for case in cases], "[cases] case")
    return cases


def _drawn(tables: TomlTable, taken: Mapping[str, str]) -> DrawnSection | None:
    """How keys are drawn, none of which is given elsewhere."""
    if "drawn" not in tables:
        return None
    table = dict(tables["drawn"])
    sampling = {"sampling": table.pop("sampling")} if "sampling" in table else {}
    if not table:
        raise InputError("[drawn]: names no key to draw")
    laws = {}
    for key, law in table.items():
        _check_drawable(key, "record" in tables)
        if key in taken:
            raise InputError(f"[drawn] {key}: is in {taken[key]} already (drop one of them)")
        laws[key] = _law(key, law)
    try:
        return DrawnSection.model_validate(sampling | laws)
    except ValidationError as error:
        raise InputError(f"[drawn] sampling: {explained(error.errors()[0])}") from None


def _law(key: str, table: Any) -> Distribution:
    """How a key is drawn, every entry of a list checked as the key."""
    if not isinstance(table, Mapping):
        example = f"{key} = {{ uniform = [0, 1] }}"
        raise InputError(f"[drawn] {key}: must be a table such as {example}, not {table!r}")
    for name in table:
        if name not in _LAWS:
            raise InputError(f"[drawn] {key}.{name}: unknown key{near(name, _LAWS)}")
    if len(table) != 1:
        given = " and ".join(table) or "none"
        raise InputError(f"[drawn] {key}: needs one of {', '.join(_LAWS)}, not {given}")
    ((name, value),) = table.items()
    place = f"[drawn] {key}.{name}"
    if value is None:
        raise InputError(f"{place}: None is no value")
    try:
        law = Distribution.model_validate({name: value})
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"{place}{index(first)}: {explained(first)}") from None
    if name not in ("values", "grid"):
        return law
    entries = tuple(checked(entry, key, f"{place}[{i}]") for i, entry in enumerate(value))
    return Distribution.model_validate({name: entries})


def _check_sweepable(table: str, key: str, recorded: bool) -> None:
    section = SECTION_OF.get(key)
    if key == "start_s":
        reason = "is no axis (list the start times in [record]: one draw each)"
    elif section is None:
        sweepable = [name for name, home in SECTION_OF.items() if home in SWEEPABLE]
        reason = unknown(key, sweepable)
    elif section == "study":
        reason = "cannot be swept (all runs of a study share [study])"
    elif section not in SWEEPABLE:
        reason = f"cannot be swept (it is a key of [{section}])"
    elif recorded and section in SIMULATED_ONLY:
        reason = f"does not apply to a recorded study ([{section}] is the simulation's)"
    else:
        return
    raise InputError(f"[{table}] {key}: {reason}")


def _check_drawable(key: str, recorded: bool) -> None:
    section = SECTION_OF.get(key)
    if section is None:
        reason = f"unknown key{near(key, NUMBERS_DRAWN)}"
    elif key not in NUMBERS_DRAWN:
        kinds = "latitude_deg, keys of [motion] and [sensors]"
        reason = f"cannot be drawn (what can: {kinds}, {', '.join(INITIAL_KEYS)})"
    elif recorded and section in SIMULATED_ONLY:
        reason = f"does not apply to a recorded study ([{section}] is the simulation's)"
    elif recorded and key not in INITIAL_KEYS:
        reason = f"cannot be drawn in a recorded study (what can: {', '.join(INITIAL_KEYS)})"
    else:
        return
    raise InputError(f"[drawn] {key}: {reason}")


def _refuse_repeated(values: Sequence[Any], place: str) -> None:
    seen: dict[Any, int] = {}
    for i, value in enumerate(values):
        if seen.setdefault(value, i) < i:
            raise InputError(f"{place}[{i}]: repeats what [{seen[value]}] says")


@functools.cache
def _validator(key: str) -> Callable[[Any], Any]:
    annotation: Any = Name
    if key != "case":
        field = SECTIONS[SECTION_OF[key]].model_fields[key]
        annotation = Annotated[field.annotation, field]
    strict = ConfigDict(strict=True, allow_inf_nan=False)
    return TypeAdapter(annotation, config=strict).validate_python

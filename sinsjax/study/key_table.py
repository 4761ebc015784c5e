"""What every key of a study says: ``python -m sinsjax.study.key_table > docs/keys.md``."""

import re
from typing import Any, Literal, NamedTuple, get_args, get_origin

from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from sinsjax.alignment.methods import BROKEN, METHODS, PACKAGES
from sinsjax.errors import InputError
from sinsjax.messages import near
from sinsjax.study.acting import readers
from sinsjax.study.distributions import Distribution, DrawnSection
from sinsjax.study.keys import EARTH_CONSTANTS, SECTION_OF, SECTIONS, SWEEPABLE
from sinsjax.study.ranges import Range
from sinsjax.units import split_unit
from sinsjax.value_types import Default, Section, mark

TABLES: dict[str, type[Section]] = {
    **SECTIONS,
    "drawn": DrawnSection,
    "drawn.KEY": Distribution,
    "tune.variables.KEY": Range,
}
"""Every table of a study file that has keys of its own."""

_TOLD = re.compile(r"[;,] default:? (?P<default>[^;()]+)$")


class Key(NamedTuple):
    """A key of a study file.

    Attributes:
        section: table that it stands in.
        name: leaf key.
        unit: of its numbers; empty without one.
        default: as a file writes it, or in words; empty where its meaning tells what no key means.
        meaning: in words, with the words that it takes.
        methods: that read it.
    """

    section: str
    name: str
    unit: str
    default: str
    meaning: str
    methods: tuple[str, ...]

    @property
    def read_by(self) -> str:
        """The methods that read it, in words."""
        others = [name for name in METHODS if name not in self.methods]
        if len(others) < len(self.methods):
            return f"all but {', '.join(others)}" if others else "all"
        return ", ".join(self.methods)


_KEYLESS = ("axes", "cases")
_VARYING = (
    "`[axes] KEY = [...]` sweeps a key, `[axes.NAME]` holds axes that go together, `[[cases]]`"
    " gives values and a label (`case`) to each case"
)


def keys(wanted: str | None = None) -> list[Key]:
    """The keys of a study, of one section, or those of one name.

    Args:
        wanted: section, key, ``section.key``, or a method for its own; None for all. What is none
            of these finds the keys whose name contains it.

    Raises:
        InputError: there is none of that name.
    """
    every = [_key(name, *item) for name, m in TABLES.items() for item in m.model_fields.items()]
    if wanted in METHODS:
        own = METHODS[wanted].sections
        return [key for key in every if key.section in own and wanted in key.methods]
    if wanted in BROKEN:
        raise InputError(BROKEN[wanted])
    names = {text for key in every for text in (key.section, key.name, f"{key.section}.{key.name}")}
    if wanted in _KEYLESS:
        raise InputError(f"[{wanted}]: has no keys of its own; {_VARYING}")
    if wanted is not None and wanted not in names:
        if found := [key for key in every if wanted and wanted in key.name]:
            return found
        hint = near(wanted, sorted({*names, *METHODS}))
        raise InputError(f"{wanted}: no section, key or method of a study{hint}")
    return [
        key for key in every if wanted in (None, key.section, key.name, f"{key.section}.{key.name}")
    ]


def about_method(wanted: str | None) -> list[str]:
    """What a method is, in lines; none where no method has that name."""
    if wanted not in METHODS:
        return []
    method = METHODS[wanted]
    package, version = PACKAGES.get(wanted, ("", ""))
    sections = ", ".join(f"[{name}]" for name in method.sections) or "none"
    reads = ", ".join(key for key in method.reads if key not in method.silent) or "nothing"
    return [
        f"{wanted}: {method.summary}",
        f"    source: {method.source}",
        *([f"    package: {package} {version}"] if package else []),
        f"    sections of its own: {sections}; of [alignment] and [passes] it reads {reads}",
        *([f"    takes without effect: {', '.join(method.silent)}"] if method.silent else []),
    ]


def page() -> str:
    """Every key with unit, default, meaning and the methods that read it, as Markdown."""
    sweepable = ", ".join(f"[{name}]" for name in SWEEPABLE)
    lines = [
        "# Keys of a study",
        "",
        "`sinsjax keys [SECTION|KEY]` prints these tables. A key without a default may be left out"
        " unless it is required; its meaning says what then holds. Keys of some methods act where a"
        " variant has one of them; `all` stands for any method.",
        "",
        f"Every key of {sweepable} may vary: {_VARYING}. A key has one place: in its section, or in"
        " what varies it.",
    ]
    for name, model in TABLES.items():
        lines += ["", f"## [{name}]", "", purpose(model), ""]
        lines += ["| key | unit | default | meaning | methods |", "| --- | --- | --- | --- | --- |"]
        for key in (key for key in keys(name) if key.section == name):
            cells = (f"`{key.name}`", key.unit, key.default, key.meaning, key.read_by)
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def _key(section: str, name: str, field: FieldInfo) -> Key:
    meaning, told = _split(field.description or "")
    choices = " | ".join(_toml(word) for word in words(field.annotation))
    methods = readers(name) if SECTION_OF.get(name) == section else tuple(METHODS)
    return Key(
        section,
        name,
        split_unit(name)[1],
        _default(name, field) or told,
        f"{meaning} ({choices})" if choices else meaning,
        methods,
    )


def _split(description: str) -> tuple[str, str]:
    """A description without the default that it ends with, and that default."""
    found = _TOLD.search(description)
    return (description[: found.start()], found["default"]) if found else (description, "")


def words(annotation: Any) -> tuple[str, ...]:
    """The words that a key takes; none for a key of numbers or of any text."""
    if get_origin(annotation) is Literal:
        return get_args(annotation)
    return next(filter(None, map(words, get_args(annotation))), ())


def _default(name: str, field: FieldInfo) -> str:
    """The default of a key as a file writes it; empty where that is not one value."""
    marked = mark(field, Default)
    if marked is not None:
        return _toml(marked.value)
    if name in EARTH_CONSTANTS:
        return _toml(EARTH_CONSTANTS[name])
    if field.default_factory is not None or field.default in (None, PydanticUndefined):
        required = field.is_required() and not _split(field.description or "")[1]
        return "required" if required else ""
    return _toml(field.default)


def _toml(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        return ""
    return f'"{value}"' if isinstance(value, str) else f"{value:.12g}"


def purpose(model: type[Section]) -> str:
    """What a section is for: the first paragraph of its docstring, without its name."""
    text = " ".join((model.__doc__ or "").strip().partition("\n\n")[0].split())
    text = text.partition("]: ")[2] or text
    return text if "(" in text.split()[0] else text[:1].upper() + text[1:]


if __name__ == "__main__":
    print(page(), end="")

"""The page of all keys, ``python -m sinsjax.study.key_table > docs/keys.md``, and its parts."""

from sinsjax.alignment.methods import BROKEN, METHODS, PACKAGES
from sinsjax.errors import InputError
from sinsjax.messages import near
from sinsjax.study.keys import KEYS, SWEEPABLE, TABLES, Key
from sinsjax.value_types import Section

_KEYLESS = ("axes", "cases")
_VARYING = (
    "`[axes] KEY = [...]` sweeps a key, `[axes.NAME]` holds axes that go together, `[[cases]]`"
    " gives values and a label (`case`) to each case"
)


def find_keys(wanted: str | None = None) -> list[Key]:
    """The keys of a study, of one section, or those of one name.

    Args:
        wanted: section, key, ``section.key``, or a method for its own; None for all. What is none
            of these finds the keys whose name contains it.

    Raises:
        InputError: there is none of that name.
    """
    every = [*KEYS.values()]
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
        for key in (key for key in KEYS.values() if key.section == name):
            cells = (f"`{key.name}`", key.unit, key.default, key.meaning, key.read_by)
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def purpose(model: type[Section]) -> str:
    """What a section is for: the first paragraph of its docstring, without its name."""
    text = " ".join((model.__doc__ or "").strip().partition("\n\n")[0].split())
    text = text.partition("]: ")[2] or text
    return text if "(" in text.split()[0] else text[:1].upper() + text[1:]


if __name__ == "__main__":
    print(page(), end="")

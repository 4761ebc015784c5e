"""The page of all keys: ``python -m sinsjax.study.key_table > docs/keys.md``."""

from sinsjax.errors import InputError
from sinsjax.messages import suggest_closest
from sinsjax.methods.registry import BROKEN, METHODS, PACKAGES
from sinsjax.study.keys import KEYS, SWEEPABLE, TABLES, Key
from sinsjax.value_types import Section

_KEYLESS = ("axes", "cases")
_ALL_KEYS = " (`sinsjax keys` lists all keys)"
_VARYING = (
    "`[axes] KEY = [...]` sweeps a key, `[axes.NAME]` sweeps several keys together, `[[cases]]`"
    " lists values and a label (`case`) per case"
)


def find_keys(wanted: str | None = None) -> list[Key]:
    """Return all keys of a study, or those of a section, a method or a name.

    Args:
        wanted: section, key, ``section.key``, or a method for the keys of its sections; None for
            all keys. Any other text finds the keys whose name contains it.

    Raises:
        InputError: nothing has this name.
    """
    every = [*KEYS.values()]
    if wanted in METHODS:
        own = METHODS[wanted].sections
        return [key for key in every if key.section in own and wanted in key.methods]
    if wanted in BROKEN:
        raise InputError(BROKEN[wanted])
    names = {text for key in every for text in (key.section, key.name, f"{key.section}.{key.name}")}
    if wanted in _KEYLESS:
        raise InputError(f"[{wanted}]: has the keys of other sections ({_VARYING})")
    if wanted is not None and wanted not in names:
        if found := [key for key in every if wanted and wanted in key.name]:
            return found
        hint = suggest_closest(wanted, sorted({*names, *METHODS}))
        raise InputError(f"{wanted}: unknown section, key or method{hint or _ALL_KEYS}")
    return [
        key for key in every if wanted in (None, key.section, key.name, f"{key.section}.{key.name}")
    ]


def about_method(wanted: str | None) -> list[str]:
    """Return the description of a method in lines; empty for another name."""
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
        f"    sections: {sections}; keys of [alignment] and [passes]: {reads}",
        *([f"    keys without effect: {', '.join(method.silent)}"] if method.silent else []),
    ]


def page() -> str:
    """Return the page of all keys, with unit, default, meaning and methods, as Markdown."""
    sweepable = ", ".join(f"[{name}]" for name in SWEEPABLE)
    lines = [
        "# Keys of a study",
        "",
        "`sinsjax keys [SECTION|KEY|METHOD]` prints these tables. Only keys whose default is"
        " `required` must be given in every study; some others are required in certain studies, as"
        " their meaning states. The last column lists the methods that read a key.",
        "",
        f"The keys of {sweepable} may vary: {_VARYING}. A study gives a key once: in its section,"
        " or in a table that varies it.",
    ]
    for name, model in TABLES.items():
        lines += ["", f"## [{name}]", "", purpose(model), ""]
        lines += ["| key | unit | default | meaning | methods |", "| --- | --- | --- | --- | --- |"]
        for key in (key for key in KEYS.values() if key.section == name):
            cells = (f"`{key.name}`", key.unit, key.default, key.meaning, key.read_by)
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def purpose(model: type[Section]) -> str:
    """Return the purpose of a section: the first paragraph of its docstring, without its name."""
    text = " ".join((model.__doc__ or "").strip().partition("\n\n")[0].split())
    text = text.partition("]: ")[2] or text
    return text if "(" in text.split()[0] else text[:1].upper() + text[1:]


if __name__ == "__main__":
    print(page(), end="")

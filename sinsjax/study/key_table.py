"""The page of all keys: ``python -m sinsjax.study.key_table > docs/keys.md``."""

from itertools import compress

from sinsjax.errors import InputError
from sinsjax.messages import suggest_closest
from sinsjax.methods.method import INITIAL_KEYS
from sinsjax.methods.registry import BROKEN, METHODS, PACKAGES
from sinsjax.study.keys import KEYS, SWEEPABLE, TABLES, Key
from sinsjax.value_types import Section

_KEYLESS = ("axes", "cases")
_ALL = "all methods"
_ALL_KEYS = " (`sinsjax keys` lists all keys)"
_VARYING = (
    "`[axes] KEY = [...]` sweeps a key, `[axes.NAME]` several together, `[[cases]]`"
    " lists values and a label (`case`) per case"
)


def find_keys(name: str | None = None) -> list[Key]:
    """Return all keys of a study, or those of a section, a method or a name.

    Args:
        name: section, key, ``section.key``, or a method for the keys of its sections; None for
            all keys; a section has those of its tables. Any other text finds the keys whose name
            contains it.

    Raises:
        InputError: nothing has this name.
    """
    all_keys = [*KEYS.values()]
    if name in METHODS:
        sections = METHODS[name].sections
        return [key for key in all_keys if key.section in sections and name in key.methods]
    if name in BROKEN:
        raise InputError(BROKEN[name])
    names = {
        text for key in all_keys for text in (key.section, key.name, f"{key.section}.{key.name}")
    }
    if name in _KEYLESS:
        raise InputError(f"[{name}]: has the keys of other sections ({_VARYING})")
    if name is not None and name not in names:
        if matches := [key for key in all_keys if name and name in key.name]:
            return matches
        hint = suggest_closest(name, sorted({*names, *METHODS}))
        raise InputError(f"{name}: unknown section, key or method{hint or _ALL_KEYS}")
    return [
        key
        for key in all_keys
        if name in (None, key.section, key.name, f"{key.section}.{key.name}")
        or key.section.startswith(f"{name}.")
    ]


def describe_method(method_name: str | None) -> list[str]:
    """Return the description of a method in lines; empty for another name."""
    if method_name not in METHODS:
        return []
    method = METHODS[method_name]
    package, version = PACKAGES.get(method_name, ("", ""))
    sections = ", ".join(f"[{name}]" for name in method.sections) or "none"
    read = (key for key in (*INITIAL_KEYS, *method.reads) if key not in method.idle_keys)
    reads = ", ".join(read) or "nothing"
    return [
        f"{method_name}: {method.summary}",
        f"    source: {method.source}",
        *([f"    package: {package} {version}"] if package else []),
        f"    sections: {sections}; keys of [alignment] and [passes]: {reads}",
        *([f"    keys without effect: {', '.join(method.idle_keys)}"] if method.idle_keys else []),
    ]


def keys_page() -> str:
    """Return the page of all keys, with unit, default, meaning and methods, as Markdown."""
    sweepable = ", ".join(f"[{name}]" for name in SWEEPABLE)
    lines = [
        "# Keys of a study",
        "",
        "`sinsjax keys [SECTION|KEY|METHOD]` prints this reference. A name ends in the unit of its"
        " numbers: `_deg_per_sqrt_h` is deg/sqrt(h). Unless noted, all methods read a key. The"
        f" filters are {', '.join(_filters())}.",
        "",
        f"The keys of {sweepable} may vary: {_VARYING}. Give a key once: in its section or a table"
        " that varies it.",
    ]
    for name, model in TABLES.items():
        keys = [key for key in KEYS.values() if key.section == name]
        readers = [_readers(key) for key in keys]
        usual, mixed = max(readers, key=readers.count), len({*readers}) > 1
        purpose = section_purpose(model)
        if usual != _ALL or mixed:
            purpose += f" Read by {usual}" + (", or the methods in brackets." if mixed else ".")
        groups: dict[str, list[Key]] = {}
        for key, read_by in zip(keys, readers, strict=True):
            meaning = key.meaning if read_by == usual else f"{key.meaning} ({read_by})"
            groups.setdefault(meaning, []).append(key)
        rows = [("key", "default", "meaning")]
        for meaning, group in groups.items():
            defaults = [key.default for key in group]
            shown = defaults[:1] if len({*defaults}) == 1 else defaults
            rows.append((", ".join(f"`{key.name}`" for key in group), ", ".join(shown), meaning))
        used = [any(column[1:]) for column in zip(*rows, strict=True)]
        head, *body = ([*compress(row, used)] for row in rows)
        lines += ["", f"## [{name}]", "", purpose, ""]
        lines += [_format_row(head), "|---" * len(head) + "|", *map(_format_row, body)]
    return "\n".join(lines) + "\n"


def _format_row(cells: list[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _filters() -> list[str]:
    return [name for name, method in METHODS.items() if "filter" in method.sections]


def _readers(key: Key) -> str:
    """Return the methods that read a key, with the filters as one name."""
    if len(key.methods) == len(METHODS):
        return _ALL
    filters = _filters()
    if set(key.methods) < set(filters):
        others = [name for name in filters if name not in key.methods]
        few = len(others) < len(key.methods)
        return f"the filters but {', '.join(others)}" if few else ", ".join(key.methods)
    if not set(filters) <= set(key.methods):
        return ", ".join(key.methods)
    return " and ".join(["the filters", *(name for name in key.methods if name not in filters)])


def section_purpose(model: type[Section]) -> str:
    """Return the purpose of a section: the first paragraph of its docstring, without its name."""
    text = " ".join((model.__doc__ or "").strip().partition("\n\n")[0].split())
    text = text.partition("]: ")[2] or text
    return text if "(" in text.split()[0] else text[:1].upper() + text[1:]


if __name__ == "__main__":
    print(keys_page(), end="")

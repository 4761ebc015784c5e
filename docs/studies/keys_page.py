"""Render docs/keys.md and configs/schema.json, by which editors complete and explain keys.

``python -m docs.studies.keys_page > docs/keys.md``, with ``--schema > configs/schema.json``.
"""

import json
import sys
from typing import Any

from sinsjax.study.keys import KEYS, SECTION_OF, SWEEPABLE, TABLES, TUNABLE, VARYING, Key
from sinsjax.study.schema import NUMBERS_DRAWN
from sinsjax.value_types import Section


def keys_page() -> str:
    """Return the page of all keys, with default, meaning and methods, as Markdown."""
    sweepable = ", ".join(f"[{name}]" for name in SWEEPABLE)
    of_filters = KEYS["filter", "p0_velocity_m_per_s"]
    lines = [
        "# Keys of a study",
        "",
        "`sinsjax keys [SECTION|KEY|METHOD]` prints this reference. A name ends in the unit of its"
        " numbers: `_deg_per_sqrt_h` is deg/sqrt(h). Brackets after a name hold the default, those"
        " at the end the methods that read the key, where they are not those of the section. The"
        f" filters are {', '.join(of_filters.methods)}.",
        "",
        f"The keys of {sweepable} may vary: {VARYING}. Give a key once: in its section or in a"
        " table that varies it.",
    ]
    for table, model in TABLES.items():
        keys = [key for key in KEYS.values() if key.section == table]
        readers = [key.readers_text.replace(of_filters.readers_text, "the filters") for key in keys]
        usual = max(readers, key=readers.count)
        read_by = "" if {*readers} == {"all"} else f" Read by {usual}."
        lines += ["", f"## [{table}]", "", section_purpose(model) + read_by, ""]
        rows: dict[str, list[Key]] = {}
        for key, reader in zip(keys, readers, strict=True):
            note = "" if reader == usual else f" ({reader})"
            rows.setdefault(key.meaning + note, []).append(key)
        for meaning, alike in rows.items():
            names = ", ".join(f"`{key.name}`" for key in alike)
            defaults = ", ".join(dict.fromkeys(key.default for key in alike if key.default))
            lines.append(f"- {names}{f' ({defaults})' if defaults else ''}: {meaning}")
    return "\n".join(lines) + "\n"


def section_purpose(model: type[Section]) -> str:
    """Return the purpose of a section: the first paragraph of its docstring, without its name."""
    text = " ".join((model.__doc__ or "").strip().partition("\n\n")[0].split())
    text = text.partition("]: ")[2] or text
    return text if "(" in text.split()[0] else text[:1].upper() + text[1:]


def study_schema() -> dict[str, Any]:
    """Return the JSON schema of a study file, draft 7. It has no rules between keys."""
    definitions, tables = dict[str, dict[str, Any]](), dict[str, dict[str, Any]]()
    for table, model in TABLES.items():
        properties = model.model_json_schema()["properties"]
        for name in properties:
            key = KEYS[table, name]
            parts = {"unit": key.unit, "default": key.default, "methods": key.readers_text}
            known = "; ".join(f"{part}: {text}" for part, text in parts.items() if text)
            definitions[f"{table}.{name}"] = _simplify_schema(properties[name]) | {
                "description": f"{key.meaning}; {known}"
            }
        known_keys = {name: _reference(f"{table}.{name}") for name in properties}
        tables[table] = _object_of(known_keys, section_purpose(model))
    swept = {
        key: tables[name]["properties"][key]
        for key, name in SECTION_OF.items()
        if name in SWEEPABLE
    }
    tuned = {key: value for key, value in swept.items() if SECTION_OF[key] in TUNABLE}
    lists = {key: _list_of(value) for key, value in swept.items()}
    tuned_range, zips = _reference("tune.variables.KEY"), _reference("axes.NAME")
    ranges = dict.fromkeys(tuned, {"anyOf": [tuned_range, _list_of(tuned_range)]})
    axes = {key: {"anyOf": [value, zips]} for key, value in lists.items()}
    definitions |= {
        "drawn.KEY": tables.pop("drawn.KEY"),
        "tune.variables.KEY": tables.pop("tune.variables.KEY"),
        "tune.variables": _object_of(ranges, "ranges of the tuned keys"),
        "tune.baseline": _object_of(tuned, "values to compare the tuned ones with"),
        "axes.NAME": _object_of(lists, "keys that are swept together"),
    }
    tables["drawn"]["properties"] |= dict.fromkeys(NUMBERS_DRAWN, _reference("drawn.KEY"))
    tables["axes"] = _object_of(axes, "values over which keys are swept")
    tables["axes"]["additionalProperties"] = zips
    tables["cases"] = _list_of(_object_of({"case": {"type": "string"}, **swept}, "one case"))
    version = "http://json-schema.org/draft-07/schema#"
    study = _object_of(tables) | {"definitions": definitions}
    return {"$schema": version, "title": "sinsjax study", **study}


def _simplify_schema(value: Any) -> Any:
    """Return a schema without titles, defaults and null, which TOML does not have."""
    if isinstance(value, list):
        return [_simplify_schema(entry) for entry in value if entry != {"type": "null"}]
    if not isinstance(value, dict):
        return value
    hidden = ("title", "default", "discriminator", "info")
    out = {key: _simplify_schema(entry) for key, entry in value.items() if key not in hidden}
    for kind in ("anyOf", "oneOf"):
        if len(out.get(kind, ())) == 1:
            out |= out.pop(kind)[0]
    return out


def _reference(name: str) -> dict[str, Any]:
    return {"$ref": f"#/definitions/{name}"}


def _list_of(entry: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": entry}


def _object_of(properties: dict[str, Any], description: str = "") -> dict[str, Any]:
    described = {"description": description} if description else {}
    return {"type": "object", **described, "properties": properties, "additionalProperties": False}


if __name__ == "__main__":
    as_schema = "--schema" in sys.argv
    text = json.dumps(study_schema(), indent=1, ensure_ascii=False) if as_schema else keys_page()
    print(text.rstrip())

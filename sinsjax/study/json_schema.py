"""The keys of a study for editors: ``python -m sinsjax.study.json_schema > configs/schema.json``.

An editor that knows JSON schemas of TOML files (Taplo, Even Better TOML) completes and explains the
keys of a file that begins with ``#:schema`` and the way to it. What a study may hold together is
not told there: `sinsjax validate` checks it.
"""

import json
from typing import Any

from sinsjax.study.key_table import purpose
from sinsjax.study.keys import KEYS, SECTION_OF, SECTIONS, SWEEPABLE, TABLES, TUNABLE
from sinsjax.study.schema import NUMBERS_DRAWN

Schema = dict[str, Any]


def schema() -> Schema:
    """The JSON schema of a study file, draft 7."""
    definitions: Schema = {}
    tables = {name: _table(name, definitions) for name in SECTIONS}
    swept = {key: _of(name, key) for key, name in SECTION_OF.items() if name in SWEEPABLE}
    lists = {key: _list(value) for key, value in swept.items()}
    tuned = {key: value for key, value in swept.items() if SECTION_OF[key] in TUNABLE}
    for name in ("drawn.KEY", "tune.variables.KEY"):
        definitions[name] = _table(name, definitions)
    law, one = ({"$ref": f"#/definitions/{name}"} for name in ("drawn.KEY", "tune.variables.KEY"))
    ranges = {key: {"anyOf": [one, _list(one)]} for key in tuned}
    definitions["tune.variables"] = _object("what may change", ranges)
    definitions["tune.baseline"] = _object("what to stand beside", tuned)
    definitions["axes.NAME"] = _object("axes that go together", lists)
    zips = {"$ref": "#/definitions/axes.NAME"}
    axes = {key: {"anyOf": [value, zips]} for key, value in lists.items()}
    tables["axes"] = {
        **_object("values that keys are swept over", axes),
        "additionalProperties": zips,
    }
    tables["cases"] = _list(_object("one case", {"case": {"type": "string"}, **swept}))
    tables["drawn"] = _table("drawn", definitions)
    tables["drawn"]["properties"] |= dict.fromkeys(NUMBERS_DRAWN, law)
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "sinsjax study",
        **_object("", tables),
        "definitions": definitions,
    }


def text() -> str:
    """The schema as a file."""
    return json.dumps(schema(), indent=1, ensure_ascii=False) + "\n"


def _table(name: str, definitions: Schema) -> Schema:
    """A table of keys, whose schemas are put among the definitions."""
    made = TABLES[name].model_json_schema()["properties"]
    for key in (key for key in KEYS.values() if key.section == name):
        told = f"{key.meaning}; default: {key.default}; methods: {key.read_by}"
        if not key.default:
            told = f"{key.meaning}; methods: {key.read_by}"
        definitions[f"{name}.{key.name}"] = _plain(made[key.name]) | {"description": told}
    return _object(
        purpose(TABLES[name]), {key: _of(name, key) for key in TABLES[name].model_fields}
    )


def _plain(value: Any) -> Any:
    """A schema without titles, defaults and null, which no TOML file has."""
    if isinstance(value, list):
        return [_plain(entry) for entry in value if entry != {"type": "null"}]
    if not isinstance(value, dict):
        return value
    out = {key: _plain(v) for key, v in value.items() if key not in ("title", "default")}
    for kind in ("anyOf", "oneOf"):
        if len(out.get(kind, ())) == 1:
            out |= out.pop(kind)[0]
    out.pop("discriminator", None)
    return out


def _of(section: str, key: str) -> Schema:
    return {"$ref": f"#/definitions/{section}.{key}"}


def _list(entry: Schema) -> Schema:
    return {"type": "array", "items": entry}


def _object(description: str, properties: Schema) -> Schema:
    told = {"description": description} if description else {}
    return {"type": "object", **told, "properties": properties, "additionalProperties": False}


if __name__ == "__main__":
    print(text(), end="")

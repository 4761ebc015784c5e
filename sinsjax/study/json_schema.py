"""The keys of a study for editors: ``python -m sinsjax.study.json_schema > configs/schema.json``.

An editor with support for JSON schemas of TOML files (Taplo, Even Better TOML) completes and
explains the keys of a file that starts with ``#:schema`` and the path of the schema. The schema has
no rules between keys: `sinsjax validate` checks them.
"""

import json
from typing import Any

from sinsjax.study.key_table import purpose
from sinsjax.study.keys import KEYS, SECTION_OF, SECTIONS, SWEEPABLE, TABLES, TUNABLE
from sinsjax.study.schema import NUMBERS_DRAWN

Schema = dict[str, Any]


def schema() -> Schema:
    """Return the JSON schema of a study file, draft 7."""
    definitions: Schema = {}
    tables = {name: _table(name, definitions) for name in SECTIONS}
    swept = {key: _reference(name, key) for key, name in SECTION_OF.items() if name in SWEEPABLE}
    lists = {key: _list(value) for key, value in swept.items()}
    tuned = {key: value for key, value in swept.items() if SECTION_OF[key] in TUNABLE}
    for name in ("drawn.KEY", "tune.variables.KEY"):
        definitions[name] = _table(name, definitions)
    law, one = ({"$ref": f"#/definitions/{name}"} for name in ("drawn.KEY", "tune.variables.KEY"))
    ranges = {key: {"anyOf": [one, _list(one)]} for key in tuned}
    definitions["tune.variables"] = _object("ranges of the tuned keys", ranges)
    definitions["tune.baseline"] = _object("values to compare the tuned ones with", tuned)
    definitions["axes.NAME"] = _object("keys that are swept together", lists)
    zips = {"$ref": "#/definitions/axes.NAME"}
    axes = {key: {"anyOf": [value, zips]} for key, value in lists.items()}
    tables["axes"] = {
        **_object("values over which keys are swept", axes),
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
    """Return the schema as the text of a file."""
    return json.dumps(schema(), indent=1, ensure_ascii=False) + "\n"


def _table(name: str, definitions: Schema) -> Schema:
    """Return the schema of a table, with the schemas of its keys added to the definitions."""
    properties = TABLES[name].model_json_schema()["properties"]
    for key in (key for key in KEYS.values() if key.section == name):
        default = f"default: {key.default}; " if key.default else ""
        description = f"{key.meaning}; {default}methods: {key.read_by}"
        schema_of_key = _simplify(properties[key.name]) | {"description": description}
        definitions[f"{name}.{key.name}"] = schema_of_key
    return _object(
        purpose(TABLES[name]), {key: _reference(name, key) for key in TABLES[name].model_fields}
    )


def _simplify(value: Any) -> Any:
    """Return a schema without titles, defaults and null, which TOML does not have."""
    if isinstance(value, list):
        return [_simplify(entry) for entry in value if entry != {"type": "null"}]
    if not isinstance(value, dict):
        return value
    out = {key: _simplify(v) for key, v in value.items() if key not in ("title", "default")}
    for kind in ("anyOf", "oneOf"):
        if len(out.get(kind, ())) == 1:
            out |= out.pop(kind)[0]
    out.pop("discriminator", None)
    return out


def _reference(section: str, key: str) -> Schema:
    return {"$ref": f"#/definitions/{section}.{key}"}


def _list(entry: Schema) -> Schema:
    return {"type": "array", "items": entry}


def _object(description: str, properties: Schema) -> Schema:
    described = {"description": description} if description else {}
    return {"type": "object", **described, "properties": properties, "additionalProperties": False}


if __name__ == "__main__":
    print(text(), end="")

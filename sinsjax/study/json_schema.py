"""The keys of a study for editors: ``python -m sinsjax.study.json_schema > configs/schema.json``.

An editor with support for JSON schemas of TOML files (Taplo, Even Better TOML) completes and
explains the keys of a file that starts with ``#:schema`` and the path of the schema. The schema has
no rules between keys: `sinsjax validate` checks them.
"""

import json
from typing import Any

from sinsjax.study.key_table import section_purpose
from sinsjax.study.keys import KEYS, SECTION_OF, SECTIONS, SWEEPABLE, TABLES, TUNABLE
from sinsjax.study.schema import NUMBERS_DRAWN

Schema = dict[str, Any]


def study_schema() -> Schema:
    """Return the JSON schema of a study file, draft 7."""
    definitions: Schema = {}
    tables = {name: _table_schema(name, definitions) for name in SECTIONS}
    swept = {
        key: _reference_schema(name, key) for key, name in SECTION_OF.items() if name in SWEEPABLE
    }
    lists = {key: _list_schema(value) for key, value in swept.items()}
    tuned = {key: value for key, value in swept.items() if SECTION_OF[key] in TUNABLE}
    for name in ("drawn.KEY", "tune.variables.KEY"):
        definitions[name] = _table_schema(name, definitions)
    distribution, tuned_range = (
        {"$ref": f"#/definitions/{name}"} for name in ("drawn.KEY", "tune.variables.KEY")
    )
    ranges = {key: {"anyOf": [tuned_range, _list_schema(tuned_range)]} for key in tuned}
    definitions["tune.variables"] = _object_schema("ranges of the tuned keys", ranges)
    definitions["tune.baseline"] = _object_schema("values to compare the tuned ones with", tuned)
    definitions["axes.NAME"] = _object_schema("keys that are swept together", lists)
    zips = {"$ref": "#/definitions/axes.NAME"}
    axes = {key: {"anyOf": [value, zips]} for key, value in lists.items()}
    tables["axes"] = {
        **_object_schema("values over which keys are swept", axes),
        "additionalProperties": zips,
    }
    tables["cases"] = _list_schema(
        _object_schema("one case", {"case": {"type": "string"}, **swept})
    )
    tables["drawn"] = _table_schema("drawn", definitions)
    tables["drawn"]["properties"] |= dict.fromkeys(NUMBERS_DRAWN, distribution)
    tables["advise"] = _table_schema("advise", definitions)
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "sinsjax study",
        **_object_schema("", tables),
        "definitions": definitions,
    }


def schema_text() -> str:
    """Return the schema as the text of a file."""
    return json.dumps(study_schema(), indent=1, ensure_ascii=False) + "\n"


def _table_schema(name: str, definitions: Schema) -> Schema:
    """Return the schema of a table, with the schemas of its keys added to the definitions."""
    properties = TABLES[name].model_json_schema()["properties"]
    for key in (key for key in KEYS.values() if key.section == name):
        unit = f"unit: {key.unit}; " if key.unit else ""
        default = f"default: {key.default}; " if key.default else ""
        description = f"{key.meaning}; {unit}{default}methods: {key.readers_text}"
        schema_of_key = _simplify_schema(properties[key.name]) | {"description": description}
        definitions[f"{name}.{key.name}"] = schema_of_key
    return _object_schema(
        section_purpose(TABLES[name]),
        {key: _reference_schema(name, key) for key in TABLES[name].model_fields},
    )


def _simplify_schema(value: Any) -> Any:
    """Return a schema without titles, defaults and null, which TOML does not have."""
    if isinstance(value, list):
        return [_simplify_schema(entry) for entry in value if entry != {"type": "null"}]
    if not isinstance(value, dict):
        return value
    out = {key: _simplify_schema(v) for key, v in value.items() if key not in ("title", "default")}
    for kind in ("anyOf", "oneOf"):
        if len(out.get(kind, ())) == 1:
            out |= out.pop(kind)[0]
    out.pop("discriminator", None)
    return out


def _reference_schema(section: str, key: str) -> Schema:
    return {"$ref": f"#/definitions/{section}.{key}"}


def _list_schema(entry: Schema) -> Schema:
    return {"type": "array", "items": entry}


def _object_schema(description: str, properties: Schema) -> Schema:
    described = {"description": description} if description else {}
    return {"type": "object", **described, "properties": properties, "additionalProperties": False}


if __name__ == "__main__":
    print(schema_text(), end="")

"""The identity of a study: what distinguishes its results from those of another one."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from sinsjax.messages import shortened
from sinsjax.study.study import Study

NOT_COMPUTED: Any = {"tune": True, "study": {"name", "unchecked"}}
"""What has no effect on the rows of a sweep."""


def fingerprint(study: Study) -> str:
    """Return 16 hex digits that identify what a study computes.

    Name and key order of the file have no effect. The order of the axes, of the zips and of the
    drawn keys has one: it numbers the variants and the points of a design.
    """
    content = study.model_dump(mode="json", exclude=NOT_COMPUTED, exclude_none=True)
    for name in ("axes", "zips", "drawn"):
        content[name] = list(content.get(name, {}).items())
    content["zips"] = [keys for _, keys in content["zips"]]  # their names are free
    text = json.dumps(content, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def with_draws(study: Study, draws: int) -> Study:
    """Return a simulated study with another number of draws and nothing else changed, unchecked."""
    return study.model_copy(update={"study": study.study.model_copy(update={"draws": draws})})


def sections_of(study: Study) -> dict[str, Any]:
    """Return the sections of a resolved study as JSON has them, as a manifest stores them."""
    return study.model_dump(mode="json", exclude_none=True)


def differences(
    old: Study | Mapping[str, Any],
    new: Study | Mapping[str, Any],
    places: tuple[str, str] = ("there", "here"),
) -> list[str]:
    """Return the keys that affect results and differ between two studies, with both values.

    Args:
        old: a study, or its sections from a manifest.
        new: the other.
        places: words for where each of them is.
    """
    before, after = _values(old), _values(new)
    found = [
        f"{key}: {_shown(before.get(key))} {places[0]}, {_shown(after.get(key))} {places[1]}"
        for key in dict.fromkeys((*before, *after))
        if before.get(key) != after.get(key)
    ]
    return found or ["its keys are in another order"]


def _values(study: Study | Mapping[str, Any]) -> dict[str, Any]:
    """Values of a study by section and key of its file."""
    content = sections_of(study) if isinstance(study, Study) else dict(study)
    content.pop("tune", None)
    own = _table(content.get("study"))
    content["study"] = {k: v for k, v in own.items() if k not in ("name", "unchecked")}
    tables = {f"axes.{name}": keys for name, keys in _table(content.pop("zips", None)).items()}
    drawn = dict(_table(content.pop("drawn", None)))
    tables["drawn"] = {**_table(drawn.pop("laws", None)), **drawn}
    cases = content.pop("cases", None)
    for i, case in enumerate(cases if isinstance(cases, list) else ()):
        tables[f"cases {i}"] = case
    return {
        f"[{table}] {key}": value
        for table, keys in (content | tables).items()
        for key, value in _table(keys).items()
    }


def _table(value: Any) -> Mapping[str, Any]:
    """A table of a manifest; empty if there is something else in its place."""
    return value if isinstance(value, Mapping) else {}


def _shown(value: Any) -> str:
    return "none" if value is None else shortened(str(value), 60)

"""The keys in which two studies differ, for messages."""

from collections.abc import Mapping
from typing import Any

from sinsjax.messages import shortened
from sinsjax.study.study import Study


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
    content["study"] = dict(content.get("study", {}))
    for key in ("name", "unchecked"):
        content["study"].pop(key, None)
    tables = {f"axes.{name}": keys for name, keys in content.pop("zips", {}).items()}
    drawn = content.pop("drawn", {})
    tables["drawn"] = drawn.get("laws", {}) | {k: v for k, v in drawn.items() if k != "laws"}
    for i, case in enumerate(content.pop("cases", ())):
        tables[f"cases {i}"] = case
    return {
        f"[{table}] {key}": value
        for table, keys in (content | tables).items()
        for key, value in keys.items()
    }


def _shown(value: Any) -> str:
    return "none" if value is None else shortened(str(value), 60)

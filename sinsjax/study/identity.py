"""The identity of a study, which distinguishes its results from those of other studies."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from sinsjax.messages import shorten
from sinsjax.study.attitude_file import digest
from sinsjax.study.study import Study

NOT_COMPUTED: Any = {"tune": True, "study": {"name", "unchecked"}}
"""Keys without effect on the rows of a sweep."""


def fingerprint(study: Study) -> str:
    """Return 16 hex digits that identify the results of a study.

    The content of a file of the base's attitude counts, its name too. The name of the study and the
    order of keys in a section have no effect. The order of the axes, of the zips
    and of the drawn keys has: it numbers the variants and the points of a design.
    """
    content = study.model_dump(mode="json", exclude=NOT_COMPUTED, exclude_none=True)
    for name in ("axes", "zips", "drawn"):
        content[name] = list(content.get(name, {}).items())
    if attitude := digest(study):
        content["attitude"] = attitude
    content["zips"] = [keys for _, keys in content["zips"]]  # names have no effect
    text = json.dumps(content, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def with_draws(study: Study, draws: int) -> Study:
    """Return a simulated study with another number of draws, unchecked."""
    return study.model_copy(update={"study": study.study.model_copy(update={"draws": draws})})


def sections_to_json(study: Study) -> dict[str, Any]:
    """Return the sections of a resolved study as JSON values, as a manifest stores them."""
    return study.model_dump(mode="json", exclude_none=True)


def describe_differences(
    old: Study | Mapping[str, Any],
    new: Study | Mapping[str, Any],
    labels: tuple[str, str] = ("there", "here"),
) -> list[str]:
    """Return the keys that affect results and differ between two studies, with both values.

    A study may be the sections of a manifest; the labels are words for the places of both.
    """
    before, after = _values_by_key(old), _values_by_key(new)
    return [
        f"{key}: {shorten(str(before.get(key, 'none')), 60)} {labels[0]},"
        f" {shorten(str(after.get(key, 'none')), 60)} {labels[1]}"
        for key in before | after
        if before.get(key) != after.get(key)
    ] or ["the order of its keys, or the content of [motion] attitude_file"]


def _values_by_key(study: Study | Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a study by section and key of its file."""
    tables = dict(sections_to_json(study) if isinstance(study, Study) else study)
    zips, cases = tables.pop("zips", {}), tables.pop("cases", ())
    tables |= {f"axes.{name}": keys for name, keys in zips.items()}
    tables |= {f"cases {number}": case for number, case in enumerate(cases)}
    names = {f"[study] {key}" for key in NOT_COMPUTED["study"]}
    return {
        place: value
        for name, table in tables.items()
        if name != "tune" and isinstance(table, Mapping)
        for key, value in table.items()
        if (place := f"[{name}] {key}") not in names
    }

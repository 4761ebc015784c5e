"""The identity of a study: what distinguishes its results from those of another one."""

import hashlib
import json
from typing import Any

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

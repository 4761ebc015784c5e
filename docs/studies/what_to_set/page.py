"""The settings that the studies support: what the prose names of their pages, gathered."""

import re
from pathlib import Path
from typing import Any

from sinsjax.report.study_page import PROSE_FILE, Page, Sources

from ..adaptive import page as adaptive
from ..compass_map import page as compass_map
from ..consistency import page as consistency
from ..kalman_passes import page as kalman_passes
from ..reset_law import listed
from ..tuning import page as tuning

SCRIPTS = {
    "reset_cycle": listed,
    "adaptive": adaptive,
    "tuning": tuning,
    "compass_map": compass_map,
    "kalman_passes": kalman_passes,
    "consistency": consistency,
}
"""By the name under which the prose takes a page's values."""


def page(sources: Sources) -> Page:
    """The values and claims of other pages that a line of this one rests on."""
    made = {name: script.page(sources) for name, script in SCRIPTS.items()}
    prose = Path(__file__).with_name(PROSE_FILE).read_text(encoding="utf-8")
    values: dict[str, Any] = {}
    for path in re.findall(r"{{ (\w+\.[.\w]+) }}", prose):
        *parents, last = path.split(".")
        if parents[0] not in SCRIPTS:
            continue  # a table or a figure
        place, found = values, {name: one.values for name, one in made.items()}
        for parent in parents:
            place, found = place.setdefault(parent, {}), found[parent]
        place[last] = found[last]
    claims = {text: holds for one in made.values() for text, holds in one.claims.items()}
    named = {text: claims[text] for text in re.findall(r'claim\("(.*?)"\)', prose)}
    resets = made["reset_cycle"]
    return Page(values, resets.tables, {"answer": resets.figures["answer"]}, named)

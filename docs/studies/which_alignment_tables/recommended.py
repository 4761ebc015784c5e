"""Recommended settings of resets: the values and claims of the study of listed times."""

import numpy as np

from sinsjax.analysis.grids import median_over_draws
from sinsjax.report.base import Table
from sinsjax.report.study_page import Page, Sources

from ..reset_law import listed

RESETS = {
    "no reset": (listed.MEASURED, listed.NONE),
    "one at 50 s": (listed.MEASURED, (50.0,)),
    "two at 10 and 60 s": (listed.MEASURED, listed.TWO),
    "no reset, gravity in A(t)": (listed.GRAVITY, listed.NONE),
}

CLAIMS = (
    "two resets settle every misalignment with feedback up to 1 s",
    "with gravity in A(t) every misalignment settles without reset, feedback up to 1 s",
    "three late resets settle every misalignment under every reading and feedback",
    "one reset at the right time is nearly always enough",
)


def recommended(sources: Sources) -> Page:
    """Return settling times with the recommended resets, and their table by misalignment."""
    study = listed.page(sources)
    names = {
        "worst": study.values["worst"],
        "two": {key: study.values["two"][key] for key in ("mean", "slowest")},
        "late": {"name": study.values["slow"]["late"], "mean": study.values["slow"]["mean"]},
        "single": {key: study.values["single"][key] for key in ("enough", "points")},
    }
    claims = {text: study.claims[text] for text in CLAIMS}
    return Page({"resets": names}, {"settling": _by_misalignment(sources)}, claims=claims)


def _by_misalignment(sources: Sources) -> Table:
    """Return the median settling time of each misalignment, feedback every second."""
    source = sources["reset_cycle_study"]
    grid = listed.layout(source)
    rows = []
    for name, (force, times) in RESETS.items():
        settle_s = grid.at(listed.SETTLE, schedule=times, **listed.HERE | {"force": force})
        for level, medians in zip(grid.axes["level"], median_over_draws(settle_s), strict=True):
            cells = (f"{time:.0f}" if np.isfinite(time) else "never" for time in medians)
            rows.append([name, f"{level:g}", *cells])
    header = ["resets", "level error (deg)"]
    header += [f"heading error {yaw:g} deg" for yaw in grid.axes["yaw"]]
    note = f"Medians of {grid.draws} draws, s; feedback every second."
    return Table("Settling times", header, rows, note, folded=True)

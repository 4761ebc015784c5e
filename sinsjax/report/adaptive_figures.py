"""Figures of reset policies against the best single reset of each cell."""

import math

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.analysis import Estimate
from sinsjax.plots import COLOURS
from sinsjax.plots.cells import Class, beside, ratio_maps
from sinsjax.report.adaptive_scores import WITHIN, Scores
from sinsjax.report.base import Picture, yardstick
from sinsjax.report.reset_grid import BAND_ARCMIN, NONE, PAPER_READING, PAPER_SCHEDULE

_SOONER, _SLOW, _SLOWER = 0.9, 1.5, 3.0
_CLASSES = (
    Class(_SOONER, f"up to {_SOONER:g}", COLOURS[0], dark=True),
    Class(WITHIN, f"up to {WITHIN:g}", "#c9e3f4"),
    Class(_SLOW, f"up to {_SLOW:g}", "#fbe3b3"),
    Class(_SLOWER, f"up to {_SLOWER:g}", COLOURS[4]),
    Class(math.inf, "beyond", COLOURS[1], dark=True),
)
_SIDE = "misalignment at the start (deg)"


def ratios(scores: Scores) -> Picture:
    """The ratio to the oracle in every cell, for the best threshold of each trigger."""
    cells = scores.cells
    shape = len(cells.tunings), len(cells.judged)
    panels = []
    for place in scores.by_trigger.values():
        values = scores.ratios[:, place]
        count = int((values <= WITHIN).sum())
        name = f"{cells.policies[place].name}: {count} of {cells.n_cells}"
        panels.append((name, values.reshape(shape).T))
    return Picture(
        "ratios",
        f"Median settling time to {BAND_ARCMIN} arcmin over {cells.draws} draws as a multiple of"
        " the oracle's, for the best threshold of each trigger; above each panel, in how many"
        f" cells it is at most {WITHIN:g}. 0.00: there the oracle never settles."
        f" {yardstick(cells.study)}",
        ratio_maps(
            panels,
            _CLASSES,
            "Settling time over that of the best single reset",
            rows=[cells.starts[i].name for i in cells.judged],
            columns=[tuning.name for tuning in cells.tunings],
            side=_SIDE,
        ),
    )


def settling(scores: Scores) -> Picture:
    """Median settling times by start at the paper's feedback interval, and when the best fires."""
    cells, best = scores.cells, scores.choice.place
    name = cells.policies[best].name
    panels: dict[str, dict[str, list[Estimate]]] = {}
    spans: dict[str, list[tuple[float, float]]] = {}
    for tuning in cells.tuned(PAPER_READING.feedback_s):
        at = [(tuning, start) for start in cells.judged]
        fixed = {"none": NONE, "the paper's three": PAPER_SCHEDULE}
        lines = {
            line: [analysis.quantile(cells.settle_s[*one, cells.policy(times)]) for one in at]
            for line, times in fixed.items()
        }
        lines["oracle"] = [scores.oracle[one].median for one in at]
        lines[name] = [analysis.quantile(cells.settle_s[*one, best]) for one in at]
        title = f"Q {cells.tunings[tuning].q}, feedback {cells.tunings[tuning].feedback_s:g} s"
        panels[title] = lines
        spans[title] = [
            (middle(cells.first_s[*one, best]), middle(cells.last_s[*one, best])) for one in at
        ]
    return Picture(
        "settling",
        f"Median settling time to {BAND_ARCMIN} arcmin with its 95 % interval over {cells.draws}"
        f" draws, by start, at the feedback interval of the paper. Grey: from the median first to"
        f" the median last reset of {name}, where it fires in half of the runs or more."
        f" {yardstick(cells.study)}",
        beside(
            [cells.starts[i].name for i in cells.judged],
            panels,
            spans,
            "How long does the heading take, and when does the trigger reset?",
            side=_SIDE,
            quantity="time (s)",
            span=f"resets of {name}",
        ),
    )


def middle(times_s: NDArray) -> float:
    """Median of the times of resets; NaN where fewer than half of the runs have one."""
    known = times_s[np.isfinite(times_s)]
    return analysis.quantile(known).value if 2 * known.size >= times_s.size else math.nan

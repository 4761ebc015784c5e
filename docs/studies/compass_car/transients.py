"""What the turns of a tape do to the heading at the end, told from the tilt at the turns.

A turn that reflects the tilt exactly lets the loops go on as if the data were new. Any other turn
leaves a tilt that should not be there: a kick. A reflecting turn kicks where the base moves, as the
specific force is then not that of the tilt alone; flipping the velocity kicks by twice the tilt.
The azimuth loop takes any tilt for the sign of a wrong heading. As its heading is linear in the
kicks, what they do can be told.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from sinsjax import analysis, plots
from sinsjax.alignment.compass import design as loops
from sinsjax.analysis import rms
from sinsjax.plots import Ensemble
from sinsjax.plots.starts import falling
from sinsjax.report.base import Picture, Source, Table
from sinsjax.report.output import counted
from sinsjax.study.load import one_variant

from ..loops.linear import Loops, loops_of
from .cases import Case, partner, turned_by

_REFLECTED = np.array([-1.0, -1.0, 1.0, 1.0])  # the turn after which a pass goes on exactly


def turn_times(model: Loops, end_s: float) -> NDArray:
    """Update times of the turns before the end at which the azimuth loop is at work, s."""
    turns = np.arange(1, np.ceil(round(end_s / model.tape_s, 9))) * model.tape_s
    return turns[turns >= float(model.params.azimuth_from) / model.rate_hz]


def heading_at_end(model: Loops, turn_s: float, end_s: float) -> float:
    """Heading at the end for a unit of tilt east right after a turn.

    The north channel of the azimuth loop, [P2] Fig. 2, over what is left of the passes; later turns
    reflect exactly.

    Args:
        model: loops of the run.
        turn_s: update time of the turn, s.
        end_s: update time of the end, s.
    """
    changes = model.params.pace.samples / model.rate_hz
    turns = turn_times(model, end_s)
    moments = np.unique([turn_s, *changes, *turns, end_s])
    moments = moments[(moments >= turn_s) & (moments <= end_s)]
    state = np.array([0.0, 1.0, 0.0, 0.0])
    for since, until in pairwise(moments):
        if since in turns and since > turn_s:
            state = _REFLECTED * state
        piece = int(np.searchsorted(changes, since, side="right"))
        matrix = loops.azimuth_matrix(
            loops.at_pace(model.params.azimuth, model.params.pace.values[piece]),
            rate_n=model.rate_n,
            direction=-1 if round(since / model.tape_s, 9) // 1 % 2 else 1,
            **model.earth,
        )
        state = scipy.linalg.expm(matrix * (until - since)) @ state
    return float(state[2])


def transients_of(model: Loops, runs: Ensemble) -> NDArray:
    """Tilt east right after each turn, less what an exact reflection would have made of it.

    Args:
        model: loops of the runs.
        runs: their curves, with a record at every turn.

    Returns:
        (runs, turns) arcmin, from the records at and after each of `turn_times`.
    """
    turns = turn_times(model, float(runs.time_s[-1]))
    at = np.searchsorted(runs.time_s, turns * (1 - 1e-9))
    tilt = runs.columns["phi_e_arcmin"]
    return tilt[:, at + 1] + tilt[:, at]


def heading_of_kicks(model: Loops, runs: Ensemble) -> NDArray:
    """What the kicks of all turns make of the heading at the end, (runs,) arcmin."""
    end_s = float(runs.time_s[-1])
    gains = [heading_at_end(model, float(turn), end_s) for turn in turn_times(model, end_s)]
    return transients_of(model, runs) @ np.asarray(gains)


class Turned(NamedTuple):
    """A case over a stored tape, and what its turns have done.

    Attributes:
        case: the runs.
        last: (starts,) kick of the last turn, arcmin.
        heading: (starts,) what all kicks make of the heading at the end, arcmin.
    """

    case: Case
    last: NDArray
    heading: NDArray

    @property
    def rest(self) -> NDArray:
        """(starts,) heading error without what the turns do, arcmin."""
        return self.case.errors - self.heading


def turned_cases(source: Source, cases: Sequence[Case]) -> list[Turned]:
    """The cases over stored tapes, with what their turns do."""
    shown = [case for case in cases if case.turn]
    curves = source.curves([run for case in shown for run in case.runs])
    found = []
    for case in shown:
        model = loops_of(one_variant(source.study, case.variant))
        (lines,) = plots.ensembles(curves, {case.name: case.runs})
        if turn_times(model, float(lines.time_s[-1])).size:
            last = transients_of(model, lines)[:, -1]
            found.append(Turned(case, last, heading_of_kicks(model, lines)))
    return found


def gain(source: Source, case: Case) -> float:
    """Heading at the end for 1 arcmin of tilt after the last turn of a case, arcmin."""
    model = loops_of(one_variant(source.study, case.variant))
    end_s = case.tape_s * case.passes
    return abs(heading_at_end(model, float(turn_times(model, end_s)[-1]), end_s))


def table(turned: Sequence[Turned]) -> Table:
    """What the turns of each case do to the heading at the end."""
    rows = []
    for one in turned:
        numbers = (one.heading, one.case.errors, one.rest)
        cells = [f"{rms(values).value:.2f}" for values in numbers]
        rows.append([one.case.name, f"{rms(one.last).value:.3f}", *cells])
    header = ["", "kick of the last turn", "heading of all kicks, predicted", "heading error"]
    note = (
        "*Kick*: tilt after a turn that an exact reflection would not have left. *Predicted*: the"
        " kicks, from the curves, through the linear azimuth loop."
    )
    title = "What the turns do to the heading at the end (arcmin, rms)"
    return Table(title, [*header, "error less predicted"], rows, note, folded=True)


def delays(source: Source, cases: Sequence[Case], turned: Sequence[Turned]) -> Picture:
    """Heading error over the delay of the force that the reflecting turn goes by, 80 s tape."""
    reflected = [one for one in turned if one.case.turn == "reflect"]
    tape_s = min(one.case.tape_s for one in reflected)
    same = [one for one in reflected if one.case.tape_s == tape_s]
    same.sort(key=lambda one: one.case.smoothing_s)
    record = analysis.clusters_of(same[0].case.rows)
    others = [*turned_by(cases, "velocity"), partner(cases, same[0].case)]
    levels = {
        case.name: rms(case.errors).value
        for case in others
        if case is not None and case.tape_s == tape_s
    }
    figure = falling(
        "delay of the low-passed specific force (s)",
        [one.case.smoothing_s for one in same],
        {
            "heading error": [rms(one.case.errors, record) for one in same],
            "what the turns do, predicted": [rms(one.heading, record) for one in same],
        },
        levels,
        title="The reflecting turn on a moving base, from the reference",
        quantity="heading, rms (arcmin)",
    )
    caption = f"{tape_s:g} s tape, rms over the start times; dotted: without such turns."
    return Picture("delay", caption, figure, counted(source))

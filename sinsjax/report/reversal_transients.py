"""What the turns of a tape do to the heading at the end, told from the tilt at the turns.

A turn that reflects the tilt exactly lets the loops go on as if the data were new. Any other turn
leaves a tilt that should not be there: a kick. A reflecting turn kicks where the base moves, as the
specific force is then not that of the tilt alone; flipping the velocity kicks by twice the tilt.
The azimuth loop takes any tilt for the sign of a wrong heading. As its heading is linear in the
kicks, what they do can be told.
"""

from collections.abc import Iterator, Sequence
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
from sinsjax.report.base import Block, Picture, Source, Table, Text
from sinsjax.report.compass_cases import Case, partner, turned_by
from sinsjax.report.linear import Loops, loops_of, one_variant

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
    """The cases over stored tapes; none without curves, or where the study has no latitude."""
    shown = [case for case in cases if case.turn]
    curves = source.curves([run for case in shown for run in case.runs])
    if curves.num_rows == 0 or None in source.study.values("latitude_deg"):
        return []
    found = []
    for case in shown:
        model = loops_of(one_variant(source.study, case.variant))
        (lines,) = plots.ensembles(curves, {case.name: case.runs})
        if turn_times(model, float(lines.time_s[-1])).size:
            last = transients_of(model, lines)[:, -1]
            found.append(Turned(case, last, heading_of_kicks(model, lines)))
    return found


def blocks(source: Source, cases: Sequence[Case]) -> Iterator[Block]:
    """What the turns do to the heading, and what the delay of the reflecting turn decides.

    Args:
        source: with curves and a latitude in the study; without them there is nothing to tell.
        cases: of the study.
    """
    turned = turned_cases(source, cases)
    if not turned:
        return
    yield Text(_why(source, turned))
    header = [
        "",
        "kick of the last turn",
        "heading of all kicks, predicted",
        "heading error",
        "heading error minus predicted",
        "its difference from the first turn's",
    ]
    first: dict[tuple[float, int], Turned] = {}
    rows = []
    for one in turned:
        other = first.setdefault((one.case.tape_s, one.case.passes), one)
        numbers = (one.heading, one.case.errors, one.rest, one.rest - other.rest)
        cells = [f"{rms(values).value:.2f}" for values in numbers]
        rows.append([one.case.name, f"{rms(one.last).value:.3f}", *cells])
    yield Table(
        "What the turns do to the heading at the end (arcmin, rms)",
        header,
        rows,
        "*Kick*: tilt after a turn that an exact reflection would not have left. *Predicted*: the"
        " kicks, from the curves, through the linear azimuth loop. *Difference*: over one tape, the"
        " first turn is that of the first row.",
    )
    yield from _delays(cases, turned)


def _why(source: Source, turned: Sequence[Turned]) -> str:
    gains: dict[float, str] = {}
    for case in (one.case for one in turned):
        model = loops_of(one_variant(source.study, case.variant))
        end_s = case.tape_s * case.passes
        gain = abs(heading_at_end(model, float(turn_times(model, end_s)[-1]), end_s))
        gains.setdefault(case.tape_s, f"{gain:.0f} arcmin of heading ({case.tape_s:g} s tape)")
    return (
        "A turn that reflects the tilt exactly lets the loops go on as if the data were new. Any"
        " other one kicks the platform: the reflecting turn by what sway leaves in the low-passed"
        " specific force and by the delay of that force, flipped velocity by twice the tilt. The"
        " azimuth loop takes a tilt for a heading error: 1 arcmin of it at the last turn is, at"
        f" the end, {', '.join(gains.values())}. The rest, without what the kicks do, hardly"
        " depends on the turn. It is out of reach for whoever has the tape alone: the kicks are"
        " told by the reference, which has seen more."
    )


def _delays(cases: Sequence[Case], turned: Sequence[Turned]) -> Iterator[Block]:
    """Heading over the delay of the reflecting turn, where several were tried over one tape."""
    reflected = [one for one in turned if one.case.turn == "reflect"]
    for data in dict.fromkeys((one.case.tape_s, one.case.passes) for one in reflected):
        same = [one for one in reflected if (one.case.tape_s, one.case.passes) == data]
        same.sort(key=lambda one: one.case.smoothing_s)
        record = analysis.clusters_of(same[0].case.rows)
        if len({one.case.smoothing_s for one in same}) < 2:
            continue
        others = [*turned_by(cases, "velocity"), partner(cases, same[0].case)]
        levels = {
            case.name: rms(case.errors).value
            for case in others
            if case is not None and case.tape_s == data[0]
        }
        yield Picture(
            "delay",
            f"Heading error over the delay of the specific force that the platform is reflected"
            f" by, {data[0]:g} s tape, rms over the start times; dotted: without such turns."
            f" {analysis.NO_INTERVAL}",
            falling(
                "delay of the low-passed specific force (s)",
                [one.case.smoothing_s for one in same],
                {
                    "heading error": [rms(one.case.errors, record) for one in same],
                    "what the turns do, predicted": [rms(one.heading, record) for one in same],
                },
                levels,
                title="The reflecting turn on a base that moves",
                quantity="heading, rms (arcmin)",
            ),
        )
        return

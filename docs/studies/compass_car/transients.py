"""What the turns of a stored record do to the heading at the end, told from the tilt at the turns.

A turn that reflects the tilt exactly lets the loops go on as if the data were new. Any other turn
leaves a tilt that should not be there: a kick. A reflecting turn kicks where the base moves, as the
specific force is then not that of the tilt alone; flipping the velocity kicks by twice the tilt.
The azimuth loop takes any tilt for a heading error, and its heading is linear in the kicks.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from sinsjax import plots
from sinsjax.alignment.compass import design as loops
from sinsjax.plots import Ensemble
from sinsjax.report.base import Source
from sinsjax.study.load import one_variant

from ..loops.linear import Loops, loops_of
from .cases import Case

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


def without_kicks(source: Source, cases: Sequence[Case]) -> dict[str, NDArray]:
    """(starts,) heading error without what the turns do, arcmin, by case over a stored record."""
    rest = {}
    for case in cases:
        if case.turn:
            runs = (case.variant + source.study.n_variants * np.arange(source.draws)).tolist()
            (lines,) = plots.ensembles(source.curves(runs), {case.name: runs})
            model = loops_of(one_variant(source.study, case.variant))
            rest[case.name] = case.errors - heading_of_kicks(model, lines)
    return rest


def gain(source: Source, case: Case) -> float:
    """Heading at the end for 1 arcmin of tilt after the last turn of a case, arcmin."""
    model = loops_of(one_variant(source.study, case.variant))
    end_s = case.data_s * case.passes
    return abs(heading_at_end(model, float(turn_times(model, end_s)[-1]), end_s))

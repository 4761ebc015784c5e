"""What errors of tilt made at the turns of a tape do to the heading at the end.

The reflecting turn takes the tilt from the specific force. Where the base moves, the force is not
that of the tilt alone, and the platform is turned by a wrong angle: a kick. The azimuth loop takes
any tilt for the sign of a wrong heading. As its heading is linear in the kicks, what they do can be
told from the tilt at the turns.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from sinsjax import loops, plots
from sinsjax.plots import Ensemble
from sinsjax.plots.starts import falling
from sinsjax.report.base import Block, Picture, Source, Table, Text
from sinsjax.report.compass_cases import Case, partner, rms, turned_by
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


def kicks(model: Loops, runs: Ensemble) -> NDArray:
    """Tilt east right after each turn, less what an exact reflection would have made of it.

    Args:
        model: loops of the runs, whose turn is a reflection.
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
    return kicks(model, runs) @ np.asarray(gains)


class Smoothed(NamedTuple):
    """Cases over one tape that differ in the smoothing of the reflecting turn alone.

    Attributes:
        cases: by their smoothing.
        calm: the same tape and passes with the velocity flipped, which kicks no tilt.
    """

    cases: list[Case]
    calm: Case


def smoothed(cases: Sequence[Case]) -> Smoothed | None:
    """The cases that show what the smoothing does; None without two of them and a calm one."""
    for calm in turned_by(cases, "velocity"):
        data = (calm.tape_s, calm.passes)
        same = [c for c in turned_by(cases, "reflect") if (c.tape_s, c.passes) == data]
        if len({case.smoothing_s for case in same}) > 1:
            return Smoothed(sorted(same, key=lambda case: case.smoothing_s), calm)
    return None


def blocks(source: Source, cases: Sequence[Case]) -> Iterator[Block]:
    """The heading that reflecting turns add, as found and as predicted from the tilt at the turns.

    Args:
        source: with curves and a latitude in the study; without them there is nothing to tell.
        cases: of the study.
    """
    shown = smoothed(cases)
    if shown is None or None in source.study.values("latitude_deg"):
        return
    curves = source.curves([run for case in shown.cases for run in case.runs])
    if curves.num_rows == 0:
        return
    found, predicted, rows = [], [], []
    for case in shown.cases:
        model = loops_of(one_variant(source.study, case.variant))
        (lines,) = plots.ensembles(curves, {case.name: case.runs})
        made, apart = heading_of_kicks(model, lines), case.errors - shown.calm.errors
        found.append(rms(apart))
        predicted.append(rms(made))
        rows.append(
            [
                f"{case.smoothing_s:g}",
                f"{rms(kicks(model, lines)[:, -1]).value:.3f}",
                f"{predicted[-1].value:.1f}",
                f"{found[-1].value:.1f}",
                f"{rms(apart - made).value:.1f}",
                f"{rms(case.errors).value:.1f}",
            ]
        )
    yield Text(_why(source, cases, shown))
    header = [
        "smoothing (s)",
        "tilt kick of the last turn",
        "heading of all kicks, predicted",
        "found",
        "found minus predicted",
        "whole heading error",
    ]
    yield Table(
        f"{shown.calm.tape_s:g} s tape: what the reflecting turns do to the heading (arcmin, rms)",
        header,
        rows,
        f"*Predicted*: the tilt at the turns, from the curves, through the linear azimuth loop."
        f" *Found*: the heading at the end minus that of '{shown.calm.name}', start time by start"
        " time.",
    )
    kalman = partner(cases, shown.calm)
    levels = {shown.calm.name: rms(shown.calm.errors).value}
    levels |= {kalman.name: rms(kalman.errors).value} if kalman else {}
    yield Picture(
        "smoothing",
        f"Heading that the reflecting turns add, {shown.calm.tape_s:g} s tape, with bootstrap"
        " intervals; dotted: whole heading errors without such turns.",
        falling(
            "smoothing of the specific force (s)",
            [case.smoothing_s for case in shown.cases],
            {"found": found, "predicted from the tilt at the turns": predicted},
            levels,
            title="What the reflecting turn costs on a base that moves",
            quantity="heading, rms (arcmin)",
        ),
    )


def _why(source: Source, cases: Sequence[Case], shown: Smoothed) -> str:
    least, most = shown.cases[0], shown.cases[-1]
    return (
        "The reflecting turn takes the tilt from the smoothed specific force. Sway has no mean, but"
        " over a time T its specific force averages only to (change of velocity)/T, so that the"
        " platform is turned by an angle that is wrong in proportion to 1/T. The azimuth loop takes"
        " such a tilt for a heading error: 1 arcmin of it at the last turn is, at the end,"
        f" {_gains(source, cases)}. With {least.smoothing_s:g} s of smoothing the heading is off by"
        f" {rms(least.errors).value:.0f} arcmin rms, with {most.smoothing_s:g} s by"
        f" {rms(most.errors).value:.1f}; where the velocity is flipped and nothing is taken from"
        f" the specific force, by {rms(shown.calm.errors).value:.1f}. {_cycle(source, shown.calm)}"
    )


def _cycle(source: Source, calm: Case) -> str:
    """Why flipping the velocity converges, or does not."""
    model = loops_of(one_variant(source.study, calm.variant))
    sigma = model.sigma * float(np.max(model.params.pace.values))
    radius = loops.cycle_radius(sigma, calm.tape_s, loops.turn_matrix(-1, 1, 1))
    return (
        "That turn flips no tilt and brings heading back only where sigma times the tape is large:"
        f" here it begins with {sigma * calm.tape_s:.2g}, of which a cycle of two passes leaves"
        f" {100 * float(radius):.1g} %."
    )


def _gains(source: Source, cases: Sequence[Case]) -> str:
    """Heading at the end for 1 arcmin of tilt at the last turn, for each length of tape."""
    told: dict[float, str] = {}
    for case in turned_by(cases, "reflect"):
        model = loops_of(one_variant(source.study, case.variant))
        end_s = case.tape_s * case.passes
        gain = heading_at_end(model, float(turn_times(model, end_s)[-1]), end_s)
        told.setdefault(case.tape_s, f"{abs(gain):.0f} arcmin of heading ({case.tape_s:g} s tape)")
    return ", ".join(told.values())

"""The map over turn, sigma and length of the tape: errors, bound and prediction."""

from collections.abc import Sequence
from operator import attrgetter
from typing import Any

import numpy as np

from sinsjax import plots
from sinsjax.analysis import format_estimate
from sinsjax.plots import Contours, Scale, Shown
from sinsjax.report.base import Picture, Source, Table, value_text
from sinsjax.report.folder import Page
from sinsjax.report.output import counted

from ..loops.runs import bound_arcmin
from .points import SIGMA, TAPE, TURNS, Point, agrees, best_of, converges_from, points_of, radius_of

_LEVELS = (0.5, 1.0)  # of the spectral radius
_PAPER = (0.01, 80.0)  # sigma of the azimuth loop, 1/s, and length of the tape, s
_FINE = 32  # places along a side of a panel that contours are drawn through


def mapped(source: Source) -> Page:
    """What turn, sigma and length of the tape decide."""
    points = points_of(source)
    by_turn = {turn: [p for p in points if p.turn == turn] for turn in TURNS}
    band = max(source.study.study.settle_bands_arcmin)
    tapes = sorted(source.study.axes[TAPE])
    bounds = bound_arcmin(source.study, tapes)
    best = {turn: [best_of(here, tape) for tape in tapes] for turn, here in by_turn.items()}
    ratios = [p.rms.value / b for p, b in zip(best["reflect"], bounds, strict=True)]
    least = {turn: _least(here, tapes, band) for turn, here in by_turn.items()}
    whole, radius = (
        sum(agrees(p, band, of(p)) for p in points)
        for of in map(attrgetter, ("linear", "by_radius"))
    )
    apart = float(np.median([abs(p.left - p.linear) for p in points]))
    radii = {turn: float(radius_of(source.study, turn, *_PAPER)) for turn in TURNS}
    values: dict[str, Any] = {
        "map": {
            "points": str(len(points)),
            "draws": str(source.study.n_draws),
            "tapes": f"{tapes[0]:g} to {tapes[-1]:g} s",
            "paper": f"{radii['velocity']:.3f}",
            "reflect": f"{radii['reflect']:.2f}",
            "band": f"{band:g} arcmin",
            "from_reflect": f"{least['reflect'][0]:.1f} to {least['reflect'][1]:.1f}",
            "from_paper": f"{least['velocity'][0]:.1f} to {least['velocity'][1]:.1f}",
            "closest": f"{min(ratios):.1f}",
            "furthest": f"{max(ratios):.1f}",
            "agree": str(whole),
            "by_radius": str(radius),
            "apart": f"{apart:.2f} arcmin",
        }
    }
    claims = {
        "with the paper's sigma only the reflecting turn converges": (
            radii["reflect"] < 0.5
            and all(radii[turn] > 0.95 for turn in TURNS if turn != "reflect")
        ),
        "reflecting converges from a smaller sigma": least["reflect"][0] < least["velocity"][0] / 2,
        "the best gains come within twice the bound": max(ratios) < 2,
        "the linear loops are right nearly everywhere": whole > 0.97 * len(points) > radius,
    }
    fine = np.geomspace(tapes[0], tapes[-1], 50)
    by_tape = plots.by_record_length(
        tapes,
        {TURNS[turn]: [p.rms for p in here] for turn, here in best.items()},
        (fine, bound_arcmin(source.study, fine)),
        title="What a tape can give: least heading error, from the limit",
        quantity="rms heading error (arcmin)",
    )
    caption = "The best sigma and schedule of each turn, with 95 % intervals over the draws."
    return Page(
        values,
        {"best": _best_table(by_turn, tapes, dict(zip(tapes, bounds, strict=True)))},
        {
            "errors": _error_maps(source, points),
            "by_tape": Picture("by_tape", caption, by_tape, counted(source)),
            "prediction": _prediction(source, by_turn, band),
        },
        claims,
    )


def _least(points: Sequence[Point], tapes: Sequence[float], band: float) -> tuple[float, float]:
    """The least and the most of the smallest sigma T that converges, over the tapes."""
    found = [converges_from(points, tape, band, attrgetter("left")) for tape in tapes]
    known = [one for one in found if one is not None]
    return (min(known), max(known)) if known else (np.nan, np.nan)


def _error_maps(source: Source, points: Sequence[Point]) -> Picture:
    """Constant sigma: how far from its limit the heading ends, by turn."""
    rows, columns = (source.study.axes[key] for key in (SIGMA, TAPE))
    values = {(p.turn, p.sigma, p.tape_s): p.rms.value for p in points if p.constant}
    panels = [
        (words, np.array([[values[turn, row, column] for column in columns] for row in rows]))
        for turn, words in TURNS.items()
    ]
    sigma, tape_s = np.meshgrid(
        *(plots.spread(axis, _FINE) for axis in (rows, columns)), indexing="ij"
    )
    radii = [radius_of(source.study, turn, sigma, tape_s) for turn in TURNS]
    low = float(bound_arcmin(source.study, max(columns)))
    high = float(np.median([abs(p.start) for p in points]))
    figure = plots.heat_maps(
        panels,
        "How far from its limit does the heading end? By turn, sigma and tape",
        Shown("rms heading error (arcmin)", low, high, reverse=True, log=True, numbers=False),
        contours=Contours("share that a cycle leaves (linear loops)", _LEVELS, radii),
        rows=Scale(SIGMA, rows),
        columns=Scale(TAPE, columns),
        across=2,
    )
    caption = (
        f"Rms over {source.study.n_draws} draws, constant sigma; light is good, the darkest is the"
        " initial error and more. Left of the line of 1 a tape cannot"
        " converge. *Too*: the azimuth rate, besides the velocity."
    )
    return Picture("heading_error", caption, figure, counted(source))


def _prediction(source: Source, by_turn: dict[str, list[Point]], band: float) -> Picture:
    figure = plots.prediction(
        {
            TURNS[turn]: tuple(np.array([[p.linear, p.left] for p in points]).T)
            for turn, points in by_turn.items()
        },
        "What is left of the heading error, from its limit",
        quantity="mean heading error (arcmin)",
        band=band,
    )
    caption = f"A dot a point, mean over the draws, against the linear loops; dotted: {band:g}'."
    return Picture("prediction", caption, figure, counted(source))


def _best_table(
    by_turn: dict[str, list[Point]], tapes: Sequence[float], bounds: dict[float, float]
) -> Table:
    rows = []
    for turn, points in by_turn.items():
        for tape in tapes:
            best = best_of(points, tape)
            rows.append(
                [
                    TURNS[turn],
                    value_text(tape),
                    value_text(best.sigma),
                    best.schedule,
                    format_estimate(best.rms, digits=2),
                    f"{bounds[tape]:.2f}",
                    f"{best.rms.value / bounds[tape]:.2f}",
                ]
            )
    header = ["turn", "tape (s)", "best sigma (1/s)", "schedule", "rms error (arcmin)"]
    note = (
        "Number [95 % interval]. Bound: 1 sigma of the heading that white sensor noise leaves to"
        " any unbiased estimator. The best is taken on the draws that it is scored on, which"
        " flatters it."
    )
    header += ["bound (arcmin)", "ratio"]
    return Table("The least heading error by turn and tape", header, rows, note, folded=True)

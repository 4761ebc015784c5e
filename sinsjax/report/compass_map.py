"""The map that paper 2 leaves open: turn rule by sigma by length of the tape by gain schedule."""

from collections.abc import Callable, Iterator, Sequence
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis, plots
from sinsjax.alignment.compass import design as loops
from sinsjax.alignment.compass.parameters import REVERSALS
from sinsjax.analysis import format_estimate
from sinsjax.plots import Contours, Scale, Shown
from sinsjax.report import base
from sinsjax.report.base import (
    Picture,
    Report,
    Section,
    Source,
    Table,
    Text,
    only,
    percent,
    value_text,
)
from sinsjax.report.compass_runs import bound_arcmin
from sinsjax.report.map_points import (
    RULES,
    SIGMA,
    TAPE,
    TURN,
    Point,
    agrees,
    best_of,
    converges_from,
    points_of,
    radius_of,
)

_LEVELS = (0.1, 0.5, 0.9, 1.0)  # of the spectral radius
_PAPER = (0.01, 80.0)  # sigma of the azimuth loop, 1/s, and length of the tape, s
_FINE = 32  # places along a side of a panel that contours are drawn through


def report(source: Source) -> Report:
    """Heading error and settling time over sigma and tape, bound and prediction beside them."""
    points = points_of(source)
    by_turn = {turn: [p for p in points if p.turn == turn] for turn in _turns(source)}
    band = max(source.study.study.settle_bands_arcmin)
    return Report(
        [
            _scope(source),
            _at_the_papers(source),
            _thresholds(by_turn, band),
            _against_bound(source, by_turn),
            _agreement(by_turn, band),
        ],
        [
            Section("Heading error by turn, sigma and tape", list(_error_maps(source, points))),
            Section("Time to settle", [_settling_maps(source, points, band)]),
            Section("What a tape can give", list(_best(source, by_turn, band))),
            Section("What linear loops predict", list(_predictions(source, by_turn, band))),
        ],
    )


def _turns(source: Source) -> Sequence[str]:
    return source.study.axes[TURN]


def _tapes(source: Source) -> list[float]:
    return sorted(source.study.axes[TAPE])


def _scope(source: Source) -> str:
    study = source.study
    return (
        f"{study.n_variants} points of turn rule, sigma, length of the tape and gain schedule,"
        f" {study.n_draws} noise draws each, {study.run_s:g} s of updates. Errors are from the"
        " floor of phi_u for constant biases."
    )


def _at_the_papers(source: Source) -> str:
    """What a cycle leaves with the numbers of [P2], by turn."""
    parts = []
    for turn in _turns(source):
        text = f"{turn} {float(radius_of(source.study, turn, *_PAPER)):.3f}"
        velocity, _, rate, reflection = REVERSALS[turn]
        if reflection:
            exact = loops.turn_matrix(velocity, 1 - 2 * reflection, rate)
            damping = only(source.study, "azimuth_damping")
            text += f" ({float(loops.cycle_radius(*_PAPER, exact, damping=damping)):.3f} without"
            text += " the lag of the specific force that it goes by)"
        parts.append(text)
    sigma, tape_s = _PAPER
    return (
        f"With [P2]'s sigma of {sigma:g} 1/s and {tape_s:g} s of data a forward and a reversed pass"
        f" leave of the heading error, in the long run, the share {'; '.join(parts)}."
    )


def _thresholds(by_turn: dict[str, list[Point]], band: float) -> str:
    parts = []
    for turn, points in by_turn.items():
        tapes = sorted({p.tape_s for p in points})
        found = {tape: converges_from(points, tape, band, attrgetter("left")) for tape in tapes}
        values = [value for value in found.values() if value is not None]
        never = [value_text(tape) for tape, value in found.items() if value is None]
        text = f"{turn} from {min(values):.2g} to {max(values):.2g}" if values else f"{turn} never"
        parts.append(text + (f" (not at {', '.join(never)} s)" if never and values else ""))
    return (
        f"The smallest sigma T from which on the mean error ends within {band:g} arcmin, with a"
        f" constant sigma, by tape: {'; '.join(parts)}."
    )


def _against_bound(source: Source, by_turn: dict[str, list[Point]]) -> str:
    tapes = _tapes(source)
    bounds = bound_arcmin(source.study, tapes)
    parts = []
    for turn, points in by_turn.items():
        ratios = [
            best_of(points, tape).rms.value / bound
            for tape, bound in zip(tapes, bounds, strict=True)
        ]
        listed = ", ".join(f"{ratio:.2g}" for ratio in ratios)
        parts.append(f"{turn} {listed}")
    return (
        "The least rms error over sigma and schedule, in units of the information bound, at"
        f" {', '.join(value_text(tape) for tape in tapes)} s: {'; '.join(parts)}."
    )


def _agreement(by_turn: dict[str, list[Point]], band: float) -> str:
    points = [p for here in by_turn.values() for p in here]
    whole, radius = (
        sum(agrees(p, band, of(p)) for p in points)
        for of in map(attrgetter, ("linear", "by_radius"))
    )
    apart = np.array([p.left - p.linear for p in points])
    return (
        f"Whether the mean error ends within {band:g} arcmin: the linear loops, gone through pass"
        f" by pass, are right at {whole} of {len(points)} points (median difference"
        f" {np.median(np.abs(apart)):.2f} arcmin); the spectral radius to the power of the cycles"
        f" at {radius}."
    )


def _panels(
    source: Source, points: Sequence[Point], of: Callable[[Point], float]
) -> list[tuple[str, NDArray]]:
    """A value of every point, in panels by schedule and turn."""
    rows, columns = (source.study.axes[key] for key in (SIGMA, TAPE))
    values = {(p.schedule, p.turn, p.sigma, p.tape_s): of(p) for p in points}
    return [
        (
            f"{turn}: {schedule}",
            np.array([[values[schedule, turn, row, column] for column in columns] for row in rows]),
        )
        for schedule in dict.fromkeys(p.schedule for p in points)
        for turn in _turns(source)
    ]


def _scales(source: Source) -> dict[str, Any]:
    rows, columns = (Scale(key, source.study.axes[key]) for key in (SIGMA, TAPE))
    return {"rows": rows, "columns": columns}


def _contours(source: Source, points: Sequence[Point]) -> Contours:
    axes = source.study.axes
    sigma, tape_s = np.meshgrid(
        *(plots.spread(axes[key], _FINE) for key in (SIGMA, TAPE)), indexing="ij"
    )
    factors = {p.schedule: p.last_factor for p in points}
    turned = {
        (turn, factor): radius_of(source.study, turn, sigma * factor, tape_s)
        for turn in _turns(source)
        for factor in set(factors.values())
    }
    values = [turned[turn, factor] for factor in factors.values() for turn in _turns(source)]
    return Contours("spectral radius of a cycle, linear loops", _LEVELS, values)


def _error_maps(source: Source, points: Sequence[Point]) -> Iterator[Picture | Text]:
    rules = "; ".join(f"*{turn}*: {RULES[turn]}" for turn in _turns(source))
    yield Text(f"What is done at a turn: {rules}.")
    panels = _panels(source, points, lambda p: p.rms.value)
    low = float(bound_arcmin(source.study, max(source.study.axes[TAPE])))
    high = float(np.median([abs(p.start) for p in points]))
    yield Picture(
        "heading_error",
        f"Rms heading error from the floor at the end, {source.study.n_draws} draws; the darkest"
        " colour is the initial error and more. Lines: predicted spectral radius of one forward"
        " and one reversed pass with the last sigma of the schedule; from cycle to cycle that share"
        " of the error is left, and above 1 it grows.",
        plots.heat_maps(
            panels,
            "How far from its floor does the heading end?",
            Shown("rms heading error (arcmin)", low, high, reverse=True, log=True),
            contours=_contours(source, points),
            **_scales(source),
        ),
    )


def _settling_maps(source: Source, points: Sequence[Point], band: float) -> Picture:
    def median(point: Point) -> float:
        return float(np.quantile(point.settle_s, 0.5, method="inverted_cdf"))

    return Picture(
        "settling_time",
        f"Median update time until the heading has settled to {band:g} arcmin; hatched where at"
        f" least half of the draws never do. {base.yardstick(source.study)}",
        plots.heat_maps(
            _panels(source, points, median),
            f"How long until the heading stays within {band:g} arcmin?",
            Shown("median settling time (s)", 0.0, source.study.run_s, reverse=True),
            contours=_contours(source, points),
            **_scales(source),
        ),
    )


def _best(
    source: Source, by_turn: dict[str, list[Point]], band: float
) -> Iterator[Picture | Table]:
    tapes = _tapes(source)
    fine = np.geomspace(tapes[0], tapes[-1], 50)
    lines = {
        turn: [best_of(points, tape).rms for tape in tapes] for turn, points in by_turn.items()
    }
    yield Picture(
        "by_tape",
        "Rms heading error at the best sigma and schedule of each turn rule, with 95 % intervals.",
        plots.by_tape(
            tapes,
            lines,
            (fine, bound_arcmin(source.study, fine)),
            title="What a tape can give, and what is made of it",
            quantity="rms heading error (arcmin)",
        ),
    )
    bounds = dict(zip(tapes, bound_arcmin(source.study, tapes), strict=True))
    rows = [
        _best_row(points, tape, bounds[tape], band) for points in by_turn.values() for tape in tapes
    ]
    header = [
        "turn",
        "tape (s)",
        "best sigma (1/s)",
        "schedule",
        "rms error (arcmin)",
        "bound (arcmin)",
        "ratio",
        f"settled to {band:g}' (%)",
        "median (s)",
        "converges from sigma T",
        "predicted",
    ]
    yield Table(
        "The least heading error by turn and tape",
        header,
        rows,
        "Number [95 % interval]. Bound: 1 sigma of the heading that white sensor noise leaves to"
        " any unbiased estimator on that tape. The best of all sigmas and schedules is taken on the"
        " same draws that it is scored on, which flatters it: below the bound is chance, or a loop"
        " too slow to take the noise in that crosses its floor at the end. *Converges from*: with a"
        " constant"
        f" sigma, the smallest sigma T from which on the mean error ends within {band:g} arcmin,"
        " simulated and by the linear loops; -: not at the largest sigma either.",
    )


def _best_row(points: Sequence[Point], tape_s: float, bound: float, band: float) -> list[str]:
    best = best_of(points, tape_s)
    settled = int(np.isfinite(best.settle_s).sum())
    thresholds = (
        converges_from(points, tape_s, band, of) for of in map(attrgetter, ("left", "linear"))
    )
    return [
        best.turn,
        value_text(tape_s),
        value_text(best.sigma),
        best.schedule,
        format_estimate(best.rms, digits=2),
        f"{bound:.2f}",
        f"{best.rms.value / bound:.2f}",
        percent(analysis.proportion(settled, best.settle_s.size)),
        format_estimate(analysis.quantile(best.settle_s), digits=0),
        *("-" if value is None else f"{value:.2g}" for value in thresholds),
    ]


def _predictions(
    source: Source, by_turn: dict[str, list[Point]], band: float
) -> Iterator[Picture | Table | Text]:
    yield Text(
        "The linear loops are the north channel without noise, gone through pass by pass:"
        " levelling, azimuth with the gains of each piece, and the turn as it is made, by a"
        " specific force that lags behind the tilt. What they leave of the initial error at the end"
        " stands against the mean over the draws."
    )
    yield Picture(
        "prediction",
        "Heading from its floor at the end, mean over the draws, against the linear loops; a dot a"
        f" point, dotted: {band:g} arcmin.",
        plots.prediction(
            {
                turn: tuple(np.array([[p.linear, p.left] for p in points]).T)
                for turn, points in by_turn.items()
            },
            "What is left of the heading error",
            quantity="mean heading error (arcmin)",
            band=band,
        ),
    )
    tapes = _tapes(source)
    fewest, most = (source.study.run_s / (2 * tape) for tape in (tapes[-1], tapes[0]))
    header = [
        "turn",
        "points",
        "spectral radius below 1",
        f"simulated within {band:g}'",
        "linear loops agree",
        "radius and cycles agree",
        "median |difference| (arcmin)",
        "90 %",
        "largest",
    ]
    rows, worst = [], set()
    for turn, points in by_turn.items():
        apart = np.abs([p.left - p.linear for p in points])
        worst.add(points[int(np.argmax(apart))].tape_s)
        counts = (
            len(points),
            sum(p.radius < 1 for p in points),
            sum(abs(p.left) <= band for p in points),
            sum(agrees(p, band, p.linear) for p in points),
            sum(agrees(p, band, p.by_radius) for p in points),
        )
        sizes = (f"{np.quantile(apart, q):.2f}" for q in (0.5, 0.9, 1.0))
        rows.append([turn, *map(str, counts), *sizes])
    yield Table(
        "Prediction and simulation over the points of each turn",
        header,
        rows,
        f"*Agree*: both or neither say that the mean error ends within {band:g} arcmin. The"
        " spectral radius tells the rate in the long run only, and a run has but"
        f" {fewest:.2g} to {most:.2g} cycles. The largest difference of each turn is at"
        f" {', '.join(map(value_text, sorted(worst)))} s of tape, on which headings go degrees off"
        " and loops are linear no more.",
    )

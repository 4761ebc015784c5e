"""The points of a sweep over turn, sigma and tape: what came out, and what was predicted."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.alignment.compass.design import Number
from sinsjax.alignment.compass.parameters import REVERSALS
from sinsjax.analysis import Estimate, rms
from sinsjax.report.base import Source, name_of, only, shown_keys
from sinsjax.study.study import Study
from sinsjax.study.times import spans_s
from sinsjax.units import ARCMIN, DEG

from ..loops.linear import Loops, all_loops, cycle_radius, heading_of, start_of
from ..loops.runs import heading_errors

TURN, TAPE, SIGMA = "turn", "tape_s", "azimuth_sigma_per_s"
"""The keys that the map is drawn over; all others make a schedule."""

TURNS = {
    "velocity": "paper's turn",
    "velocity_and_rate": "rate flipped too",
    "velocity_drop_rate": "rate dropped too",
    "reflect": "tilt reflected",
}
"""What is done at a turn besides changing the sign of the velocity, by its rule."""


class Point(NamedTuple):
    """One variant: its settings, its runs, and what the linear loops predict for them.

    Attributes:
        schedule: what is swept besides turn, tape and sigma, in words.
        constant: whether its sigma does not change.
        turn: rule at a turn of the tape.
        tape_s: length of the tape, s.
        sigma: of the azimuth loop at factor 1, 1/s.
        last_factor: on sigma, of the last piece of the schedule.
        start: initial heading from its floor, arcmin.
        errors: (draws,) heading from its floor at the end, arcmin; NaN if unknown.
        settle_s: (draws,) settling time to the widest band, s; infinite if never.
        linear: the heading from its floor at the end by the linear loops, arcmin.
        by_radius: what is left of the initial error at the rate of the spectral radius, arcmin.
        radius: spectral radius of a cycle of two passes with the last sigma.
    """

    schedule: str
    constant: bool
    turn: str
    tape_s: float
    sigma: float
    last_factor: float
    start: float
    errors: NDArray
    settle_s: NDArray
    linear: float
    by_radius: float
    radius: float

    @property
    def left(self) -> float:
        """What is left of the initial heading error: the mean over the draws, arcmin."""
        return float(self.errors.mean())

    @property
    def rms(self) -> Estimate:
        """Root mean square error over the draws, arcmin; infinite if one is unknown."""
        if np.isfinite(self.errors).all():
            return rms(self.errors)
        return analysis.UNKNOWN._replace(value=np.inf, n=self.errors.size)


def points_of(source: Source) -> list[Point]:
    """The points in the order of the variants."""
    study = source.study
    shape = (source.draws, study.n_variants)
    band = max(study.study.settle_bands_arcmin)
    errors = heading_errors(source.summary).reshape(shape)
    settle = analysis.numbers(source.summary, f"settle_{band:g}_s").reshape(shape)
    settings = {key: study.values(key) for key in (TURN, TAPE, SIGMA, "sigma_factors")}
    others = [key for key in shown_keys(study) if key not in (TURN, TAPE, SIGMA)]
    swept = study.variant_values()
    models, start = all_loops(study), start_of(study)
    ends = spans_s(study)[:, 0]
    radii, left = _radii(study, models, ends)
    return [
        Point(
            schedule=name_of({key: swept[key][i] for key in others}) if others else "constant",
            constant=len(set(settings["sigma_factors"][i])) == 1,
            turn=settings[TURN][i],
            tape_s=settings[TAPE][i],
            sigma=settings[SIGMA][i],
            last_factor=settings["sigma_factors"][i][-1],
            start=float(start[1]) * DEG / ARCMIN,
            errors=errors[:, i],
            settle_s=np.nan_to_num(settle[:, i], nan=np.inf),
            linear=-float(heading_of(model, start, ends[i : i + 1])[0]) * DEG / ARCMIN,
            by_radius=abs(float(start[1])) * DEG / ARCMIN * float(left[i]),
            radius=float(radii[i]),
        )
        for i, model in enumerate(models)
    ]


def _radii(study: Study, models: Sequence[Loops], ends: NDArray) -> tuple[NDArray, NDArray]:
    """Spectral radius of each variant's last piece, and the product over all its passes.

    Args:
        study: of the variants.
        models: their loops.
        ends: (variants,) ends of their runs, s.
    """
    turns = np.asarray(study.values(TURN))
    damping = np.asarray(study.values("azimuth_damping"))
    params = [model.params for model in models]
    sigma = np.array([p.pace.values for p in params]) * np.array([[m.sigma] for m in models])
    begins = np.array([[p.azimuth_from, *p.pace.samples] for p in params]) / models[0].rate_hz
    end = ends[:, None]
    edges = np.clip(np.hstack([begins, end]), begins[:, :1], end)  # pieces not reached: empty
    tape = np.array([[model.tape_s] for model in models])
    smoothing = np.array([[model.smoothing_s] for model in models])
    radii = np.empty_like(sigma)
    for turn in dict.fromkeys(turns):
        here = turns == turn
        radii[here] = cycle_radius(
            sigma[here],
            tape[here],
            REVERSALS[turn],
            damping=damping[here, None],
            smoothing_s=smoothing[here],
        )
    cycles = np.diff(edges) / (2 * tape)
    last = cycles.shape[1] - 1 - np.argmax(cycles[:, ::-1] > 0, axis=1)
    return radii[np.arange(len(models)), last], np.prod(radii**cycles, axis=1)


def radius_of(study: Study, turn: str, sigma: Number, tape_s: Number) -> NDArray:
    """Spectral radius of a cycle of two passes with a study's turn, see `linear.cycle_radius`."""
    return cycle_radius(
        sigma,
        tape_s,
        REVERSALS[turn],
        damping=only(study, "azimuth_damping"),
        smoothing_s=only(study, "turn_smoothing_s"),
    )


def converges_from(
    points: Sequence[Point], tape_s: float, band: float, of: Callable[[Point], float]
) -> float | None:
    """Smallest sigma T that leaves at most a band, as do all larger ones; None if none does.

    Args:
        points: of one turn; those with a constant sigma count.
        tape_s: length of the tape, s.
        band: arcmin.
        of: what is left at a point, arcmin.
    """
    found = None
    here = [p for p in points if p.tape_s == tape_s and p.constant]
    for point in sorted(here, key=lambda p: -p.sigma):
        if not abs(of(point)) <= band:
            break
        found = point.sigma * tape_s
    return found


def best_of(points: Sequence[Point], tape_s: float) -> Point:
    """The point of a tape with the least rms error."""
    return min((p for p in points if p.tape_s == tape_s), key=lambda p: p.rms.value)


def agrees(point: Point, band: float, predicted: float) -> bool:
    """Whether prediction and simulation say the same of the mean error's ending within a band."""
    return (abs(point.left) <= band) == (abs(predicted) <= band)

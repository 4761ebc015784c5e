"""The map over turn, sigma and length of the stored record: errors, bound and prediction."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis, plots
from sinsjax.alignment.compass.design import Number
from sinsjax.alignment.compass.parameters import REVERSALS
from sinsjax.plots import Contours, Scale, Shown
from sinsjax.report.base import Picture, Source, only
from sinsjax.report.folder import Page
from sinsjax.report.grids import Grid
from sinsjax.report.output import counted
from sinsjax.study.study import Study
from sinsjax.study.times import spans_s
from sinsjax.units import ARCMIN, DEG

from ..loops.linear import all_loops, cycle_radius, heading_of, start_of
from ..loops.runs import bound_arcmin, heading_errors

SIGMA, LENGTH = "azimuth_sigma_per_s", "tape_s"
TURNS = {
    "velocity": "paper's turn",
    "velocity_and_rate": "rate flipped too",
    "velocity_drop_rate": "rate dropped too",
    "reflect": "tilt reflected",
}
"""What is done at a turn besides changing the sign of the velocity, by its rule."""

_LEVELS = (0.5, 1.0)  # of the spectral radius
_PAPER = (0.01, 80.0)  # sigma of the azimuth loop, 1/s, and length of the record, s
_FINE = 32  # places along a side of a panel that contours are drawn through


def layout(source: Source) -> Grid:
    """Every run by schedule, turn, length of the record, sigma and draw."""
    study, columns = source.study, ("phi_u_arcmin", "floor_arcmin")
    schedules = study.values("sigma_factors")
    sides = {"turn": study.values("turn"), "length": study.values(LENGTH)}
    return Grid.of(source, columns, schedule=schedules, **sides, sigma=study.values(SIGMA))


def mapped(source: Source) -> Page:
    """What turn, sigma and length of the record decide."""
    study, grid = source.study, layout(source)
    errors = grid.columns["phi_u_arcmin"] - grid.columns["floor_arcmin"]
    band, lengths = max(study.study.settle_bands_arcmin), np.array(grid.axes["length"])
    least = least_errors(errors, grid.axes["turn"])
    ratios = [one.value for one in least["reflect"]] / bound_arcmin(study, lengths)
    from_sigma = converges_from(np.abs(errors[0].mean(axis=-1)) <= band, grid.axes["sigma"])
    needed = dict(zip(grid.axes["turn"], from_sigma * lengths, strict=True))
    left, predicted = (
        heading_errors(source.summary).reshape(grid.draws, -1).mean(axis=0),
        predict(study),
    )
    agree = int(((np.abs(left) <= band) == (np.abs(predicted) <= band)).sum())
    radii = {turn: float(radius_of(study, turn, *_PAPER)) for turn in TURNS}
    values = {
        "map": {
            "points": str(study.n_variants),
            "draws": str(study.n_draws),
            "paper": f"{radii['velocity']:.3f}",
            "reflect": f"{radii['reflect']:.2f}",
            "band": f"{band:g} arcmin",
            "from_reflect": _ends(needed["reflect"]),
            "from_paper": _ends(needed["velocity"]),
            "ratios": _ends(ratios),
            "agree": str(agree),
            "apart": f"{np.median(np.abs(left - predicted)):.2f} arcmin",
        }
    }
    claims = {
        "with the paper's sigma only the reflecting turn converges": (
            radii["reflect"] < 0.5
            and all(radii[turn] > 0.95 for turn in TURNS if turn != "reflect")
        ),
        "reflecting converges from a smaller sigma": bool(
            np.nanmin(needed["reflect"]) < np.nanmin(needed["velocity"]) / 2
        ),
        "the best gains come within twice the bound": ratios.max() < 2,
        "the linear loops are right nearly everywhere": agree > 0.97 * study.n_variants,
    }
    figures = {
        "errors": _error_maps(source, grid, errors[0]),
        "by_length": _by_length(source, lengths, least),
    }
    return Page(values, figures=figures, claims=claims)


def _ends(values: NDArray) -> str:
    return f"{np.nanmin(values):.1f} to {np.nanmax(values):.1f}"


def least_errors(errors: NDArray, turns: Sequence[str]) -> dict[str, list[analysis.Estimate]]:
    """Rms over the draws with the best schedule and sigma, by turn and length, arcmin."""
    found: dict[str, list[analysis.Estimate]] = {turn: [] for turn in turns}
    for i, turn in enumerate(turns):
        for runs in np.moveaxis(errors[:, i], 1, 0):  # (schedule, sigma, draws) of a length
            candidates = runs.reshape(-1, runs.shape[-1])
            best = np.nanargmin(np.mean(candidates**2, axis=-1))
            found[turn].append(analysis.rms(candidates[best]))
    return found


def converges_from(converges: NDArray, sigmas: tuple[float, ...]) -> NDArray:
    """Smallest sigma that converges, as do all larger ones; NaN if none does.

    Args:
        converges: (..., sigmas).
        sigmas: ascending.
    """
    whole = np.logical_and.accumulate(converges[..., ::-1], axis=-1)[..., ::-1]
    return np.where(whole.any(axis=-1), np.array(sigmas)[whole.argmax(axis=-1)], np.nan)


def predict(study: Study) -> NDArray:
    """Heading from its limit at the end of each variant by the linear loops, arcmin."""
    start, ends = start_of(study), spans_s(study)[:, 0]
    models = zip(all_loops(study), ends, strict=True)
    left = [heading_of(model, start, np.array([end]))[0] for model, end in models]
    return -np.array(left) * DEG / ARCMIN


def radius_of(study: Study, turn: str, sigma: Number, length_s: Number) -> NDArray:
    """Spectral radius of a cycle of two passes with a study's turn, see `linear.cycle_radius`."""
    damping, smoothing_s = only(study, "azimuth_damping"), only(study, "turn_smoothing_s")
    return cycle_radius(sigma, length_s, REVERSALS[turn], damping=damping, smoothing_s=smoothing_s)


def _error_maps(source: Source, grid: Grid, errors: NDArray) -> Picture:
    """Constant sigma: how far from its limit the heading ends, by turn."""
    study, rows, columns = source.study, grid.axes["sigma"], grid.axes["length"]
    rms = np.sqrt(np.mean(errors**2, axis=-1))
    sigma, length_s = np.meshgrid(
        *(plots.spread(axis, _FINE) for axis in (rows, columns)), indexing="ij"
    )
    radii = [radius_of(study, turn, sigma, length_s) for turn in grid.axes["turn"]]
    low = float(bound_arcmin(study, max(columns)))
    high = float(abs(start_of(study)[1])) * DEG / ARCMIN
    figure = plots.heat_maps(
        [(TURNS[turn], rms[i].T) for i, turn in enumerate(grid.axes["turn"])],
        "How far from its limit does the heading end? By turn, sigma and record",
        Shown("rms heading error (arcmin)", low, high, reverse=True, log=True, numbers=False),
        contours=Contours("share that a cycle leaves (linear loops)", _LEVELS, radii),
        rows=Scale(SIGMA, rows),
        columns=Scale(LENGTH, columns),
        across=2,
    )
    caption = (
        f"Rms over {study.n_draws} draws, constant sigma; light is good, the darkest is the initial"
        " error and more. Left of the line of 1 a record cannot converge. *Too*: the azimuth rate,"
        " besides the velocity."
    )
    return Picture("heading_error", caption, figure, counted(source))


def _by_length(
    source: Source, lengths: NDArray, least: dict[str, list[analysis.Estimate]]
) -> Picture:
    fine = np.geomspace(lengths[0], lengths[-1], 50)
    figure = plots.by_record_length(
        lengths.tolist(),
        {TURNS[turn]: found for turn, found in least.items()},
        (fine, bound_arcmin(source.study, fine)),
        title="What a stored record can give: least heading error, from the limit",
        quantity="rms heading error (arcmin)",
    )
    caption = (
        "The best sigma and schedule of each turn, with 95 % intervals over the draws. The best is"
        " taken on the draws that it is judged on, which flatters it."
    )
    return Picture("by_length", caption, figure, counted(source))

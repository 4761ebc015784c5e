"""The map over turn, sigma and length of the stored record: errors, and their bound."""

import numpy as np
from numpy.typing import NDArray

from sinsjax import plots
from sinsjax.plots import Contours, Scale, Shown
from sinsjax.report.base import Picture, Source, only
from sinsjax.report.folder import Page
from sinsjax.report.grids import Grid
from sinsjax.report.output import counted
from sinsjax.units import ARCMIN, DEG

from ..loops.runs import bound_arcmin
from ..loops.turns import TURNS, cycle_radius

SIGMA, LENGTH = "azimuth_sigma_per_s", "tape_s"
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
    rms = np.sqrt(np.mean(errors**2, axis=-1))  # schedule, turn, length, sigma
    least = np.nanmin(rms[:, grid.axes["turn"].index("reflect")], axis=(0, 2))
    ratios = least / bound_arcmin(study, lengths)
    from_sigma = converges_from(np.abs(errors[0].mean(axis=-1)) <= band, grid.axes["sigma"])
    needed = dict(zip(grid.axes["turn"], from_sigma * lengths, strict=True))
    radii = {turn: float(cycle_radius(study, turn, *_PAPER)) for turn in TURNS}
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
    }
    return Page(values, figures={"errors": _error_maps(source, grid, rms[0])}, claims=claims)


def _ends(values: NDArray) -> str:
    return f"{np.nanmin(values):.1f} to {np.nanmax(values):.1f}"


def converges_from(converges: NDArray, sigmas: tuple[float, ...]) -> NDArray:
    """Smallest sigma that converges, as do all larger ones; NaN if none does.

    Args:
        converges: (..., sigmas).
        sigmas: ascending.
    """
    whole = np.logical_and.accumulate(converges[..., ::-1], axis=-1)[..., ::-1]
    return np.where(whole.any(axis=-1), np.array(sigmas)[whole.argmax(axis=-1)], np.nan)


def _error_maps(source: Source, grid: Grid, rms: NDArray) -> Picture:
    """Constant sigma: how far from its limit the heading ends, by turn."""
    study, rows, columns = source.study, grid.axes["sigma"], grid.axes["length"]
    sigma, length_s = np.meshgrid(
        *(plots.spread(axis, _FINE) for axis in (rows, columns)), indexing="ij"
    )
    radii = [cycle_radius(study, turn, sigma, length_s) for turn in grid.axes["turn"]]
    low = float(bound_arcmin(study, max(columns)))
    high = abs(only(study, "phi_u0_deg")) * DEG / ARCMIN
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
        f"Rms over {study.n_draws} Monte Carlo runs, constant sigma; light is good, the darkest is"
        " the initial error and more. Left of the line of 1 a record cannot converge. *Too*: the"
        " azimuth rate, besides the velocity."
    )
    return Picture("heading_error", caption, figure, counted(source))

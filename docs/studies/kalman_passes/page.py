"""Numbers of the page on a Kalman filter that goes over a stored record again and again."""

from itertools import chain, product
from typing import Any, NamedTuple

from sinsjax import analysis, plots
from sinsjax.analysis import Estimate, format_estimate
from sinsjax.report.base import Picture, Table
from sinsjax.report.study_page import Page, Sources

from ..common.grids import Grid, grid_of
from ..common.words import arcmin

SMALL, LARGE = "0.01, 0.01, 0.15 deg", "0.1, 0.1, 1.5 deg"
CARRIED, INFLATED, RESET = "carried", "inflated", "reset"
FREEDOM = analysis.NEES_FREEDOM


class Point(NamedTuple):
    """The runs with one number of passes: mean NEES, rms heading error, the filter's own sigma."""

    nees: Estimate
    error: Estimate
    sigma: Estimate


def _point(grid: Grid, **at: Any) -> Point:
    nees, yaw, floor, sigma = (grid.at(column, **at) for column in grid.columns)
    return Point(analysis.mean(nees), analysis.rms(yaw - floor), analysis.mean(sigma))


def page(sources: Sources) -> Page:
    """How the filter's covariance and its error go with the number of passes."""
    source = sources["kalman_passes"]
    study = source.study
    columns = ("nees", "phi_u_arcmin", "floor_arcmin", "sigma_u_arcmin")
    grid = grid_of(source, columns, case="case", turn="turn_covariance", passes="passes")
    counts, turns = grid.axes["passes"], grid.axes["turn"]
    last = counts[-1]
    points = {
        (case, turn, n): _point(grid, case=case, turn=turn, passes=n)
        for case, turn, n in product(*grid.axes.values())
    }
    one, seven = points[SMALL, CARRIED, 1], points[SMALL, CARRIED, last]
    low, high = analysis.chi2_mean_band(FREEDOM, grid.draws)
    far = [points[LARGE, RESET, n] for n in counts[:3]]
    values = {
        "passes": last,
        "far": format_estimate(far[0].nees),
        "inflation": f"{study.values('turn_inflation')[0] or 10:g}",
        "draws": grid.draws,
        "carried": {
            "nees": format_estimate(seven.nees),
            "sigma": f"{seven.sigma.value / one.sigma.value:.2f}",
            "expected": f"{last**-0.5:.2f}",
            "error": f"{seven.error.value / one.error.value:.2f}",
        },
        "one": {"nees": format_estimate(one.nees, digits=2), "error": arcmin(one.error, 2)},
        "band": f"{low:.2f} to {high:.2f}",
        "reset": {
            "nees": format_estimate(points[SMALL, RESET, last].nees, digits=2),
            "first": arcmin(far[0].error, 2),
            "second": arcmin(far[1].error, 2),
            "third": arcmin(far[2].error, 2),
        },
    }
    settled = [points[case, turn, last] for case in (SMALL, LARGE) for turn in (INFLATED, RESET)]

    def meets(nees: Estimate) -> bool:
        """Whether the interval of a mean NEES meets the band of a consistent filter."""
        return nees.low <= high and nees.high >= low

    claims = {
        "carried, its sigma shrinks by 1/sqrt(passes)": (
            abs(seven.sigma.value / one.sigma.value * last**0.5 - 1) < 0.05
        ),
        "carried, the error stays": abs(seven.error.value / one.error.value - 1) < 0.05,
        "carried, NEES is far above its band": seven.nees.low > 2 * high,
        "inflated or reset, NEES lies about its band": all(meets(p.nees) for p in settled),
        "from the large misalignment one pass is far above the band": far[0].nees.low > 2 * high,
        "a second pass takes most of a large error, a third nothing": (
            far[1].error.high < far[0].error.low / 3
            and abs(far[2].error.value / far[1].error.value - 1) < 0.05
        ),
        "the interval of one pass meets the band, and its mean is low": (
            meets(one.nees) and one.nees.value < FREEDOM
        ),
    }
    figure = plots.draw_along_axis(
        "passes",
        tuple(map(float, counts)),
        {
            f"mean NEES, misaligned by {case}": {
                f"P {turn} at a turn": [points[case, turn, n].nees for n in counts]
                for turn in turns
            }
            for case in (SMALL, LARGE)
        },
        title="Passes over a stored record: mean NEES of the attitude",
        expected=plots.ExpectedValue(
            "consistent: 3, and its 95 % band", float(FREEDOM), (low, high)
        ),
        log=True,
    )
    for axes in figure.axes:
        axes.set_ylim(2.0, 50.0)
    caption = (
        f"Mean NEES with its 95 % interval over {grid.draws} Monte Carlo runs, logarithmic. Above"
        " the grey band the filter is overconfident."
    )
    picture = Picture("nees_by_passes", caption, figure)
    return Page(values, {"settings": _settings(points, last)}, {"nees": picture}, claims)


def _settings(points: dict[Any, Point], last: int) -> Table:
    """Return the heading error and the sigma of each treatment of P after the last pass."""
    rows = []
    for turn in (RESET, INFLATED, CARRIED):
        at_end = (points[case, turn, last] for case in (SMALL, LARGE))
        cells = ((format_estimate(p.error, digits=2), f"{p.sigma.value:.2f}") for p in at_end)
        rows.append([f"P {turn}", *chain(*cells)])
    header = ["at a turn", f"error from {SMALL}", "own sigma", f"error from {LARGE}", "own sigma"]
    note = "Rms heading error from truth, and the filter's own sigma, arcmin."
    return Table(f"After {last} passes", header, rows, note)

"""Numbers of repeated passes on a static base: gain schedules, and the map."""

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.analysis import Estimate, format_estimate
from sinsjax.analysis.formats import format_percent
from sinsjax.analysis.grids import median_over_draws
from sinsjax.bounds.information import share_outside
from sinsjax.execution.source import Source
from sinsjax.plots import GridAxis
from sinsjax.plots.labels import format_value
from sinsjax.report.base import Picture, Table
from sinsjax.report.study_page import Page, Sources
from sinsjax.units import ARCMIN, DEG

from ..common.grids import Grid, grid_of, shared
from ..common.settling import median_time, settled
from ..common.words import share
from ..loops.runs import bound_arcmin
from ..loops.turns import TURNS, cycle_radius
from .contours import Panel, contour_maps, spaced
from .survival import survival

SIGMA, LENGTH = "azimuth_sigma_per_s", "stored_s"
_PAPER = (0.01, 80.0)  # sigma of the azimuth loop, 1/s, and length of the record, s
_FINE = 32  # places along a side of a panel that contours are drawn through
SCHEME_1, SCHEME_2, LONG, RECORD = range(4)  # variants of the comparison
NAMES = (
    "Scheme 1, 600 s",
    "Scheme 2, 80 s",
    "best schedule, 600 s",
    "best schedule, 80 s, tilt reflected",
)


def page(sources: Sources) -> Page:
    """The map over turn, sigma and length, the search of schedules, and the best of them."""
    return Page.merge(
        compared(sources["compass_80s_best"]),
        searched(sources["compass_80s_search"]),
        mapped(sources["paper2_map"]),
    )


def settling(source: Source) -> tuple[NDArray, NDArray]:
    """Settling times to the widest and to the narrowest band, (variants, draws), s."""
    wide, narrow = (f"settle_{band:g}_s" for band in bands_of(source))
    grid = grid_of(source, (wide, narrow), variant=range(source.study.n_variants))
    return grid.columns[wide], grid.columns[narrow]


def bands_of(source: Source) -> tuple[float, float]:
    """The widest and the narrowest settle band, arcmin."""
    bands = source.study.study.settle_bands_arcmin
    return max(bands), min(bands)


def rank(wide_s: NDArray, narrow_s: NDArray) -> tuple[list[int], int]:
    """The variants from the best one, and how many share the first place; equals as they come.

    The smallest median settling time to the narrow band is best; a draw that never settles is
    infinite. Those whose interval of that median overlaps the best one's are tied; among them the
    smallest median to the wide band wins, then the smallest to the narrow one.
    """
    narrow = [analysis.quantile(times) for times in narrow_s]
    first, second = np.array([one.value for one in narrow]), median_over_draws(wide_s)
    best = narrow[int(np.lexsort((second, first))[0])]
    tied = np.array([_overlap(one, best) for one in narrow])
    keys = np.where(tied, first, second), np.where(tied, second, first), ~tied
    return np.lexsort(keys).tolist(), int(tied.sum())


def _overlap(one: Estimate, other: Estimate) -> bool:
    """Whether two intervals share a value; an end that is not known is no bound."""
    return not (one.low > other.high or other.low > one.high)


def searched(source: Source) -> Page:
    """The best schedule of the search."""
    study, (order, tied) = source.study, rank(*settling(source))
    gains = ("level_sigma_per_s", "level_time_s", "azimuth_sigma_per_s")
    keys = (*gains, "sigma_factors", "sigma_times_s", "turn_smoothing_s")
    values = {
        "search": {"schedules": len(order), "draws": study.n_draws, "tied": tied},
        "set": {key: format_value(study.values(key)[order[0]]) for key in keys},
    }
    return Page(values)


def compared(source: Source) -> Page:
    """The best schedule compared with the paper's schemes."""
    study, (wide, narrow) = source.study, bands_of(source)
    wide_s, narrow_s = settling(source)
    reached = np.isfinite(narrow_s).mean(axis=-1)
    outside = share_outside(bound_arcmin(study, study.values("stored_s")), narrow)
    begins_last = study.run_s - 2 * study.values("stored_s")[RECORD]
    to_wide = [analysis.quantile(times) for times in wide_s]

    values = {
        "bands": {"wide": f"{wide:g} arcmin", "narrow": f"{narrow:g} arcmin"},
        "record": {
            "wide": median_time(wide_s[RECORD]),
            "narrow": settled(narrow_s[RECORD]),
            "bound": f"{100 * (1 - outside[RECORD]):.0f} %",
            "cycle": share(shared(narrow_s[RECORD] <= begins_last)),
        },
        "long": {"share": settled(narrow_s[LONG])},
        "scheme_1": median_time(wide_s[SCHEME_1]),
    }
    claims = {
        "80 s with the best schedule settle far sooner than Scheme 1": (
            to_wide[RECORD].high < to_wide[SCHEME_1].low / 4
            and np.isfinite(wide_s[RECORD]).mean() > 0.99
        ),
        "every draw of the others settles within the wide band": all(
            np.isfinite(wide_s[case]).all() for case in (SCHEME_1, LONG, RECORD)
        ),
        "no draw of Scheme 2 settles with the paper's turn": np.isinf(wide_s[SCHEME_2]).all(),
        "the record comes near its bound": reached[RECORD] > 0.8 * (1 - outside[RECORD]),
        "with 600 s of data nearly every draw comes within the narrow band": (reached[LONG] > 0.99),
    }
    times = {f"within {wide:g} arcmin": wide_s, f"within {narrow:g} arcmin": narrow_s}
    figure = survival(
        {band: dict(zip(NAMES, runs, strict=True)) for band, runs in times.items()},
        "How many runs have not settled yet about the bias floor?",
        end_s=study.duration_s,
        levels={f"within {narrow:g} arcmin": dict(zip(NAMES, outside, strict=True))},
    )
    caption = (
        f"Share of {study.n_draws:,} Monte Carlo runs (95 % interval: ±3 % at most). Dashed:"
        " the share that the noise leaves outside with any method."
    )
    picture = Picture("settling", caption, figure, source.sample_size_text)
    table = _cases(source, wide_s, narrow_s)
    return Page(values, {"cases": table}, {"settling": picture}, claims)


def _cases(source: Source, wide_s: NDArray, narrow_s: NDArray) -> Table:
    """Return median settling times to both bands, and the share within the narrow one."""

    def median(times_s: NDArray) -> str:
        return format_estimate(analysis.quantile(times_s), digits=0)

    wide, narrow = bands_of(source)
    rows = [
        [
            name,
            median(wide_s[i]),
            median(narrow_s[i]),
            format_percent(shared(np.isfinite(narrow_s[i]))),
        ]
        for i, name in enumerate(NAMES)
    ]
    header = ["median", f"to {wide:g}' (s)", f"to {narrow:g}' (s)", f"within {narrow:g}' (%)"]
    note = f"[95 % interval]. All runs but those of Scheme 2 settle within {wide:g}'."
    return Table("What to expect", header, rows, note)


def layout(source: Source) -> Grid:
    """Every run by schedule, turn, length of the record, sigma and draw."""
    columns = ("phi_u_arcmin", "floor_arcmin")
    sides = {"schedule": "sigma_factors", "turn": "turn", "length": LENGTH, "sigma": SIGMA}
    return grid_of(source, columns, **sides)


def mapped(source: Source) -> Page:
    """What turn, sigma and length of the record decide."""
    study, grid = source.study, layout(source)
    errors = grid.columns["phi_u_arcmin"] - grid.columns["floor_arcmin"]
    lengths = np.array(grid.axes["length"])
    rms = np.sqrt(np.mean(errors**2, axis=-1))  # schedule, turn, length, sigma
    least = np.nanmin(rms[:, grid.axes["turn"].index("reflect")], axis=(0, 2))
    ratios = least / bound_arcmin(study, lengths)
    radii = {turn: float(cycle_radius(study, turn, *_PAPER)) for turn in TURNS}
    values = {
        "map": {
            "paper": f"{radii['velocity']:.3f}",
            "reflect": f"{radii['reflect']:.2f}",
            "ratios": f"{ratios.min():.1f} to {ratios.max():.1f}",
        }
    }
    claims = {
        "with the paper's sigma only the reflecting turn converges": (
            radii["reflect"] < 0.5
            and all(radii[turn] > 0.95 for turn in TURNS if turn != "reflect")
        ),
        "the best gains come within twice the bound": ratios.max() < 2,
    }
    return Page(values, figures={"errors": _error_maps(source, grid, rms[0])}, claims=claims)


def _error_maps(source: Source, grid: Grid, rms: NDArray) -> Picture:
    """Constant sigma: how far from its limit the heading ends, by turn."""
    study, rows, columns = source.study, grid.axes["sigma"], grid.axes["length"]
    sigma, length_s = np.meshgrid(*(spaced(axis, _FINE) for axis in (rows, columns)), indexing="ij")
    panels = [
        Panel(TURNS[turn], rms[i].T, cycle_radius(study, turn, sigma, length_s))
        for i, turn in enumerate(grid.axes["turn"])
    ]
    figure = contour_maps(
        panels,
        "Heading error from its bias floor, by turn, sigma and record",
        rows=GridAxis(SIGMA, rows),
        columns=GridAxis(LENGTH, columns),
    )
    start = abs(study.single_value("phi_u0_deg")) * DEG / ARCMIN
    caption = (
        f"Rms of {study.n_draws} Monte Carlo runs per dot, initially {start:.0f} arcmin. Left of"
        " the line of 1 no record converges. Too: the azimuth rate as well as the velocity."
    )
    return Picture("heading_error", caption, figure, source.sample_size_text)

"""Numbers of the page on consistency: filters that know their own error, and three that do not."""

from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from scipy import special

from sinsjax import analysis, plots
from sinsjax.analysis import Estimate, format_estimate
from sinsjax.analysis.formats import format_percent
from sinsjax.execution.source import Source
from sinsjax.plots import ConsistencyLine
from sinsjax.report.base import Picture, Table
from sinsjax.report.study_page import Page, Sources

TRUE, SLOW = "Q as the noise", "the same, feedback every 10 s"
SMALL_Q, LARGE_Q = "a quarter of that Q", "four times that Q"
BIASED = "a gyro bias of 0.001 deg/h"
QUANTILE = float(special.chdtri(analysis.NEES_FREEDOM, 1 - analysis.CONFIDENCE))
COLUMNS = ("case", "nees", "nis_u", "p_above_error_share", "p_above_floor_error_share")


class Checked(NamedTuple):
    """A filter's mean NEES and NIS, and the share of runs up to the 95 % quantile."""

    nees: Estimate
    nis_u: Estimate
    inside: Estimate
    rows: pa.Table


def page(sources: Sources) -> Page:
    """Mean NEES and NIS of each filter beside the chi-square band of a consistent one."""
    source = sources["consistency"]
    checked = checks(source)
    draws = checked[TRUE].nees.n
    nees, nis = (analysis.chi2_mean_band(k, draws) for k in (analysis.NEES_FREEDOM, 1))
    names = {"right": TRUE, "slow": SLOW}
    values: dict[str, Any] = {
        "draws": f"{draws:,}",
        "band": f"{nees[0]:.2f} to {nees[1]:.2f}",
        "quantile": f"{QUANTILE:.2f}",
        **{name: {"nees": format_estimate(checked[c].nees, digits=2)} for name, c in names.items()},
    }
    claims = {
        "consistent filters lie in both bands": all(
            within(checked[case].nees, nees) and within(checked[case].nis_u, nis)
            for case in (TRUE, SLOW)
        ),
        "95 % of the runs lie up to the quantile": (
            checked[TRUE].inside.low <= analysis.CONFIDENCE <= checked[TRUE].inside.high
        ),
        "too small a Q is above": checked[SMALL_Q].nees.low > nees[1],
        "too large a Q is below": checked[LARGE_Q].nees.high < nees[0],
        "a bias is above in NEES and not in NIS": (
            checked[BIASED].nees.low > nees[1] and within(checked[BIASED].nis_u, nis)
        ),
    }
    lines = [ConsistencyLine.from_runs(case, one.rows) for case, one in checked.items()]
    figure = plots.draw_consistency(lines, "Does the filter know its own error?")
    caption = (
        "Left: NEES at the end; dashed: a consistent filter; right of it: overconfident. Right:"
        " share of records (95 % interval) in which the heading variance exceeds the squared error;"
        " dashed: 68 %, consistent."
    )
    picture = Picture("consistency", caption, figure)
    return Page(values, {"all": table(checked, nees, nis)}, {"consistency": picture}, claims)


def checks(source: Source) -> dict[str, Checked]:
    """Each case of the study, in its order."""
    found = {}
    for key, rows in analysis.group_rows(source.rows((*COLUMNS, "draw_id", "start_s")), ["case"]):
        nees, nis = (analysis.numeric_column(rows, column) for column in ("nees", "nis_u"))
        inside = analysis.proportion(int(np.count_nonzero(nees <= QUANTILE)), nees.size)
        found[key["case"]] = Checked(analysis.mean(nees), analysis.mean(nis), inside, rows)
    return found


def within(mean: Estimate, band: tuple[float, float]) -> bool:
    """Whether a mean lies in its band."""
    return band[0] <= mean.value <= band[1]


def table(
    checked: dict[str, Checked], nees: tuple[float, float], nis: tuple[float, float]
) -> Table:
    """Return the filters with feedback every second, with both bands of a consistent one."""
    bands = [f"{low:.2f} to {high:.2f}" for low, high in (nees, nis)]
    rows = [["*consistent*", *bands, "95"]]
    for case, one in checked.items():
        if case == SLOW:
            continue  # as with feedback every second
        means = (format_estimate(mean, digits=2) for mean in (one.nees, one.nis_u))
        rows.append([case, *means, format_percent(one.inside)])
    inside = f"runs up to {QUANTILE:.2f} (%)"
    header = ["filter", "mean NEES", "of the heading, from its floor", inside]
    return Table("Four filters on the same noise", header, rows, "Number [95 % interval].")

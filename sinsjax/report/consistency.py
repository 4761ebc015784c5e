"""Consistency of a method's covariance: its error in units of its own sigma, over the runs."""

import math
from collections.abc import Iterator

import numpy as np
from matplotlib.figure import Figure

from sinsjax import analysis, plots
from sinsjax.columns import FAILED
from sinsjax.execution.results import Results
from sinsjax.messages import format_count
from sinsjax.methods.filters.keys import estimates_biases
from sinsjax.methods.registry import METHODS, PACKAGES
from sinsjax.plots.consistency import NEES_COLUMNS, SHARE_COLUMNS
from sinsjax.report.base import Fact, Picture
from sinsjax.report.grouping import choose_line_keys
from sinsjax.study.schema import BIAS_KEYS
from sinsjax.units import ARCMIN, MICRO

_YAW, _FREEDOM = "phi_u_arcmin", analysis.NEES_FREEDOM
_FAR = 2.0  # times the upper end of its band: a mean NEES beyond it is explained


def consistency_blocks(source: Results) -> Iterator[Picture | str]:
    """Consistency where the method has a covariance, of the heading from the bias floor if biased.

    One line per variant; of many variants, one line per value of the first key that has few.
    """
    keys, note = choose_line_keys(source)
    table = source.distinct_rows(
        (*keys, *NEES_COLUMNS, *SHARE_COLUMNS.values(), "draw_id", "start_s")
    )
    if not np.isfinite(analysis.numeric_column(table, "nees")).any():
        return
    explanation = _explain_unmodelled_biases(source)
    yield from explanation
    from_floor = bool(explanation)
    if np.isfinite(analysis.numeric_column(table, NEES_COLUMNS[from_floor])).any():
        figure = plots.plot_belief(table, by=keys, from_floor=from_floor)
        yield consistency_picture(figure, note, from_floor=from_floor)


def _explain_unmodelled_biases(source: Results) -> list[str]:
    """Explain why filters without bias states have no NEES of 3 with constant sensor biases."""
    study = source.study
    methods = [METHODS[name] for name in study.methods]
    filters = [method for method in methods if method.has_covariance and method.finds_heading]
    if study.is_recorded or any(map(estimates_biases, filters)):
        return []
    gyro, accel = (source.largest_magnitude(key) for key in BIAS_KEYS)
    if not gyro and not accel:
        return []
    names = [*(f"sigma_{axis}_arcmin" for axis in "enu"), "floor_arcmin", _YAW, "nees"]
    rows = source.distinct_rows(names)
    *sigmas, floor, yaw, nees = (analysis.numeric_column(rows, name) for name in names)
    east, north, up = np.nanmedian(sigmas, axis=1)
    text = (
        f"A NEES of {_FREEDOM} cannot be expected here: it includes the whole error, and the"
        f" sensors have constant biases (gyros up to {gyro:g} deg/h, accelerometers up to"
        f" {accel:g} ug) for which this filter has no states, so P excludes the bias floor."
    )
    if accel:
        text += (
            f" The accelerometer biases alone tilt the level by up to {accel * MICRO / ARCMIN:.2f}"
            f" arcmin, while the filter's own 1 sigma is {east:.2f} arcmin about east and"
            f" {north:.2f} about north (medians over the runs)."
        )
    sentences = [text]
    mean, most = analysis.mean(nees).value, analysis.chi2_mean_band(_FREEDOM, source.draws)[1]
    floor_rms, error_rms = (analysis.rms(errors_arcmin).value for errors_arcmin in (floor, yaw))
    if mean > _FAR * most and floor_rms > up:
        sentences.append(
            f"The mean NEES is {f'{mean:.3g}' if mean < 1000 else f'{mean:,.0f}'}, far above the"
            f" band of a consistent filter, which ends at {most:.2g}: P does not contain the"
            " turn-on biases, and its 1 sigma alone is not the error to expect. Add the bias floor"
            f" ({floor_rms:.1f} arcmin, rms over the runs) and the filter's 1 sigma of the heading"
            f" ({up:.1f} arcmin, median) in quadrature: {math.hypot(floor_rms, up):.1f} arcmin."
            f" The heading errors found are {error_rms:.1f} arcmin rms."
        )
    return sentences


def covariance_cautions(source: Results) -> Iterator[Fact]:
    """Yield a caution for each plug-in method with runs that end with an impossible covariance.

    Sigmas are null if a variance is negative or not finite. Runs that failed are left out.
    """
    plugins = [name for name in source.study.methods if name in PACKAGES]
    if not any(METHODS[name].has_covariance for name in plugins):
        return
    axes = [f"sigma_{axis}_arcmin" for axis in "enu"]
    rows = source.rows(["variant_id", "status", "nees", *axes])
    *sigmas, nees = (analysis.numeric_column(rows, name) for name in (*axes, "nees"))
    failed = np.any([analysis.status_mask(rows, status) for status in FAILED], axis=0)
    method_of_run = np.array(source.study.values("method"))[rows["variant_id"].to_numpy()]
    for name in plugins:
        known = np.isfinite(sigmas if METHODS[name].finds_heading else sigmas[:2]).all(axis=0)
        runs = (method_of_run == name) & ~failed
        bad = int(np.sum(runs & (~known | (nees < 0))))
        if bad and METHODS[name].has_covariance:
            text = f"the covariance of {name} is negative or not finite at the end of {bad:,} of"
            yield Fact("Caution", f"{text} {format_count(int(runs.sum()), 'run')}", True)


def consistency_picture(figure: Figure, note: str = "", *, from_floor: bool = False) -> Picture:
    """Return the figure of the filters' consistency, with its caption."""
    error = "heading error from the bias floor" if from_floor else "attitude error"
    return Picture(
        "consistency",
        f"Left: NEES, the squared {error} at the end in units of the filter's own covariance;"
        " a consistent filter follows the dashed line, an overconfident one lies right of it."
        " Right: mean share of records, with its 95 % interval, in which the filter's heading"
        " variance exceeds the squared heading error; a consistent filter has 68 % (dashed), a too"
        f" cautious one more.{note}",
        figure,
    )

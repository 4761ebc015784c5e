"""Consistency of a method's covariance: its error in units of its own sigma, over the runs."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from sinsjax import analysis, plots
from sinsjax.columns import FAILED
from sinsjax.execution.results import Results
from sinsjax.messages import format_count
from sinsjax.methods.filters.keys import estimates_biases
from sinsjax.methods.registry import METHODS, PACKAGES
from sinsjax.plots.comparison import MAX_LINES
from sinsjax.plots.consistency import NEES_COLUMNS, SHARE_COLUMNS
from sinsjax.report.base import Fact, Picture, caution
from sinsjax.study.schema import BIAS_KEYS


def consistency_blocks(source: Results) -> Iterator[Picture | str]:
    """Consistency where the method has a covariance, of the heading from the bias floor if biased.

    One line per variant; of many variants, one line per value of the first key that has few.
    """
    keys, note = _choose_line_keys(source)
    table = source.distinct_rows(
        (*keys, *NEES_COLUMNS, *SHARE_COLUMNS.values(), "draw_id", "start_s")
    )
    if not np.isfinite(analysis.numeric_column(table, "nees")).any():
        return
    explanation = _explain_unmodelled_biases(source)
    yield from explanation
    from_floor = bool(explanation)
    if np.isfinite(analysis.numeric_column(table, NEES_COLUMNS[from_floor])).any():
        error = "heading error from the bias floor" if from_floor else "attitude error"
        yield Picture(
            "consistency",
            f"Left: NEES, the squared {error} at the end in units of the filter's own covariance;"
            " a consistent filter follows the dashed line, an overconfident one lies right of it."
            " Right: mean share of records, with its 95 % interval, in which the filter's heading"
            " variance exceeds the squared heading error; a consistent filter has 68 % (dashed), a"
            f" too cautious one more.{note}",
            plots.plot_belief(table, by=keys, from_floor=from_floor),
        )


def _choose_line_keys(source: Results) -> tuple[Sequence[str], str]:
    """Return the keys that identify a few lines, and a note for the caption.

    These are all keys if there are few variants, else the first key with few values, or none.
    """
    if source.study.n_variants <= MAX_LINES:
        return source.study.keys_shown, ""
    for keys, values in source.study.axes_shown.items():
        if len(values) <= MAX_LINES:
            return keys, f" All runs of the same {' and '.join(keys)} make one line."
    return (), " All runs together."


def _largest_magnitude(source: Results, key: str) -> float:
    """Return the largest magnitude of a key's numbers, fixed or drawn, to 3 digits."""
    drawn = key in source.study.drawn_keys
    values = source.rows([key])[key].to_pylist() if drawn else source.study.values(key)
    return float(f"{max(float(np.max(np.abs(value or 0.0))) for value in values):.3g}")


def _explain_unmodelled_biases(source: Results) -> list[str]:
    """Explain why filters without bias states have no NEES of 3 with constant sensor biases."""
    study = source.study
    methods = [METHODS[name] for name in study.methods]
    filters = [method for method in methods if method.has_covariance and method.finds_heading]
    if study.is_recorded or any(map(estimates_biases, filters)):
        return []
    gyro, accel = (_largest_magnitude(source, key) for key in BIAS_KEYS)
    if not gyro and not accel:
        return []
    names = ("floor_arcmin", "phi_u_arcmin", "sigma_u_arcmin")
    rows = source.distinct_rows(names)
    floor, error = (analysis.rms(analysis.numeric_column(rows, name)).value for name in names[:2])
    sigma = float(np.nanmedian(analysis.numeric_column(rows, names[2])))
    text = (
        f"A NEES of {analysis.NEES_FREEDOM} cannot be expected here: the sensors have constant"
        f" biases (gyros up to {gyro:g} deg/h, accelerometers up to {accel:g} ug) for which this"
        " filter has no states, so P excludes the bias floor."
    )
    if floor > sigma:
        text += (
            f" Add it ({floor:.1f} arcmin, rms over the runs) and the filter's 1 sigma of the"
            f" heading ({sigma:.1f} arcmin, median) in quadrature: {math.hypot(floor, sigma):.1f}"
            f" arcmin. The heading errors found are {error:.1f} arcmin rms."
        )
    return [text]


def covariance_cautions(source: Results) -> Iterator[Fact]:
    """Yield a caution for each plug-in method with runs that end with an impossible covariance.

    Sigmas are null if a variance is negative or not finite. Runs that failed are left out.
    """
    plugins = [name for name in source.study.methods if name in PACKAGES]
    plugins = [name for name in plugins if METHODS[name].has_covariance]
    if not plugins:
        return
    axes = [f"sigma_{axis}_arcmin" for axis in "enu"]
    rows = source.rows(["variant_id", "status", "nees", *axes])
    *sigmas, nees = (analysis.numeric_column(rows, name) for name in (*axes, "nees"))
    failed = np.any([analysis.status_mask(rows, status) for status in FAILED], axis=0)
    method_of_run = np.array(source.study.values("method"))[rows["variant_id"].to_numpy()]
    for name in plugins:
        known = np.isfinite(sigmas if METHODS[name].finds_heading else sigmas[:2]).all(axis=0)
        runs = (method_of_run == name) & ~failed
        if bad := int(np.sum(runs & (~known | (nees < 0)))):
            text = f"the covariance of {name} is negative or not finite at the end of {bad:,} of"
            yield caution(f"{text} {format_count(int(runs.sum()), 'run')}")

"""What a method's covariance is worth: its error in units of what it believes, over the runs."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sinsjax import analysis, plots
from sinsjax.execution.source import Source
from sinsjax.methods.filters.config import estimates_biases
from sinsjax.methods.registry import METHODS
from sinsjax.plots.beliefs import SHARES
from sinsjax.report.base import Picture, Text
from sinsjax.report.groupings import keys_of_lines
from sinsjax.report.markup import said
from sinsjax.study.schema import BIAS_KEYS
from sinsjax.units import ARCMIN, MICRO

_YAW, _FREEDOM = "phi_u_arcmin", analysis.NEES_FREEDOM
_FAR = 2.0  # times the upper end of its band: a mean NEES beyond it is explained


def spreads(source: Source) -> Iterator[Picture | Text]:
    """Consistency where the method has a covariance, or why none is to be expected.

    A line a variant; of many variants, a line a value of the first key that has few.
    """
    keys, note = keys_of_lines(source)
    table = source.distinct_rows((*keys, "nees", *SHARES.values(), "draw_id", "start_s"))
    if not np.isfinite(analysis.numbers(table, "nees")).any():
        return
    told, swamped = _biases_unknown(source)
    yield from told
    if not swamped:
        yield consistency(plots.plot_belief(table, by=keys), note)


def _biases_unknown(source: Source) -> tuple[list[Text], bool]:
    """Why filters without bias states have no NEES of 3 where the sensors have constant biases.

    Returns:
        Sentences, and whether the biases exceed the filters' own sigma, so that a figure of their
        consistency shows the biases alone.
    """
    study = source.study
    filters = [METHODS[name] for name in study.methods if METHODS[name].has_covariance]
    if study.is_recorded or any(map(estimates_biases, filters)):
        return [], False
    gyro, accel = (source.largest_magnitude(key) for key in BIAS_KEYS)
    if not gyro and not accel:
        return [], False
    names = [*(f"sigma_{axis}_arcmin" for axis in "enu"), "floor_arcmin", _YAW, "nees"]
    rows = source.distinct_rows(names)
    *sigmas, limit, yaw, nees = (analysis.numbers(rows, name) for name in names)
    east, north, up = np.nanmedian(sigmas, axis=1)
    tilt = accel * MICRO / ARCMIN
    told: dict[str, Any] = {"gyro": gyro, "accel": accel, "tilt": tilt, "sigmas": (east, north)}
    found = [Text(said("biases_unknown", nees=_FREEDOM, **told))]
    mean, most = analysis.mean(nees).value, analysis.chi2_mean_band(_FREEDOM, source.draws)[1]
    left, errors = (analysis.rms(one).value for one in (limit, yaw))
    if mean > _FAR * most and left > up:
        told = {"mean": mean, "most": most, "sigma": up, "limit": left, "found": errors}
        found.append(Text(said("overconfident", **told)))
    return found, bool(left > up or tilt > max(east, north))


def consistency(figure: Figure, note: str = "") -> Picture:
    """The figure of what filters believe of their error, with its caption."""
    return Picture(
        "consistency",
        "Left: NEES, the squared attitude error at the end in units of the filter's own covariance;"
        " a consistent filter follows the dashed line, an overconfident one lies right of it."
        " Right: mean share of records, with its 95 % interval, in which the filter's heading"
        " variance exceeds the squared heading error; a consistent filter has 68 % (dashed), a too"
        f" cautious one more.{note}",
        figure,
    )

"""What a method's covariance is worth: its error in units of what it believes, over the runs."""

from collections.abc import Iterator, Sequence

import numpy as np

from sinsjax import analysis, plots
from sinsjax.execution.groupings import keys_of_lines
from sinsjax.execution.source import Source
from sinsjax.plots.beliefs import SHARES, BeliefPanel
from sinsjax.plots.words import name_of
from sinsjax.report.base import Picture, Text
from sinsjax.report.markup import said
from sinsjax.units import ARCMIN, MICRO


def spreads(source: Source) -> Iterator[Picture | Text]:
    """Consistency where the method has a covariance.

    A line a variant; of many variants, a line a value of the first key that has few.
    """
    keys, note = keys_of_lines(source)
    needed = (*keys, "nees", *SHARES.values(), "draw_id", "start_s")
    groups = analysis.groups(source.rows(needed), keys)
    beliefs = [BeliefPanel.of(name_of(key), rows) for key, rows in groups]
    if beliefs := [one for one in beliefs if np.isfinite(one.nees).any()]:
        yield consistency(beliefs, note)
        yield from _biases_unknown(source)


def _biases_unknown(source: Source) -> Iterator[Text]:
    """Why a filter without bias states has no NEES of 3 where the sensors have constant biases."""
    study = source.study
    if study.is_recorded or set(study.values("method")) != {"kalman5"}:
        return
    gyro, accel = (
        max(float(np.max(np.abs(value or 0.0))) for value in study.values(key))
        for key in ("gyro_bias_deg_per_h", "accel_bias_ug")
    )
    if not gyro and not accel:
        return
    rows = source.rows(["sigma_e_arcmin", "sigma_n_arcmin"])
    east, north = (
        analysis.quantile(analysis.numbers(rows, f"sigma_{a}_arcmin")).value for a in "en"
    )
    tilt = accel * MICRO / ARCMIN
    told = {"gyro": gyro, "accel": accel, "tilt": tilt, "east": east, "north": north}
    yield Text(said("biases_unknown", nees=analysis.NEES_FREEDOM, **told))


def consistency(beliefs: Sequence[BeliefPanel], note: str = "") -> Picture:
    """The figure of what the filter believes of its error."""
    return Picture(
        "consistency",
        "Left: NEES, the squared attitude error at the end in units of the filter's own covariance;"
        " a consistent filter follows the dashed line, an overconfident one lies right of it."
        " Right: mean share of records, with its 95 % interval, in which the filter's heading"
        " variance exceeds the squared heading error; a consistent filter has 68 % (dashed), a too"
        f" cautious one more.{note}",
        plots.beliefs(beliefs, "Does the filter know its own error?"),
    )

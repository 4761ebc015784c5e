"""The attitude that a run ends with: the first thing that a user of a record wants."""

from scipy import special

from sinsjax import analysis
from sinsjax.errors import InputError
from sinsjax.execution.source import Source
from sinsjax.report.base import Table, value_text
from sinsjax.study.swept import shown_keys

MOST_ROWS = 20
"""Rows of a table; what is left out is said."""


def attitudes(source: Source) -> Table:
    """Final attitude with the filter's own 1 sigma, run by run: what `align` is asked for."""
    keys = ["start_s", *shown_keys(source.study)]
    angles = [f"{angle}_deg" for angle in ("pitch", "roll", "yaw")]
    sigmas = [f"sigma_{axis}_arcmin" for axis in "enu"]
    digits = dict.fromkeys(angles, 4) | dict.fromkeys(sigmas, 2)
    variants = source.study.n_variants
    shown = MOST_ROWS // variants * variants or MOST_ROWS  # whole start times, where they fit
    rows = [
        [value_text(row[key]) for key in keys]
        + [_number(row[name], places) for name, places in digits.items()]
        for row in source.rows([*keys, *digits]).slice(0, shown).to_pylist()
    ]
    left = source.runs - len(rows)
    notes = [f"{left} more runs are in `summary/`."] if left else []
    notes += [innovations(source)] if source.study.is_recorded else []
    title = "Attitude at the end, with the filter's own 1 sigma"
    return Table(title, [*keys, *digits], rows, " ".join(notes))


def innovations(source: Source) -> str:
    """What the filters' innovations on a record say of their beliefs, and what they cannot say.

    Only values above the chi-square band contradict a belief. One below it tells of an R that is
    larger than the noise: the heading then shows in no innovation.
    """
    try:
        rows = source.rows(["innovation_nis", "innovation_freedom"])
    except InputError:
        return "Innovations: none are recorded."
    mean, freedom = (analysis.numbers(rows, name) for name in rows.column_names)
    mean, freedom = mean[freedom > 0], freedom[freedom > 0]
    if not mean.size:
        return "No method here has innovations."
    tail = (1 - analysis.CONFIDENCE) / 2
    low, high = (2 * special.chdtri(freedom, p) / freedom for p in (1 - tail, tail))
    above, below = int((mean > high).sum()), int((mean < low).sum())
    text = (
        f"Innovations: the mean of r' S^-1 r is {mean.min():.3g} to {mean.max():.3g} in"
        f" {mean.size:,} runs with a filter, where 2 is expected of a true belief"
        f" ({low.min():.3g} to {high.max():.3g} in 95 % of them, were they white)."
    )
    if above:
        text += (
            f" {above:,} lie above: their data contradict what the filter believes of noise and"
            " model, and its 1 sigma is not to be trusted."
        )
    if below:
        text += (
            f" {below:,} lie below: R is larger than the noise of this data. That contradicts"
            " nothing, and innovations so small cannot show a wrong heading."
        )
    return text


def _number(value: float | None, digits: int) -> str:
    return "unknown" if value is None else f"{value:.{digits}f}"

"""The attitude that a run ends with: the first thing that a user of a record wants."""

from scipy import special

from sinsjax import analysis
from sinsjax.errors import InputError
from sinsjax.execution.source import Source
from sinsjax.report.base import MOST_ROWS, Table, table_of
from sinsjax.report.markup import said


def attitudes(source: Source) -> Table:
    """Final attitude with the filter's own 1 sigma, run by run: what `align` is asked for."""
    keys = ["start_s", *source.study.keys_shown]
    digits = dict.fromkeys([f"{angle}_deg" for angle in ("pitch", "roll", "yaw")], 4)
    digits |= dict.fromkeys([f"sigma_{axis}_arcmin" for axis in "enu"], 2)
    variants = source.study.n_variants
    shown = MOST_ROWS // variants * variants or MOST_ROWS  # whole start times, where they fit
    rows = source.rows([*keys, *digits]).slice(0, shown).to_pylist()
    cells = [
        (name, lambda row, n=name: analysis.format_number(row[n], digits[n])) for name in digits
    ]
    notes = [f"{left} more runs are in `summary/`."] if (left := source.runs - len(rows)) else []
    notes += [innovations(source)] if source.study.is_recorded else []
    title = "Attitude at the end, with the filter's own 1 sigma"
    return table_of(title, keys, rows, cells, " ".join(notes))


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
    return said("innovations", mean=mean, low=low.min(), high=high.max(), above=above, below=below)

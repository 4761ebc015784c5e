"""The attitude that a run ends with: the first thing that a user of a record wants."""

from sinsjax.report.base import Source, Table, shown_keys, value_text

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
    note = f"{left} more runs are in `summary/`." if left else ""
    return Table("Attitude at the end, with the filter's own 1 sigma", [*keys, *digits], rows, note)


def _number(value: float | None, digits: int) -> str:
    return "unknown" if value is None else f"{value:.{digits}f}"

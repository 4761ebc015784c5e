"""The attitude that a run ends with: the first thing that a user of a record wants."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from scipy import special

from sinsjax import analysis
from sinsjax.analysis.estimates import TAIL
from sinsjax.analysis.labels import (
    describe_point,
    format_heading_error,
    format_number,
    format_value,
)
from sinsjax.errors import InputError
from sinsjax.execution.results import Results
from sinsjax.methods.filters.keys import estimates_biases
from sinsjax.methods.registry import METHODS
from sinsjax.report.document import MAX_ROWS, Fact, Table, caution

_HEADERS = {
    "heading_deg": ("heading (deg)", 3),
    "pitch_deg": ("pitch (deg)", 3),
    "roll_deg": ("roll (deg)", 3),
    "sigma_u_arcmin": ("1 sigma (')", 1),
    "phi_u_arcmin": ("error (')", 1),
}
"""Columns of the table of final attitudes: their headers and decimals."""
_DIGITS = dict.fromkeys([f"{angle}_deg" for angle in ("pitch", "roll", "yaw")], 4)
_DIGITS |= dict.fromkeys([f"sigma_{axis}_arcmin" for axis in "enu"], 2)
_LEVEL_SIGMAS, _LEVEL_ERRORS = (tuple(f"{x}_{a}_arcmin" for a in "en") for x in ("sigma", "phi"))


def attitude_facts(source: Results, variant: int | None) -> Iterator[Fact]:
    """Yield the last attitude of a variant, or of the last one, and what its heading is worth."""
    rows = source.rows(["variant_id", "start_s", *_HEADERS, *_LEVEL_SIGMAS]).to_pylist()
    row = next(row for row in reversed(rows) if variant in (None, row["variant_id"]))
    yield _attitude_fact(source, row)
    if not finds_heading(source):
        yield from _level_error_facts(source)


def finds_heading(source: Results) -> bool:
    """Return whether some method of a study finds the heading."""
    return any(METHODS[name].finds_heading for name in source.study.methods)


def heading_filters(source: Results) -> list[Any]:
    """Return the methods of a study that have a covariance of the heading."""
    methods = (METHODS[name] for name in source.study.methods)
    return [method for method in methods if method.has_covariance and method.finds_heading]


def _attitude_fact(source: Results, row: Mapping[str, Any]) -> Fact:
    """The attitude that a run ends with, and which run it is if there are several."""
    heading, pitch, roll, sigma, error = (row[name] for name in _HEADERS)
    if pitch is None or roll is None:
        return caution("unknown, the run is not finite", "Attitude")
    text, sigmas = f"pitch {pitch:.3f}, roll {roll:.3f} deg", [row[name] for name in _LEVEL_SIGMAS]
    if finds_heading(source):
        shown = "" if sigma is None else f" (1 sigma {sigma:.1f}')"
        text = (
            f"no heading, {text}"
            if heading is None
            else f"heading {heading:.3f} deg{shown}, {text}"
        )
        text += "" if error is None or heading is None else f"; {error:+.1f}' from the reference"
    elif None not in sigmas:
        biases = max(source.study.values("level_accel_bias_ug"))
        text += f" (1 sigma {max(sigmas):.1f}', with accelerometer biases of {biases:,g} ug)"
    if source.runs > 1:
        start = f"start at {row['start_s']:g} s" if source.study.is_recorded else "last draw"
        text += f" ({start})"
    return Fact("Attitude", text)


def _level_error_facts(source: Results) -> Iterator[Fact]:
    """The error of pitch and roll from the truth or reference, and that there is no heading."""
    table = source.rows_of_distinct_runs(["draw_id", "start_s", *_LEVEL_ERRORS])
    errors = np.concatenate([analysis.numeric_column(table, name) for name in _LEVEL_ERRORS])
    if np.isfinite(errors).any():
        clusters = np.tile(table["draw_id"].to_numpy(), len(_LEVEL_ERRORS))
        clusters *= not source.study.is_recorded
        found = format_heading_error(analysis.rms(errors, clusters))
        aim = "reference" if source.study.is_recorded else "truth"
        yield Fact("Accuracy", f"{found}' rms from the {aim} per angle")
    yield Fact("Heading", f"none: {' and '.join(source.study.methods)} finds pitch and roll alone")


def filter_sigma_cautions(source: Results) -> Iterator[Fact]:
    """Yield doubts about the filter's own 1 sigma."""
    estimating = [*map(estimates_biases, heading_filters(source))]
    if not all(estimating):
        text = "1 sigma is the filter's own and excludes constant biases: add their floor"
        text += " (`sinsjax advise`), or use gravity_fit with fit_gyro_bias_deg_per_h"
        yield caution(text)
    try:
        rows = source.rows(["innovation_nis", "innovation_freedom"])
    except InputError:  # no method has innovations
        return
    mean, freedom = (analysis.numeric_column(rows, name) for name in rows.column_names)
    mean, freedom = mean[freedom > 0], freedom[freedom > 0]
    # The mean of r' S^-1 r is above its 95 % band; below it R is larger than the noise, no doubt.
    if count := int((mean > 2 * special.chdtri(freedom, TAIL) / freedom).sum()):
        yield caution(f"the innovations of {count:,} runs contradict their 1 sigma")


def last_attitude_table(source: Results) -> Table:
    """Return heading, pitch and roll of each run, or of each variant at the last start."""
    study, keys = source.study, source.study.keys_shown
    rows = source.rows(["draw_id", "start_s", *keys, *_HEADERS]).to_pylist()
    columns = [name for name in _HEADERS if any(row[name] is not None for row in rows)]
    if study.n_variants > 1:
        name, rows = "variant", rows[-study.n_variants :]
        names = [describe_point({key: row[key] for key in keys}) for row in rows]
    else:
        name, key = ("start (s)", "start_s") if study.is_recorded else ("draw", "draw_id")
        names = [format_value(row[key]) for row in rows]
    cells = ([format_number(row[c], _HEADERS[c][1]) for c in columns] for row in rows)
    lines = [[name, *line] for name, line in zip(names, cells, strict=True)]
    return Table("Attitude at the end", [name, *(_HEADERS[c][0] for c in columns)], lines)


def final_attitude_and_sigma_table(source: Results) -> Table:
    """Return the table of the final attitudes, run by run, with the filter's own 1 sigma."""
    keys, variants = ["start_s", *source.study.keys_shown], source.study.n_variants
    cells = [
        [format_value(row[key]) for key in keys]
        + [format_number(row[name], digits) for name, digits in _DIGITS.items()]
        for row in source.rows([*keys, *_DIGITS]).to_pylist()
    ]
    title = "Attitude at the end, with the filter's own 1 sigma"
    whole_starts = MAX_ROWS // variants * variants or MAX_ROWS
    return Table(title, [*keys, *_DIGITS], cells).shortened(whole_starts)

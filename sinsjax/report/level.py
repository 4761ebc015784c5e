"""The verdict on a study whose methods find no heading: the pitch and roll of its runs."""

from collections.abc import Iterator

import numpy as np

from sinsjax import analysis
from sinsjax.analysis.formats import format_heading_error
from sinsjax.execution.results import Results
from sinsjax.report.base import Fact, Report, Table, build_table
from sinsjax.report.verdict import study_title

_ANGLES = {"pitch_deg": 3, "roll_deg": 3}
_SIGMAS = {"sigma_e_arcmin": 1, "sigma_n_arcmin": 1}
_ERRORS = ("phi_e_arcmin", "phi_n_arcmin")


def level_verdict(source: Results, *, warnings_shown: bool = False) -> Report:
    """Return the pitch and roll at the end, their error if a truth is known, and all warnings.

    Args:
        source: results of methods that find no heading.
        warnings_shown: whether the user has seen the study's warnings.
    """
    facts = [
        _attitude_fact(source),
        *_accuracy_fact(source),
        Fact("Heading", f"none: {' and '.join(source.study.methods)} finds pitch and roll alone"),
    ]
    doubts = (Fact("Warning", line, True) for line in (() if warnings_shown else source.warnings))
    table = _final_level_table(source) if source.runs > 1 else None
    return Report(study_title(source), [*facts, *doubts], table)


def _attitude_fact(source: Results) -> Fact:
    """The pitch and roll that the last run ends with."""
    names = [*_ANGLES, *_SIGMAS]
    row = source.rows(["start_s", *names]).to_pylist()[-1]
    pitch, roll, *sigmas = (row[name] for name in names)
    if pitch is None or roll is None:
        return Fact("Attitude", "unknown, the run is not finite", True)
    text = f"pitch {pitch:.3f}, roll {roll:.3f} deg"
    if None not in sigmas:
        biases = max(source.study.values("level_accel_bias_ug"))
        text += f" (1 sigma {max(sigmas):.1f}', with accelerometer biases of {biases:,g} ug)"
    if source.runs > 1:
        start_s = row["start_s"]
        text += f" (start at {start_s:g} s)" if source.study.is_recorded else " (last draw)"
    return Fact("Attitude", text)


def _accuracy_fact(source: Results) -> Iterator[Fact]:
    """The error of pitch and roll from the truth or reference, if there is one."""
    table = source.distinct_rows(["draw_id", "start_s", *_ERRORS])
    errors = np.concatenate([analysis.numeric_column(table, name) for name in _ERRORS])
    if np.isfinite(errors).any():
        draws = analysis.numeric_column(table, "draw_id").astype(int)
        clusters = np.zeros_like(draws) if source.study.is_recorded else draws
        found = analysis.rms(errors, np.tile(clusters, len(_ERRORS)))
        aim = "reference" if source.study.is_recorded else "truth"
        yield Fact("Accuracy", f"{format_heading_error(found)}' rms from the {aim} per angle")


def _final_level_table(source: Results) -> Table:
    """The pitch and roll at the end of each run."""
    keys = ["start_s" if source.study.is_recorded else "draw_id", *source.study.keys_shown]
    digits = _ANGLES | _SIGMAS
    rows = source.rows([*dict.fromkeys([*keys, *digits])]).to_pylist()
    cells = [
        (name, lambda row, n=name: analysis.format_number(row[n], digits[n])) for name in digits
    ]
    return build_table("Level at the end", keys, rows, cells)

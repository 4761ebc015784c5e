"""A study for a record without a description: ``sinsjax init record --from log.csv``.

What names or gravity determine has its reason as a comment. The rest is ``"?"``, with the evidence
above it: the study runs once it is answered.
"""

import json
import math
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError, create_model

from sinsjax.errors import InputError
from sinsjax.messages import CONTROL, escape_controls, explain_error, suggest_closest
from sinsjax.records import read_record
from sinsjax.records.checks import (
    ACCEL_BIAS_UG,
    EARTH_RATE,
    StationaryValues,
    check_stationary,
    measure_motion,
    report_anomalies,
    white_noise,
)
from sinsjax.records.layout import Record, RecordLayout, find_spans
from sinsjax.records.propose import Proposal, propose_layout
from sinsjax.records.reader import open_log
from sinsjax.study.files import DOUBT, OPEN, QUESTION, schema_line
from sinsjax.study.keys import SECTIONS
from sinsjax.units import DEG, DEG_PER_SQRT_H, STANDARD_GRAVITY, micro_g
from sinsjax.value_types import Section

_LONGEST_S, _COARSE_S, _SHORTEST_S = 3600.0, 10.0, 10.0
_RATE_TOLERANCE = 1e-4  # relative deviation of clocks from the nominal rate
_OTHER_ANSWERS = ("study.rate_hz", "earth.latitude_deg", "record.gyro_bias_deg_per_h")
_WIDTH = 100
_UNKNOWN_LENGTH = (
    "the length is unknown, and nothing is checked: with answers about columns and time, `sinsjax"
    " init record --from LOG --set KEY=VALUE` examines the rest"
)
_LATITUDE = "the latitude of the place in degrees, negative in the south"
_HEAD = """{schema}
# Alignment of {log}, written by `sinsjax init record`.
# Put an answer in place of each ? (QUESTION), and check what a DOUBT says.
#
#   sinsjax validate {study}
#   sinsjax align {log} {study} -o out"""


def make_study_text(
    record_path: Path, study_path: Path, answers: Mapping[str, Any] | None = None
) -> str:
    """Return the text of a study that aligns a record, with reasons, doubts and open questions.

    Args:
        record_path: delimited text or Parquet.
        study_path: file of the study.
        answers: values by ``section.key``, which are taken as given.

    Raises:
        InputError: the file cannot contain a record, or an answer does not fit it.
    """
    given = _check_answers(answers or {})
    table = open_log(record_path, given.get("columns", ()), given.get("skip_rows", 0))
    proposal = propose_layout(table, given)
    layout, questions = proposal.layout, proposal.questions
    settings: dict[str, Any] = {"name": escape_controls(record_path.stem), "duration_s": 60.0}
    earth = {"earth": "wgs84", "latitude_deg": given.get("latitude_deg")}
    described = {
        key: value
        for key, value in layout._asdict().items()
        if key in questions
        or value != RecordLayout._field_defaults.get(key)
        or key in ("gyro_unit", "accel_unit")
    }
    described.pop("rate_hz", None)
    sections: dict[str, dict[str, Any]] = {"study": settings, "earth": earth, "record": described}
    sections |= {"coarse": {}, "alignment": {"method": "inertial"}}
    if not questions.keys() & {"gyro_columns", "accel_columns", "rate_hz", "time_unit"}:
        record = read_record(record_path, layout)
        doubts = _add_what_samples_show(
            sections, record, proposal, given.get("gyro_bias_deg_per_h")
        )
    else:
        doubts = [_UNKNOWN_LENGTH]
        if layout.rate_hz or "rate_hz" in questions:  # else the stamps will give it
            settings["rate_hz"] = layout.rate_hz
    if earth["latitude_deg"] is None:
        questions.setdefault("latitude_deg", _LATITUDE)
    log, study = (escape_controls(path.name) for path in (record_path, study_path))
    lines = [_HEAD.format(schema=schema_line(), log=log, study=study)]
    for title, keys in sections.items():
        if not keys:
            continue
        lines += ["", f"[{title}]"]
        for key, value in keys.items():
            lines += _format_key(key, value, proposal.reasons.get(key, ""), questions.get(key, ""))
        if title == "record":
            lines += [_wrap_comment(doubt, DOUBT) for doubt in doubts]
    return "\n".join([*lines, ""])


def _check_answers(answers: Mapping[str, Any]) -> dict[str, Any]:
    """Return valid answers about a record by key; refuses others."""
    known = [f"record.{key}" for key in RecordLayout._fields if key not in ("format", "rate_hz")]
    checked: dict[str, Any] = {}
    for place, value in answers.items():
        if place not in (*known, *_OTHER_ANSWERS):
            text = "not examined by `init record --from` (give it to `sinsjax align`)"
            raise InputError(f"--set {place}: {text}{suggest_closest(place, known)}")
        section, _, key = place.partition(".")
        field: Any = SECTIONS[section].model_fields[key]
        definition: dict[str, Any] = {key: (field.annotation, field)}
        model = create_model("Answer", __base__=Section, **definition)
        try:
            answer = model.model_validate({key: tuple(value) if isinstance(value, list) else value})
        except ValidationError as error:
            raise InputError(f"--set {place}: {explain_error(error.errors()[0])}") from None
        checked[key] = getattr(answer, key)
        if key in ("gyro_scale", "accel_scale") and not isinstance(checked[key], tuple):
            checked[key] = (checked[key],) * 3
    return checked


def _set_times_of_longest_gapless_part(
    study: dict[str, Any], keys: dict[str, Any], coarse: dict[str, Any], record: Record
) -> None:
    """Set the times at which the longest part without a gap is aligned."""
    rate = float(round(record.rate_hz)) or record.rate_hz  # nominal
    rate = rate if abs(record.rate_hz / rate - 1) <= _RATE_TOLERANCE else record.rate_hz
    interval_s = max(1, round(rate)) / rate
    parts = find_spans(np.isfinite(record.dv[:, 0]))
    begin, end = max(parts, key=lambda part: part[1] - part[0])
    start_s = float(math.ceil(begin / rate))
    intervals = math.floor((end / rate - start_s) / interval_s + 1e-6)
    if intervals < 2 or intervals * interval_s < _SHORTEST_S:
        text = f"has only {intervals * interval_s:.3g} s without a gap; an alignment needs"
        hint = "--set record.max_gap_s=0.1 fills gaps of 0.1 s"
        raise InputError(f"{record.source}: {text} {_SHORTEST_S:g} s ({hint})")
    n_coarse = min(round(_COARSE_S / interval_s), intervals // 4)
    # A reference usually ends a little earlier than its record.
    n_fine = min(intervals - n_coarse - 1, round(_LONGEST_S / interval_s))
    coarse_s, fine_s = (float(f"{count * interval_s:.12g}") for count in (n_coarse, n_fine))
    study |= {"duration_s": fine_s, "rate_hz": rate}
    study |= {"record_interval_s": interval_s, "settle_bands_arcmin": [60, 10]}
    keys["start_s"] = [start_s]
    coarse |= {"coarse_method": "inertial", "coarse_duration_s": coarse_s}


def _add_what_samples_show(
    sections: dict[str, dict[str, Any]], record: Record, proposal: Proposal, bias: float | None
) -> list[str]:
    """Add what the samples of a record show to the sections of its study; return the doubts."""
    study, earth, keys, coarse, alignment = sections.values()
    _set_times_of_longest_gapless_part(study, keys, coarse, record)
    begin = round(keys["start_s"][0] * record.rate_hz)
    length = round((coarse["coarse_duration_s"] + study["duration_s"]) * study["rate_hz"])
    span = (begin, min(begin + length, len(record.dv)))
    proposal.reasons["duration_s"] = f"s; the file has {len(record.dv) / record.rate_hz:.4g} s"
    proposal.reasons["rate_hz"] = f"Hz; that of the stamps is {record.rate_hz:.6g}"
    if bias is not None:
        keys["gyro_bias_deg_per_h"] = bias
    motion = measure_motion(record, span, STANDARD_GRAVITY)
    given = earth["latitude_deg"]
    latitude = motion.latitude if given is None else given * DEG
    findings = report_anomalies(record.anomalies, [span])
    is_known = not proposal.questions.keys() & {"gyro_unit", "accel_unit", "axes_order"}
    if is_known and not any(finding.is_certain for finding in findings):
        expected = StationaryValues(EARTH_RATE, latitude, STANDARD_GRAVITY, bias)
        findings += check_stationary(record, span, expected)
    if any(finding.hides_north for finding in findings):
        alignment["method"] = "level"
    elif is_known and motion.is_turned:
        alignment["method"] = "gravity_fit"
        proposal.questions["fit_gyro_bias_deg_per_h"] = "the largest bias, as in the data sheet"
        gyro_noise, accel_noise = (
            white_noise(rows[slice(*span)], record.rate_hz) for rows in (record.dtheta, record.dv)
        )
        sections["gravity_fit"] = {
            "fit_gyro_bias_deg_per_h": OPEN,
            "fit_gyro_arw_deg_per_sqrt_h": float(f"{gyro_noise / DEG_PER_SQRT_H:.2g}"),
            "fit_accel_bias_ug": ACCEL_BIAS_UG,
            "fit_accel_vrw_ug_per_sqrt_hz": float(f"{accel_noise / micro_g():.2g}"),
        }
    elif is_known and not findings:
        proposal.questions["latitude_deg"] = (
            f"{_LATITUDE} (the gyros give {motion.latitude / DEG:.1f}; their mean rate is"
            f" {motion.magnitude / EARTH_RATE:.3g} times Earth rate)"
        )
    doubts = [*(flaw.text for flaw in record.flaws[:1]), *record.remarks]
    for finding in findings:
        is_refused = finding.is_certain and not finding.hides_north
        doubts.append(f"{finding.text}{' (the study is refused)' if is_refused else ''}")
    return doubts


def _format_key(key: str, value: Any, reason: str, question: str) -> Iterator[str]:
    """Yield the lines of a key: its question above it, or its reason."""
    if question and (value is None or key != "latitude_deg"):
        yield _wrap_comment(question, QUESTION)
        yield f'{key} = "{OPEN}"'
        return
    line = f"{key} = {json.dumps(value, ensure_ascii=CONTROL.search(str(value)) is not None)}"
    yield f"{line:<33} # {escape_controls(reason)}" if reason else line


def _wrap_comment(text: str, prefix: str = "# ") -> str:
    """Return a comment, wrapped to lines."""
    text = escape_controls(text)
    return textwrap.fill(
        text, _WIDTH, initial_indent=prefix, subsequent_indent="#   ", break_long_words=False
    )

"""A study for a record without a description: ``sinsjax init record --from log.csv``.

Every key has a comment with its reason. What neither names nor gravity tell is ``"?"``, with the
evidence above it: the study runs once it is answered.
"""

import json
import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from pydantic import ValidationError, create_model

from sinsjax.errors import InputError
from sinsjax.messages import CONTROL, escape_controls, explain_error, suggest_closest
from sinsjax.records import read_psins, read_record
from sinsjax.records.checks import (
    ACCEL_BIAS_UG,
    GYRO_BIAS,
    StationaryValues,
    check_stationary,
    finds_north_by_turns,
    report_anomalies,
)
from sinsjax.records.layout import PSINS_LAYOUT, Record, RecordLayout
from sinsjax.records.motion import EARTH_RATE, compute_means, white_noise
from sinsjax.records.propose import Proposal, propose_layout
from sinsjax.records.psins import is_psins
from sinsjax.records.reader import open_log
from sinsjax.study.files import DOUBT, OPEN, QUESTION, schema_line
from sinsjax.study.keys import SECTIONS
from sinsjax.units import DEG, DEG_PER_H, DEG_PER_SQRT_H, STANDARD_GRAVITY, micro_g
from sinsjax.value_types import Section

_SHORT_GAP_S = 0.1
"""Longest gap that is interpolated by default: a base at rest hardly moves in this time."""

_LONGEST_S, _LONGEST_PARKED_S, _COARSE_S, _SHORTEST_S = 3600.0, 900.0, 10.0, 10.0
_RATE_TOLERANCE = 1e-4  # relative deviation of clocks from the nominal rate
_OTHER_ANSWERS = ("study.rate_hz", "earth.latitude_deg", "record.gyro_bias_deg_per_h")
_WIDTH = 100
_ALWAYS_WRITTEN = ("axes_order", "gyro_unit", "accel_unit", "time_unit")
_REASONS = {
    "record_interval_s": "s, between recorded values",
    "settle_bands_arcmin": "arcmin, heading error bands",
    "start_s": "s, start of coarse alignment; may be a list",
    "coarse_method": "survives sway",
    "coarse_duration_s": "s; its end is t = 0 of the alignment",
    "fit_gyro_bias_deg_per_h": "largest usual biases: put those of the data sheet",
    "fit_gyro_arw_deg_per_sqrt_h": "scatter of the samples",
}
_METHODS = {
    "inertial": "needs no data sheet; 'kalman_sincos' has a covariance",
    "gravity_fit": "the turns separate the sensor biases from the heading",
    "level": "pitch and roll only: the gyros cannot find north",
}
_UNKNOWN_LENGTH = (
    "the length is unknown, and nothing is checked: with answers about columns and time, `sinsjax"
    " init record --from LOG --set KEY=VALUE` examines the rest"
)
_LATITUDE = "the latitude of the place in degrees, negative in the south"


class _Part(NamedTuple):
    """The part of a record that is aligned, in whole record intervals."""

    rate_hz: float  # nominal
    interval_s: float  # a whole number of samples
    start_s: float  # of coarse alignment
    coarse_s: float
    fine_s: float  # length of the alignment after it

    def span(self, record: Record) -> tuple[int, int]:
        """Return the first sample that the study reads, and the one after the last."""
        begin = round(self.start_s * record.rate_hz)
        end = begin + round((self.coarse_s + self.fine_s) * self.rate_hz)
        return begin, min(end, len(record.dv))


class _Examination(NamedTuple):
    """What the samples of a record show."""

    method: str = "inertial"  # that aligns the record
    fit: Mapping[str, float] = MappingProxyType({})  # keys of [gravity_fit], if that is the method
    doubts: Sequence[str] = ()
    evidence: str = ""  # what its gyros show of the latitude, in brackets after a blank


def make_study_text(
    record_path: Path, study_path: Path, answers: Mapping[str, Any] | None = None
) -> str:
    """Return the text of a study that aligns a record, with reasons, doubts and open questions.

    Args:
        record_path: delimited text, Parquet, or PSINS text.
        study_path: file of the study.
        answers: values by ``section.key``, which are taken as given.

    Raises:
        InputError: the file cannot contain a record, or an answer does not fit it.
    """
    given = _check_answers(answers or {})
    proposal, record = _read_log(record_path, given)
    layout, questions, reasons = proposal.layout, proposal.questions, _REASONS | proposal.reasons
    section = {
        key: value for key, value in layout._asdict().items()
        if value != RecordLayout._field_defaults.get(key) or key in questions
        or key in _ALWAYS_WRITTEN[: 1 if layout.format == "psins" else 4]
    }  # fmt: skip
    section.pop("rate_hz", None)
    if not layout.time_column:
        section.pop("time_unit", None)
    settings: dict[str, Any] = {"name": escape_controls(record_path.stem), "duration_s": 60.0}
    earth = {"earth": "wgs84", "latitude_deg": given.get("latitude_deg")}
    sections: dict[str, dict[str, Any]] = {"study": settings, "earth": earth, "record": section}
    if record is None:
        found = _Examination(doubts=[_UNKNOWN_LENGTH])
        if layout.rate_hz or "rate_hz" in questions:  # else the stamps will give it
            settings["rate_hz"] = layout.rate_hz
        settings["record_interval_s"] = 1.0
    else:
        part = _longest_part(record_path, record)
        if part.fine_s > _LONGEST_PARKED_S:
            means = compute_means(record, part.span(record), STANDARD_GRAVITY)
            longest_s = round(_LONGEST_PARKED_S / part.interval_s) * part.interval_s
            part = part if means.turns else part._replace(fine_s=longest_s)
        found = _examine(record, proposal, part, given)
        reasons["duration_s"] = f"s; the file has {len(record.dv) / part.rate_hz:.4g} s"
        reasons["rate_hz"] = f"Hz; that of the stamps is {record.rate_hz:.6g}"
        settings |= {"duration_s": part.fine_s, "rate_hz": part.rate_hz}
        settings["record_interval_s"] = part.interval_s
        section["start_s"] = [part.start_s]
        section |= {k: given[k] for k in ("gyro_bias_deg_per_h",) if k in given}
        sections["coarse"] = {"coarse_method": "inertial", "coarse_duration_s": part.coarse_s}
        if record.latitude_deg is not None and earth["latitude_deg"] is None:
            del earth["latitude_deg"]  # the header gives the place
    if earth.get("latitude_deg", 0.0) is None:
        questions["latitude_deg"] = _LATITUDE + found.evidence
    settings["settle_bands_arcmin"] = [60, 10]
    sections["alignment"] = {"method": found.method}
    if found.fit:
        sections["gravity_fit"] = {**found.fit}
    reasons["method"] = _METHODS[found.method]
    log, name = escape_controls(record_path.name), escape_controls(study_path.name)
    lines = [
        schema_line(),
        f"# Alignment of {log}, written by `sinsjax init record`.",
        "# Put an answer in place of each ? (QUESTION), and check what a DOUBT says.",
        "#",
        f"#   sinsjax validate {name}",
        f"#   sinsjax align {log} {name} -o out",
        "#",
        "# With --reference FILE the result is compared; its columns: the page own_record.",
    ]
    for title, keys in sections.items():
        lines += ["", f"[{title}]"]
        for key, value in keys.items():
            lines += _format_key(key, value, reasons.get(key, ""), questions.get(key, ""))
        if title == "record":
            lines += [_wrap_comment(doubt, DOUBT) for doubt in found.doubts]
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


def _read_log(path: Path, answers: Mapping[str, Any]) -> tuple[Proposal, Record | None]:
    """Return what is known of a log, and its record unless its columns or its clock are open."""
    table = open_log(path, answers.get("columns", ()), answers.get("skip_rows", 0))
    if table.format == "csv" and "columns" not in answers and is_psins(path):
        return Proposal(PSINS_LAYOUT), read_psins(path)
    proposal = propose_layout(table, answers)
    layout = proposal.layout
    for name in (*layout.time_columns, *layout.gyro_columns, *layout.accel_columns):
        if CONTROL.search(name):
            raise InputError(f"{path}: column {name!r}: control characters in its name (rename it)")
    if proposal.questions.keys() & {"gyro_columns", "accel_columns", "rate_hz", "time_unit"}:
        return proposal, None
    record = read_record(path, layout)
    gaps = [(flaw.end - flaw.begin + 1) / record.rate_hz for flaw in record.flaws]
    if short := [gap for gap in gaps if gap <= _SHORT_GAP_S]:
        proposal.layout = layout._replace(max_gap_s=math.ceil(max(short) * 1e3) / 1e3)
        record = read_record(path, proposal.layout)
        reason = f"fills {record.filled} samples: leave it out if the base moves meanwhile"
        proposal.reasons["max_gap_s"] = reason
    return proposal, record


def _longest_part(path: Path, record: Record) -> _Part:
    """Return the part of a record that can be aligned, the longest one without a gap."""
    rate = record.rate_hz
    nominal = float(round(rate)) if round(rate) else rate
    rate = nominal if abs(rate / nominal - 1) <= _RATE_TOLERANCE else rate
    interval_s = max(1, round(rate)) / rate
    ends = [0, *(n for flaw in record.flaws for n in (flaw.begin, flaw.end)), len(record.dv)]
    parts = list(zip(ends[::2], ends[1::2], strict=True))
    begin, end = max(parts, key=lambda part: part[1] - part[0])
    start_s = float(math.ceil(begin / rate))
    intervals = math.floor(((end / rate) - start_s) / interval_s + 1e-6)
    if intervals < 2 or intervals * interval_s < _SHORTEST_S:
        raise InputError(
            f"{path}: has only {intervals * interval_s:.3g} s without a gap (an alignment needs"
            f" {_SHORTEST_S:g} s)"
        )
    coarse = min(round(_COARSE_S / interval_s), intervals // 4)
    # A reference usually ends a little earlier than its record.
    fine = min(intervals - coarse - 1, round(_LONGEST_S / interval_s))
    coarse_s, fine_s = (float(f"{count * interval_s:.12g}") for count in (coarse, fine))
    return _Part(rate, interval_s, start_s, coarse_s, fine_s)


def _examine(
    record: Record, proposal: Proposal, part: _Part, given: Mapping[str, Any]
) -> _Examination:
    """Check a part of a record, if its units and axes are known, and choose a method."""
    open_keys = {"gyro_unit", "gyro_scale", "accel_scale", "axes_order"}
    is_known = not proposal.questions.keys() & open_keys
    span = part.span(record)
    means = compute_means(record, span, STANDARD_GRAVITY)
    turns, latitude_deg = means.turns, given.get("latitude_deg", record.latitude_deg)
    latitude = math.acos(min(1.0, turns.drift / EARTH_RATE)) if turns else means.latitude
    expected = StationaryValues(
        earth_rate=EARTH_RATE,
        latitude=latitude if latitude_deg is None else latitude_deg * DEG,
        gravity=STANDARD_GRAVITY,
        gyro_bias_deg_per_h=given.get("gyro_bias_deg_per_h"),
    )
    findings = report_anomalies(record.anomalies, [span])
    if is_known and not any(finding.is_certain for finding in findings):
        findings += check_stationary(record, span, proposal.layout, expected)
    method, fit, evidence = "inertial", dict[str, float](), ""
    if any(finding.hides_north for finding in findings):
        method = "level"
    elif turns and is_known and finds_north_by_turns(means, expected):
        # The prior of the gyro bias is the usual one, or twice what the turns show.
        gyro_bias = math.ceil(max(GYRO_BIAS, 2 * turns.gyro_bias) / DEG_PER_H)
        gyro_noise, accel_noise = (
            white_noise(rows[slice(*span)], record.rate_hz) for rows in (record.dtheta, record.dv)
        )
        method = "gravity_fit"
        fit = {
            "fit_gyro_bias_deg_per_h": gyro_bias,
            "fit_gyro_arw_deg_per_sqrt_h": float(f"{gyro_noise / DEG_PER_SQRT_H:.2g}"),
            "fit_accel_bias_ug": ACCEL_BIAS_UG,
            "fit_accel_vrw_ug_per_sqrt_hz": float(f"{accel_noise / micro_g():.2g}"),
        }
    elif is_known and not findings and not turns:
        evidence = f" (the gyros give {means.latitude / DEG:.1f}; their mean rate is"
        evidence += f" {means.magnitude / EARTH_RATE:.3g} times Earth rate)"
    doubts = [*(flaw.text for flaw in record.flaws[:1]), *record.remarks]
    for finding in findings:
        is_refused = finding.is_certain and not finding.hides_north
        doubts.append(f"{finding.text}{' (the study is refused)' if is_refused else ''}")
    return _Examination(method, fit, doubts, evidence)


def _format_key(key: str, value: Any, reason: str, question: str) -> Iterator[str]:
    """Yield the lines of a key: its question above it, or its reason beside or above it."""
    if question:
        yield _wrap_comment(question, QUESTION)
        value = OPEN
    line = f"{key} = {json.dumps(value, ensure_ascii=False)}"
    one_line = f"{line:<33} # {reason}"
    if question or not reason:
        yield line
    elif len(one_line) <= _WIDTH:
        yield one_line
    else:
        yield _wrap_comment(reason)
        yield line


def _wrap_comment(text: str, prefix: str = "# ") -> str:
    """Return a comment, wrapped to lines."""
    text = escape_controls(text)
    return textwrap.fill(
        text, _WIDTH, initial_indent=prefix, subsequent_indent="#   ", break_long_words=False
    )

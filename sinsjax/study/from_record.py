"""A study for a record without a description: ``sinsjax init record --from log.csv``.

Every key has a comment with its reason. What neither names nor gravity tell is ``"?"``, with the
evidence above it: the study runs once it is answered.
"""

import json
import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError, create_model

from sinsjax.errors import InputError
from sinsjax.messages import CONTROL, escape_controls, explain_error, suggest_closest
from sinsjax.records import read_psins, read_record
from sinsjax.records.checks import (
    ACCEL_BIAS_UG,
    GYRO_BIAS,
    Finding,
    StationaryValues,
    check_stationary,
    finds_north_by_turns,
    report_anomalies,
)
from sinsjax.records.layout import PSINS_LAYOUT, Anomaly, Note, Record, RecordLayout
from sinsjax.records.motion import EARTH_RATE, Means, compute_means, white_noise
from sinsjax.records.propose import propose_layout
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
_NO_NOTE = Note("")
_NO_LENGTH = (
    "the length is unknown, and nothing is checked: with answers about columns and time, `sinsjax"
    " init record --from LOG --set KEY=VALUE` examines the rest"
)
_ALIGNMENT = """\
# for a covariance: "kalman_sincos" with the noise of the sensors in [filter] (sinsjax keys filter)
[alignment]
method = "inertial"               # needs no numbers of the sensors
"""
_TURNING = """\
[alignment]
method = "gravity_fit"            # the turns separate the sensor biases from the heading

# Scatter of the samples, and the largest usual biases: put those of the data sheet here.
[gravity_fit]
fit_gyro_bias_deg_per_h = {gyro_bias:g}
fit_gyro_arw_deg_per_sqrt_h = {gyro_noise:.2g}
fit_accel_bias_ug = {accel_bias:g}
fit_accel_vrw_ug_per_sqrt_hz = {accel_noise:.2g}
"""
_ALWAYS_WRITTEN = {"gyro_unit", "accel_unit", "axes_order", "time_unit"}
_LEVELLING = """\
[alignment]
method = "level"                  # pitch and roll only: the gyros cannot find north
"""


class _ProposedFile(NamedTuple):
    """A file with its proposed layout.

    Attributes:
        layout: layout of the record in the file; open keys have values to read it with.
        notes: reasons, doubts and questions by key of [record], and of rate_hz.
        record: record that is read with the layout; None if columns or clock are open.
        kind: description of the kind of file.
    """

    layout: RecordLayout
    notes: Mapping[str, Note]
    record: Record | None
    kind: str

    def is_open(self, *keys: str) -> bool:
        """Return whether one of some keys is an open question."""
        return any(self.notes.get(key, _NO_NOTE).question for key in keys)


class _AlignedPart(NamedTuple):
    """The part of a record that is aligned.

    Attributes:
        rate_hz: nominal rate, Hz.
        interval_s: record interval, a whole number of samples, s.
        start_s: start of coarse alignment, s.
        coarse_s: length of coarse alignment, s.
        fine_s: length of the alignment after it, s.
    """

    rate_hz: float
    interval_s: float
    start_s: float
    coarse_s: float
    fine_s: float


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
    is_text = is_psins(record_path) and "columns" not in given
    proposed = _propose_psins(record_path) if is_text else _propose_table(record_path, given)
    latitude, gyro_bias = given.pop("latitude_deg", None), given.pop("gyro_bias_deg_per_h", None)
    record = proposed.record
    if record is None:
        sections = [
            _title_section(record_path, study_path),
            _study_section(record_path, proposed, None, _NO_NOTE),
            _earth_section(proposed, None, latitude),
            _record_section(proposed, None, (), None),
            _ALIGNMENT,
        ]
        return "\n".join(sections)
    part, part_note = _longest_part(record_path, record)
    span = _sample_range(record, part)
    means = compute_means(record, span, STANDARD_GRAVITY)
    if means.turns is None and part.fine_s > _LONGEST_PARKED_S:
        part = part._replace(fine_s=round(_LONGEST_PARKED_S / part.interval_s) * part.interval_s)
        span = _sample_range(record, part)
        means = compute_means(record, span, STANDARD_GRAVITY)
    is_known = not proposed.is_open("gyro_unit", "gyro_scale", "accel_scale", "axes_order")
    expected = _expected_values(means, latitude, record.latitude_deg, gyro_bias)
    findings: list[Anomaly | Finding] = [*report_anomalies(record.anomalies, [span])]
    if is_known and not any(finding.is_certain for finding in findings):
        findings += check_stationary(record, span, proposed.layout, expected)
    alignment = _ALIGNMENT
    if any(getattr(finding, "hides_north", False) for finding in findings):
        alignment = _LEVELLING
    elif is_known and finds_north_by_turns(means, expected):
        alignment = _turning_section(record, span, means)
    sections = [
        _title_section(record_path, study_path),
        _study_section(record_path, proposed, part, part_note),
        _earth_section(proposed, means if is_known and not findings else None, latitude),
        _record_section(proposed, part, findings, gyro_bias),
        _coarse_section(part),
        alignment,
    ]
    return "\n".join(sections)


def _turning_section(record: Record, span: tuple[int, int], means: Means) -> str:
    """Return the [alignment] of a base that is turned, with the section of its method.

    The prior of the gyro bias is the usual one, or twice what the turns show.
    """
    turns, samples = means.turns, slice(*span)
    assert turns is not None
    gyro_noise, accel_noise = (
        white_noise(rows[samples], record.rate_hz) for rows in (record.dtheta, record.dv)
    )
    return _TURNING.format(
        gyro_bias=math.ceil(max(GYRO_BIAS, 2 * turns.gyro_bias) / DEG_PER_H),
        accel_bias=ACCEL_BIAS_UG,
        gyro_noise=gyro_noise / DEG_PER_SQRT_H,
        accel_noise=accel_noise / micro_g(),
    )


def _expected_values(
    means: Means, latitude_deg: float | None, header_deg: float | None, gyro_bias: float | None
) -> StationaryValues:
    """Return the measurements to expect; an unknown latitude is that of the measurements."""
    known_deg = latitude_deg if latitude_deg is not None else header_deg
    latitude = means.latitude
    if means.turns is not None:
        latitude = math.acos(min(1.0, means.turns.drift / EARTH_RATE))
    return StationaryValues.with_biases(
        earth_rate=EARTH_RATE,
        latitude=latitude if known_deg is None else known_deg * DEG,
        gravity=STANDARD_GRAVITY,
        gyro_bias_deg_per_h=gyro_bias,
    )


def _check_answers(answers: Mapping[str, Any]) -> dict[str, Any]:
    """Return valid answers about a record by key; refuses others."""
    known = [f"record.{key}" for key in RecordLayout._fields if key not in ("format", "rate_hz")]
    fields: dict[str, Any] = {}
    for place in answers:
        if place not in (*known, *_OTHER_ANSWERS):
            text = "not examined by `init record --from` (give it to `sinsjax align`)"
            raise InputError(f"--set {place}: {text}{suggest_closest(place, known)}")
        section, _, key = place.partition(".")
        field = SECTIONS[section].model_fields[key]
        fields[key] = (field.annotation, field)
    keys = {place.rpartition(".")[2]: place for place in answers}
    model = create_model("Answers", __base__=Section, **fields)
    try:
        content = model.model_validate(
            {
                key: tuple(value) if isinstance(value := answers[place], list) else value
                for key, place in keys.items()
            }
        )
    except ValidationError as error:
        found = error.errors()[0]
        place = keys.get(str(found["loc"][0]) if found["loc"] else "", "")
        raise InputError(f"--set {place}: {explain_error(found)}") from None
    checked = {key: getattr(content, key) for key in keys}
    for key in {"gyro_scale", "accel_scale"} & checked.keys():
        if not isinstance(checked[key], tuple):
            checked[key] = (checked[key],) * 3
    return checked


def _propose_psins(path: Path) -> _ProposedFile:
    note = Note("right, front and up, as in PSINS")
    return _ProposedFile(PSINS_LAYOUT, {"axes_order": note}, read_psins(path), "PSINS text")


def _propose_table(path: Path, answers: Mapping[str, Any]) -> _ProposedFile:
    table = open_log(path, answers.get("columns", ()), answers.get("skip_rows", 0))
    found = propose_layout(path, table, answers)
    layout, notes = found.layout, dict(found.notes)
    kind = f"{'Parquet' if table.format == 'parquet' else 'Text'} with {len(table.names)} columns"
    for name in (*layout.time_columns, *layout.gyro_columns, *layout.accel_columns):
        if CONTROL.search(name):
            raise InputError(f"{path}: column {name!r}: control characters in its name (rename it)")
    if not found.is_readable:
        return _ProposedFile(layout, notes, None, kind)
    record = read_record(path, layout)
    gaps = [(flaw.end - flaw.begin + 1) / record.rate_hz for flaw in record.flaws]
    short = [gap for gap in gaps if gap <= _SHORT_GAP_S]
    if short:
        layout = layout._replace(max_gap_s=math.ceil(max(short) * 1e3) / 1e3)
        record = read_record(path, layout)
        doubt = "if the base moves in these gaps, leave this out: the study then refuses them"
        notes["max_gap_s"] = Note(f"{record.filled} samples in {len(short)} gaps", doubt)
    return _ProposedFile(layout, notes, record, kind)


def _longest_part(path: Path, record: Record) -> tuple[_AlignedPart, Note]:
    """Return the part of a record that can be aligned, the longest one without a gap."""
    rate = record.rate_hz
    nominal = float(round(rate)) if round(rate) else rate
    rate = nominal if abs(rate / nominal - 1) <= _RATE_TOLERANCE else rate
    interval_s = max(1, round(rate)) / rate
    ends = [0, *(n for flaw in record.flaws for n in (flaw.begin, flaw.end)), len(record.dv)]
    parts = list(zip(ends[::2], ends[1::2], strict=True))
    begin, end = max(parts, key=lambda part: part[1] - part[0])
    start_s = math.ceil(begin / rate)
    intervals = math.floor(((end / rate) - start_s) / interval_s + 1e-6)
    if intervals < 2 or intervals * interval_s < _SHORTEST_S:
        raise InputError(
            f"{path}: has only {intervals * interval_s:.3g} s without a gap (an alignment needs"
            f" {_SHORTEST_S:g} s)"
        )
    coarse = min(round(_COARSE_S / interval_s), intervals // 4)
    # A reference usually ends a little earlier than its record.
    fine = min(intervals - coarse - 1, round(_LONGEST_S / interval_s))
    note = Note(f"of {len(record.dv) / rate:.4g} s in the file")
    if record.flaws:
        longest = f"{begin / rate:.4g} to {end / rate:.4g} s is the longest part without a gap"
        note = Note(f"{note.reason}, of which {longest}", record.flaws[0].text)
    return _AlignedPart(
        rate,
        interval_s,
        float(start_s),
        *(float(f"{count * interval_s:.12g}") for count in (coarse, fine)),
    ), note


def _sample_range(record: Record, part: _AlignedPart) -> tuple[int, int]:
    """Return the first sample that the study reads, and the one after the last."""
    begin = round(part.start_s * record.rate_hz)
    end = begin + round((part.coarse_s + part.fine_s) * part.rate_hz)
    return begin, min(end, len(record.dv))


def _title_section(record_path: Path, study_path: Path) -> str:
    log, name = escape_controls(record_path.name), escape_controls(study_path.name)
    purpose = f"Alignment of {log}, written by `sinsjax init record`."
    advice = "Put an answer in place of each ? (QUESTION), and check what a DOUBT says."
    return "\n".join(
        [
            schema_line(),
            f"# {purpose}",
            f"# {advice}",
            "#",
            f"#   sinsjax validate {name}",
            f"#   sinsjax align {log} {name} -o out",
            "#",
            "# With --reference FILE the result is compared; its columns: the page own_record.",
            "",
        ]
    )


def _study_section(
    record_path: Path, proposed: _ProposedFile, part: _AlignedPart | None, note: Note
) -> str:
    """Return the [study]; without a part the length of the record is unknown."""
    duration, interval_s = 60.0, 1.0
    duration_note = Note("s, the alignment", _NO_LENGTH)
    rate_hz, rate_note = proposed.layout.rate_hz, Note("Hz, of the record")
    if part is not None and proposed.record is not None:
        duration, interval_s, rate_hz = part.fine_s, part.interval_s, part.rate_hz
        duration_note = Note(f"s, the alignment; {note.reason}", note.doubt)
        measured = f"{proposed.record.rate_hz:.6g}"
        if measured != f"{part.rate_hz:.6g}":
            rate_note = Note(f"Hz, the nominal rate; that of the stamps is {measured}")
    rate_note = proposed.notes.get("rate_hz", rate_note)
    lines = [
        "[study]",
        *_format_key_lines("name", escape_controls(record_path.stem)),
        *_format_key_lines("duration_s", duration, duration_note),
    ]
    # If its unit is open, the stamps will give the rate.
    if not proposed.is_open("time_unit") and (rate_hz is not None or rate_note.question):
        lines += _format_key_lines("rate_hz", rate_hz, rate_note)
    lines += _format_key_lines("record_interval_s", interval_s, Note("s, between recorded values"))
    bands = Note("arcmin, heading error bands")
    lines += _format_key_lines("settle_bands_arcmin", [60, 10], bands)
    return "\n".join([*lines, ""])


def _earth_section(proposed: _ProposedFile, means: Means | None, given_deg: float | None) -> str:
    """Return the [earth]: the latitude is given, in the header, or an open question."""
    lines = ["[earth]"]
    record = proposed.record
    if given_deg is None and record is not None and record.latitude_deg is not None:
        lines += _format_key_lines("earth", "wgs84", Note("the header gives the place"))
        return "\n".join([*lines, ""])
    lines += _format_key_lines("earth", "wgs84")
    note = Note("deg, given")
    if given_deg is None:
        question = "the latitude of the place in degrees, negative in the south"
        if means is not None and means.turns is None:
            question += f" (the gyros give {means.latitude / DEG:.1f}; their mean rate is"
            question += f" {means.magnitude / EARTH_RATE:.3g} times Earth rate)"
        note = Note("", "", question)
    lines += _format_key_lines("latitude_deg", given_deg, note)
    return "\n".join([*lines, ""])


def _record_section(
    proposed: _ProposedFile,
    part: _AlignedPart | None,
    findings: Sequence[Anomaly | Finding],
    gyro_bias: float | None,
) -> str:
    layout, notes = proposed.layout, proposed.notes
    lines = [
        "[record]",
        _wrap_comment(f"{proposed.kind}."),
        *_format_key_lines("format", layout.format),
    ]
    always = {"axes_order"} if layout.format == "psins" else _ALWAYS_WRITTEN
    for key in RecordLayout._fields:
        value, note = getattr(layout, key), notes.get(key, _NO_NOTE)
        is_default = value == RecordLayout._field_defaults.get(key)
        if key in ("format", "rate_hz") or (not note.question and is_default and key not in always):
            continue
        if key == "time_unit" and not layout.time_column:
            continue
        lines += _format_key_lines(key, value, note)
    if part is not None:
        note = Note("s, start of coarse alignment; may be a list")
        lines += _format_key_lines("start_s", [part.start_s], note)
    key = "gyro_bias_deg_per_h"
    if gyro_bias is not None:
        lines += _format_key_lines(key, gyro_bias, Note("given"))
    elif proposed.record is not None:
        note = Note("deg/h, a larger bias is a warning: see the data sheet")
        lines += _format_key_lines(f"# {key}", round(GYRO_BIAS / DEG_PER_H, 1), note)
    remarks = [] if proposed.record is None else proposed.record.remarks
    lines += [_wrap_comment(remark, DOUBT) for remark in remarks]
    for finding in findings:
        is_refused = finding.is_certain and not getattr(finding, "hides_north", False)
        refused = " (the study is refused)" if is_refused else ""
        lines.append(_wrap_comment(f"{finding.text}{refused}", DOUBT))
    return "\n".join([*lines, ""])


def _coarse_section(part: _AlignedPart) -> str:
    lines = [
        "[coarse]",
        *_format_key_lines(
            "coarse_method", "inertial", Note("survives sway; 'analytic' needs a base at rest")
        ),
        *_format_key_lines(
            "coarse_duration_s", part.coarse_s, Note("s; its end is t = 0 of the alignment")
        ),
    ]
    return "\n".join([*lines, ""])


def _format_key_lines(key: str, value: Any, note: Note = _NO_NOTE) -> Iterator[str]:
    """Yield the lines of a key: its doubt or question above it, its reason beside or above it."""
    if note.question:
        yield _wrap_comment(note.question, QUESTION)
        yield f"{key} = {json.dumps(OPEN)}"
        return
    if note.doubt:
        yield _wrap_comment(note.doubt, DOUBT)
    value_to_show = list(value) if isinstance(value, tuple) else value
    line = f"{key} = {json.dumps(value_to_show, ensure_ascii=False)}"
    one_line = f"{line:<33} # {note.reason}"
    if not note.reason:
        yield line
    elif len(one_line) <= _WIDTH:
        yield one_line
    else:
        yield _wrap_comment(note.reason)
        yield line


def _wrap_comment(text: str, prefix: str = "# ") -> str:
    """Return a comment, wrapped to lines."""
    text = escape_controls(text)
    return textwrap.fill(
        text, _WIDTH, initial_indent=prefix, subsequent_indent="#   ", break_long_words=False
    )

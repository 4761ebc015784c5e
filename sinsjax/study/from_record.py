"""A study for a record without a description: ``sinsjax init record --from log.csv``.

Every key has a comment with its reason, and with a doubt if the file does not determine it.
"""

import json
import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import ValidationError, create_model

from sinsjax.errors import InputError
from sinsjax.messages import CONTROL, escape_controls, explain_error, suggest_closest
from sinsjax.records import read_psins, read_record
from sinsjax.records.anomalies import find_dead_channels, report_anomalies
from sinsjax.records.evidence import find_turning_earth_rate, shows_earth_rate
from sinsjax.records.files import parse_number_or_nan, read_line_batches
from sinsjax.records.layout import PSINS_LAYOUT, Anomaly, Note, Record, RecordLayout
from sinsjax.records.means import EARTH_RATE, Means, compute_means, vertical_rate, white_noise
from sinsjax.records.plausibility import (
    ACCEL_BIAS_UG,
    GYRO_BIAS,
    LOW_NOISE_GYRO_BIAS,
    Finding,
    StationaryValues,
    check_stationary,
    finds_north_by_turns,
    is_low_noise,
)
from sinsjax.records.propose import propose_layout
from sinsjax.records.tables import ColumnTable, open_parquet
from sinsjax.records.text import open_csv
from sinsjax.study.files import DOUBT, OPEN, QUESTION, schema_line
from sinsjax.study.keys import SECTIONS
from sinsjax.units import DEG, DEG_PER_H, DEG_PER_SQRT_H, STANDARD_GRAVITY, micro_g
from sinsjax.value_types import Section

_SHORT_GAP_S = 0.1
"""Longest gap that is interpolated by default: a base at rest hardly moves in this time."""

_LONGEST_S, _COARSE_S, _SHORTEST_S = 900.0, 10.0, 10.0
_LONGEST_TURNING_S = 3600.0  # so that no position is cut off
_RATE_TOLERANCE = 1e-4  # relative deviation of clocks from the nominal rate
_OTHER_ANSWERS = ("study.rate_hz", "earth.latitude_deg", "record.gyro_bias_deg_per_h")
_WIDTH = 100
_NO_NOTE = Note("")
_LATITUDE = 45.0
_UNCERTAIN_LATITUDE = 0.1  # of Earth rate; an error of 10 deg turns the heading by 0.1 deg
_LATITUDE_DOUBT = "estimated from the Earth rate that the gyros measure: put the true latitude here"
_TURNING_LATITUDE_DOUBT = (
    "estimated from the horizontal Earth rate, which is that of both hemispheres: put the true"
    " latitude here, negative in the south"
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
        record: record that is read with the layout; None if the columns are open.
        kind: description of the kind of file.
    """

    layout: RecordLayout
    notes: Mapping[str, Note]
    record: Record | None
    kind: str

    def is_open(self, *keys: str) -> bool:
        """Return whether one of some keys is an open question."""
        return any(self.notes.get(key, _NO_NOTE).question for key in keys)

    @property
    def is_gyro_known(self) -> bool:
        """Whether the unit of the gyros is known."""
        return self.record is not None and not self.is_open("gyro_unit", "gyro_scale")


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
    is_psins = _is_psins(record_path) and "columns" not in given
    proposed = _propose_psins(record_path) if is_psins else _propose_table(record_path, given)
    latitude, gyro_bias = given.pop("latitude_deg", None), given.pop("gyro_bias_deg_per_h", None)
    if proposed.record is None:
        sections = [
            _title_section(record_path, study_path),
            _open_study_section(record_path, proposed),
            _earth_section(None, None, latitude),
            _record_section(proposed, None),
            _ALIGNMENT,
        ]
        return "\n".join(sections)
    shortest_s = 0.0 if proposed.is_open("rate_hz", "time_unit") else _SHORTEST_S
    part, part_note = _longest_part(record_path, proposed.record, shortest_s, _LONGEST_TURNING_S)
    means = _compute_part_means(proposed.record, part)
    if not find_turning_earth_rate(means):
        part, part_note = _longest_part(record_path, proposed.record, shortest_s, _LONGEST_S)
        means = _compute_part_means(proposed.record, part)
    used_latitude = _estimate_latitude_deg(proposed, means) if latitude is None else latitude
    expected = _expected_values(used_latitude, gyro_bias)
    findings = _find_doubts(proposed, _sample_range(proposed.record, part), expected)
    level_only = any(getattr(finding, "hides_north", False) for finding in findings)
    sections = [
        _title_section(record_path, study_path),
        _study_section(record_path, proposed, part, part_note),
        _earth_section(proposed, means, latitude),
        _record_section(proposed, part, findings, _gyro_bias_lines(proposed, part, gyro_bias)),
        _coarse_section(part),
        _LEVELLING if level_only else _alignment_section(proposed, part, means, expected),
    ]
    return "\n".join(sections)


def _alignment_section(
    proposed: _ProposedFile, part: _AlignedPart, means: Means, expected: StationaryValues
) -> str:
    """Return the [alignment] of a record whose gyros find north, with the section of its method."""
    record = proposed.record
    assert record is not None
    if not (proposed.is_gyro_known and finds_north_by_turns(means, expected)):
        return _ALIGNMENT
    span = slice(*_sample_range(record, part))
    gyro_noise, accel_noise = (
        white_noise(rows[span], record.rate_hz) for rows in (record.dtheta, record.dv)
    )
    return _TURNING.format(
        gyro_bias=GYRO_BIAS / DEG_PER_H,
        accel_bias=ACCEL_BIAS_UG,
        gyro_noise=gyro_noise / DEG_PER_SQRT_H,
        accel_noise=accel_noise / micro_g(),
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


def _is_psins(path: Path) -> bool:
    """Return whether a file is PSINS text.

    Its first line that is not a comment has six numbers between blanks, and so have all, but no
    columns of a record without names: the third is scale factors, which are positive.
    """
    try:
        lines = next(read_line_batches(path, 2**16)).lines
    except InputError:
        return False  # reading it in another format reports the error
    data = [line for line in lines if line.strip() and not line.lstrip().startswith(b"%")]
    try:
        rows = [[parse_number_or_nan(w) for w in line.decode().split()] for line in data[:3]]
    except ValueError:
        return False
    if not rows or any(len(row) != 6 for row in rows):
        return False
    is_named = any(b"PSINS" in line for line in lines[:20]) or path.suffix == ".imu"
    return is_named or (len(rows) == 3 and 9 < rows[1][5] < 11 and min(rows[2]) > 0)


def _propose_psins(path: Path) -> _ProposedFile:
    note = Note("right, front and up, as in PSINS")
    return _ProposedFile(PSINS_LAYOUT, {"axes_order": note}, read_psins(path), "PSINS text")


def _open_table(path: Path, answers: Mapping[str, Any]) -> ColumnTable:
    try:
        with path.open("rb") as file:
            is_parquet = file.read(4) == b"PAR1"
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    if is_parquet:
        return open_parquet(path)
    return open_csv(path, answers.get("columns", ()), answers.get("skip_rows", 0))


def _propose_table(path: Path, answers: Mapping[str, Any]) -> _ProposedFile:
    table = _open_table(path, answers)
    found = propose_layout(path, table, answers)
    layout, notes = found.layout, dict(found.notes)
    for name in (*layout.time_columns, *layout.gyro_columns, *layout.accel_columns):
        if CONTROL.search(name):
            raise InputError(f"{path}: column {name!r}: control characters in its name (rename it)")
    if found.means is None:
        return _ProposedFile(layout, notes, None, table.description)
    record = read_record(path, layout)
    gaps = [(flaw.end - flaw.begin + 1) / record.rate_hz for flaw in record.flaws]
    short = [gap for gap in gaps if gap <= _SHORT_GAP_S]
    if short:
        layout = layout._replace(max_gap_s=math.ceil(max(short) * 1e3) / 1e3)
        record = read_record(path, layout)
        doubt = "if the base moves in these gaps, leave this out: the study then refuses them"
        notes["max_gap_s"] = Note(f"{record.filled} samples in {len(short)} gaps", doubt)
    return _ProposedFile(layout, notes, record, table.description)


def _longest_part(
    path: Path, record: Record, shortest_s: float, longest_s: float
) -> tuple[_AlignedPart, Note]:
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
    if intervals < 2 or intervals * interval_s < shortest_s:
        raise InputError(
            f"{path}: has only {intervals * interval_s:.3g} s without a gap (an alignment needs"
            f" {_SHORTEST_S:g} s)"
        )
    coarse = min(round(_COARSE_S / interval_s), intervals // 4)
    # A reference usually ends a little earlier than its record.
    fine = min(intervals - coarse - 1, round(longest_s / interval_s))
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


def _compute_part_means(record: Record, part: _AlignedPart) -> Means:
    return compute_means(record, _sample_range(record, part), STANDARD_GRAVITY)


def _shows_latitude(proposed: _ProposedFile, means: Means) -> bool:
    """Return whether its mean rate is the Earth rate, without a dead channel."""
    assert proposed.record is not None
    dead = find_dead_channels(proposed.record.dtheta.T)
    shows = shows_earth_rate(means) or find_turning_earth_rate(means) is not None
    return proposed.is_gyro_known and shows and not any(dead)


def _estimate_latitude_deg(proposed: _ProposedFile, means: Means) -> float:
    """Return the geodetic latitude of the header, or an estimate from the Earth rate, deg."""
    assert proposed.record is not None
    if proposed.record.latitude_deg is not None:
        return proposed.record.latitude_deg
    if not _shows_latitude(proposed, means):
        return _LATITUDE
    if turns := find_turning_earth_rate(means):
        return round(math.acos(min(1.0, turns.drift / EARTH_RATE)) / DEG, 1)
    rate = float(np.linalg.norm(means.rate))
    angle = math.asin(max(-0.99, min(0.99, vertical_rate(means) / rate)))
    if not means.is_steady:  # only the drift of the vertical shows the Earth rate, its level part
        cosine = min(1.0, means.vertical_drift / EARTH_RATE)
        angle = math.copysign(math.acos(cosine), vertical_rate(means))
    return round(angle / DEG, 1)


def _is_latitude_uncertain(means: Means) -> bool:
    """Return whether a gyro bias, or accelerations of the base, hide the latitude."""
    if means.is_steady:
        error = abs(float(np.linalg.norm(means.rate)) - EARTH_RATE)
    else:
        error = means.drift_uncertainty
    return error > _UNCERTAIN_LATITUDE * EARTH_RATE


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


def _open_study_section(record_path: Path, proposed: _ProposedFile) -> str:
    """Return the [study] of a file whose columns are open, so that its length is unknown."""
    lines = [
        "[study]",
        *_format_key_lines("name", escape_controls(record_path.stem)),
        *_format_key_lines("duration_s", 60.0, Note("s, the alignment", "the length is unknown")),
        *_rate_lines(proposed, proposed.layout.rate_hz, Note("Hz, of the record")),
        *_format_key_lines("record_interval_s", 1.0, Note("s, between recorded values")),
    ]
    return "\n".join([*lines, ""])


def _study_section(
    record_path: Path, proposed: _ProposedFile, part: _AlignedPart, note: Note
) -> str:
    lines = [
        "[study]",
        *_format_key_lines("name", escape_controls(record_path.stem)),
        *_format_key_lines(
            "duration_s", part.fine_s, Note(f"s, the alignment; {note.reason}", note.doubt)
        ),
        *_rate_lines(proposed, part.rate_hz, _rate_note(proposed, part)),
        *_format_key_lines(
            "record_interval_s", part.interval_s, Note("s, between recorded values")
        ),
        *_format_key_lines("settle_bands_arcmin", [60, 10], Note("arcmin, heading error bands")),
    ]
    return "\n".join([*lines, ""])


def _rate_lines(proposed: _ProposedFile, rate_hz: float | None, note: Note) -> Iterator[str]:
    """Yield the lines of rate_hz; nothing if the stamps give it and it is not known yet."""
    note = proposed.notes.get("rate_hz", note)
    time_unit = proposed.notes.get("time_unit", _NO_NOTE)
    if time_unit.question or (rate_hz is None and not note.question):
        return  # the stamps give it
    yield from _format_key_lines("rate_hz", rate_hz, note)


def _rate_note(proposed: _ProposedFile, part: _AlignedPart) -> Note:
    assert proposed.record is not None
    measured = f"{proposed.record.rate_hz:.6g}"
    if measured == f"{part.rate_hz:.6g}":
        return Note("Hz, of the record")
    return Note(f"Hz, the nominal rate; that of the stamps is {measured}")


def _earth_section(
    proposed: _ProposedFile | None, means: Means | None, given_deg: float | None
) -> str:
    record = None if proposed is None else proposed.record
    latitude, note = _LATITUDE, Note("deg", "the latitude is unknown: put the true one here")
    if given_deg is not None:
        latitude, note = given_deg, Note("deg, given")
    elif record is not None and record.latitude_deg is not None:
        lines = _format_key_lines("earth", "wgs84", Note("the header gives the place"))
        return "\n".join(["[earth]", *lines, ""])
    elif proposed is not None and means is not None:
        latitude = _estimate_latitude_deg(proposed, means)
        if not proposed.is_gyro_known:
            doubt = (
                "the unit of the gyros is open, so the latitude is unknown: put the true one here"
            )
            note = Note("deg", doubt)
        elif not _shows_latitude(proposed, means):
            note = Note("deg", "the gyros do not show the latitude: put the true one here")
        elif find_turning_earth_rate(means):
            note = Note("deg", _TURNING_LATITUDE_DOUBT)
        elif _is_latitude_uncertain(means):
            note = Note("deg, from the vertical part of the mean rate", _LATITUDE_DOUBT)
        else:
            note = Note("deg, estimated from the Earth rate of the gyros: put the true one here")
    lines = _format_key_lines("latitude_deg", latitude, note)
    return "\n".join(["[earth]", *_format_key_lines("earth", "wgs84"), *lines, ""])


def _expected_values(latitude_deg: float, gyro_bias: float | None) -> StationaryValues:
    """Return the measurements to expect, with a gyro bias that the user has given, deg/h."""
    return StationaryValues.with_biases(
        earth_rate=EARTH_RATE,
        latitude=latitude_deg * DEG,
        gravity=STANDARD_GRAVITY,
        gyro_bias_deg_per_h=gyro_bias,
    )


def _find_doubts(
    proposed: _ProposedFile, span: tuple[int, int], expected: StationaryValues
) -> list[Anomaly | Finding]:
    """Return what is implausible in a span of a record."""
    assert proposed.record is not None
    doubts: list[Anomaly | Finding] = [*report_anomalies(proposed.record.anomalies, [span])]
    certain = any(anomaly.is_certain for anomaly in doubts)
    if certain or not proposed.is_gyro_known or proposed.is_open("accel_scale", "axes_order"):
        return doubts
    return [*doubts, *check_stationary(proposed.record, span, proposed.layout, expected)]


def _gyro_bias_lines(
    proposed: _ProposedFile, part: _AlignedPart, given_deg_per_h: float | None
) -> Iterator[str]:
    """Yield the line of the largest gyro bias, a comment unless the user has given it."""
    key = "gyro_bias_deg_per_h"
    if given_deg_per_h is not None:
        yield from _format_key_lines(key, given_deg_per_h, Note("given"))
    elif proposed.record is not None and proposed.is_gyro_known:
        is_low = is_low_noise(proposed.record, _sample_range(proposed.record, part))
        value = round((LOW_NOISE_GYRO_BIAS if is_low else GYRO_BIAS) / DEG_PER_H, 1)
        note = Note("deg/h, a larger bias is a warning: see the data sheet")
        yield from _format_key_lines(f"# {key}", value, note)


def _record_section(
    proposed: _ProposedFile,
    part: _AlignedPart | None,
    findings: Sequence[Anomaly | Finding] = (),
    gyro_bias_lines: Iterable[str] = (),
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
    lines += gyro_bias_lines
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

"""A study for a record without a description: ``sinsjax init record --from log.csv``.

Every key has a comment with its reason, and with a doubt if the file does not determine it.
"""

import json
import math
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from sinsjax.errors import InputError
from sinsjax.messages import CONTROL, escape_controls
from sinsjax.records import read_psins, read_record
from sinsjax.records.anomalies import find_dead_channels, report_anomalies
from sinsjax.records.files import parse_number_or_nan, read_line_batches
from sinsjax.records.head import read_head
from sinsjax.records.layout import PSINS_LAYOUT, Anomaly, Layout, Note, Record
from sinsjax.records.means import EARTH_RATE, Means, compute_means, vertical_rate
from sinsjax.records.plausibility import Finding, StationaryValues, check_stationary
from sinsjax.records.recognise import recognise_layout, shows_earth_rate
from sinsjax.study.files import DOUBT, schema_line
from sinsjax.units import DEG, DEG_PER_H, STANDARD_GRAVITY, micro_g

_SHORT_GAP_S = 0.1
"""Longest gap that is interpolated by default: a base at rest hardly moves in this time."""

_LONGEST_S, _COARSE_S, _SHORTEST_S = 900.0, 10.0, 10.0
_RATE_TOLERANCE = 1e-4  # relative deviation of clocks from the nominal rate
_WIDTH = 100
_LATITUDE = 45.0
_NO_NOTE = Note("")
_LATITUDE_DOUBT = "estimated from the Earth rate that the gyros measure: put the true latitude here"
_ALIGNMENT = """\
# for a covariance: "kalman_sincos" with the noise of the sensors in [filter] (sinsjax keys filter)
[alignment]
method = "inertial"               # needs no numbers of the sensors
"""


class _RecognisedFile(NamedTuple):
    """A file with its recognised layout.

    Attributes:
        layout: layout of the record in the file.
        notes: reasons and doubts by key of [record].
        record: record that is read with the layout.
        kind: description of the kind of file.
        gives_rate: whether the file gives its rate.
    """

    layout: Layout
    notes: dict[str, Note]
    record: Record
    kind: str
    gives_rate: bool = True


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


def make_study_text(record_path: Path, study_path: Path) -> str:
    """Return the text of a study that aligns a record, with reasons and doubts.

    Args:
        record_path: CSV with a header, Parquet, or PSINS text.
        study_path: file of the study.

    Raises:
        InputError: the file does not contain a record.
    """
    recognised = (
        _recognise_psins(record_path) if _is_psins(record_path) else _recognise_table(record_path)
    )
    part, part_note = _longest_part(record_path, recognised.record)
    span = _sample_range(recognised.record, part)
    means = compute_means(recognised.record, span, STANDARD_GRAVITY)
    sections = [
        _title_section(record_path, study_path),
        _study_section(record_path, recognised, part, part_note),
        _earth_section(recognised.record, means),
        _record_section(recognised, part, span, _estimate_latitude_deg(recognised.record, means)),
        _coarse_section(part),
        _ALIGNMENT,
    ]
    return "\n".join(sections)


def _is_psins(path: Path) -> bool:
    """Return whether the first line that is not a comment has six numbers between blanks."""
    try:
        lines = next(read_line_batches(path, 2**16)).lines
    except InputError:
        return False  # reading it in another format reports the error
    data = (line for line in lines if line.strip() and not line.lstrip().startswith(b"%"))
    words = next(data, b"").decode(errors="replace").split()
    try:
        return len([parse_number_or_nan(word) for word in words]) == 6
    except ValueError:
        return False


def _recognise_psins(path: Path) -> _RecognisedFile:
    note = Note("right, front and up, as in PSINS", "the file does not state its axes")
    return _RecognisedFile(PSINS_LAYOUT, {"axes_order": note}, read_psins(path), "PSINS text")


def _recognise_table(path: Path) -> _RecognisedFile:
    head = read_head(path)
    found = recognise_layout(path, head)
    layout, notes = found.layout, dict(found.notes)
    for name in (layout.time_column, *layout.gyro_columns, *layout.accel_columns):
        if CONTROL.search(name):
            raise InputError(f"{path}: column {name!r}: control characters in its name (rename it)")
    record = read_record(path, layout)
    gaps = [(flaw.end - flaw.begin + 1) / record.rate_hz for flaw in record.flaws]
    short = [gap for gap in gaps if gap <= _SHORT_GAP_S]
    if short:
        layout = layout._replace(max_gap_s=math.ceil(max(short) * 1e3) / 1e3)
        record = read_record(path, layout)
        doubt = "if the base moves in these gaps, leave this out: the study then refuses them"
        notes["max_gap_s"] = Note(f"{record.filled} samples in {len(short)} gaps", doubt)
    return _RecognisedFile(layout, notes, record, head.description, found.has_rate)


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
    if intervals * interval_s < _SHORTEST_S:
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
        rate, interval_s, float(start_s), coarse * interval_s, fine * interval_s
    ), note


def _sample_range(record: Record, part: _AlignedPart) -> tuple[int, int]:
    """Return the first sample that the study reads, and the one after the last."""
    begin = round(part.start_s * record.rate_hz)
    end = begin + round((part.coarse_s + part.fine_s) * part.rate_hz)
    return begin, min(end, len(record.dv))


def _shows_latitude(record: Record, means: Means) -> bool:
    """Return whether its mean rate is the Earth rate, without a dead channel."""
    return shows_earth_rate(means) and not any(find_dead_channels(record.dtheta.T))


def _estimate_latitude_deg(record: Record, means: Means) -> float:
    """Return the geodetic latitude of the header, or an estimate from the Earth rate, deg."""
    if record.latitude_deg is not None:
        return record.latitude_deg
    if not _shows_latitude(record, means):
        return _LATITUDE
    sine = max(-0.99, min(0.99, vertical_rate(means) / EARTH_RATE))
    return round(math.asin(sine) / DEG, 1)


def _title_section(record_path: Path, study_path: Path) -> str:
    log, name = escape_controls(record_path.name), escape_controls(study_path.name)
    purpose = f"Alignment of {log}, written by `sinsjax init record`."
    advice = f"Lines with {DOUBT.strip('# :')} list what the file does not show: check them first."
    return "\n".join(
        [
            schema_line(),
            f"# {purpose}",
            f"# {advice}",
            "#",
            f"#   sinsjax validate {name}",
            f"#   sinsjax align {log} {name} -o out",
            "#",
            "# With --reference FILE the result is compared; its columns: docs/own_record.md.",
            "",
        ]
    )


def _study_section(
    record_path: Path, recognised: _RecognisedFile, part: _AlignedPart, note: Note
) -> str:
    rate = [*_format_key_lines("rate_hz", part.rate_hz, _rate_note(recognised, part))]
    if not recognised.gives_rate:  # the study is refused until it is given
        rate[-1] = "# rate_hz ="
    lines = [
        "[study]",
        *_format_key_lines("name", escape_controls(record_path.stem)),
        *_format_key_lines(
            "duration_s", part.fine_s, Note(f"s, the alignment; {note.reason}", note.doubt)
        ),
        *rate,
        *_format_key_lines(
            "record_interval_s", part.interval_s, Note("s, between recorded values")
        ),
        *_format_key_lines("settle_bands_arcmin", [60, 10], Note("arcmin, heading error bands")),
    ]
    return "\n".join([*lines, ""])


def _rate_note(recognised: _RecognisedFile, part: _AlignedPart) -> Note:
    measured = f"{recognised.record.rate_hz:.6g}"
    if measured == f"{part.rate_hz:.6g}":
        return recognised.notes.get("rate_hz", Note("Hz, of the record"))
    return Note(f"Hz, the nominal rate; that of the stamps is {measured}")


def _earth_section(record: Record, means: Means) -> str:
    if record.latitude_deg is not None:
        return "\n".join(
            [
                "[earth]",
                *_format_key_lines("earth", "wgs84", Note("the header gives the place")),
                "",
            ]
        )
    if _shows_latitude(record, means):
        note = Note("deg, from the vertical part of the mean rate", _LATITUDE_DOUBT)
    else:
        note = Note("deg", "the gyros do not show the latitude: put the true one here")
    latitude = _format_key_lines("latitude_deg", _estimate_latitude_deg(record, means), note)
    return "\n".join(["[earth]", *_format_key_lines("earth", "wgs84"), *latitude, ""])


def _record_section(
    recognised: _RecognisedFile, part: _AlignedPart, span: tuple[int, int], latitude_deg: float
) -> str:
    layout, notes = recognised.layout, recognised.notes
    lines = [
        "[record]",
        _wrap_comment(f"{recognised.kind}."),
        *_format_key_lines("format", layout.format),
    ]
    for key in Layout._fields:
        value = getattr(layout, key)
        if key in ("format", "rate_hz") or value in ("", 0.0, ()):
            continue
        elif layout.format != "psins" or key == "axes_order":
            if key != "time_unit" or layout.time_column:
                lines += _format_key_lines(key, value, notes.get(key, Note("")))
    lines += _format_key_lines(
        "start_s", [part.start_s], Note("s, start of coarse alignment; may be a list")
    )
    expected = StationaryValues(
        earth_rate=EARTH_RATE,
        latitude=latitude_deg * DEG,
        gravity=STANDARD_GRAVITY,
        gyro_bias=10 * DEG_PER_H,
        accel_bias=5000 * micro_g(),
    )
    doubtful: list[Anomaly | Finding] = [*report_anomalies(recognised.record.anomalies, [span])]
    if not any(anomaly.is_certain for anomaly in doubtful):  # otherwise they spoil the means
        doubtful += check_stationary(recognised.record, span, layout, expected)
    for doubt in doubtful:
        refused = " (the study is refused)" if doubt.is_certain else ""
        lines.append(_wrap_comment(f"{doubt.text}{refused}", DOUBT))
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
    """Yield the lines of a key with its reason, above it if long, and its doubt above it."""
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

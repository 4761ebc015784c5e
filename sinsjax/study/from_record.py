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
from sinsjax.records.files import line_batches, number_or_nan
from sinsjax.records.head import head_of
from sinsjax.records.layout import PSINS_LAYOUT, Layout, Note, Oddity, Record
from sinsjax.records.means import EARTH_RATE, Means, means_of, rate_up
from sinsjax.records.oddities import dead_among, told
from sinsjax.records.plausible import Finding, StationaryValues, findings
from sinsjax.records.recognise import recognise, sees_earth_rate
from sinsjax.study.files import DOUBT, schema_line
from sinsjax.units import DEG, DEG_PER_H, STANDARD_GRAVITY, micro_g

_SHORT_GAP_S = 0.1
"""Longest gap that is interpolated by default: a base at rest hardly moves in this time."""

_LONGEST_S, _COARSE_S, _SHORTEST_S = 900.0, 10.0, 10.0
_NOMINAL = 1e-4  # relative deviation of clocks from the nominal rate
_WIDTH = 100
_LATITUDE = 45.0
_NOTHING = Note("")
_ABOUT = "estimated from the Earth rate that the gyros measure: put the true latitude here"
_ALIGNMENT = """\
# for a covariance: "kalman_sincos" with the noise of the sensors in [filter] (sinsjax keys filter)
[alignment]
method = "inertial"               # needs no numbers of the sensors
"""


class _Recognised(NamedTuple):
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


class _Times(NamedTuple):
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


def study_text(path: Path, study: Path) -> str:
    """Return the text of a study that aligns a record, with reasons and doubts.

    Args:
        path: CSV with a header, Parquet, or PSINS text.
        study: file of the study.

    Raises:
        InputError: the file does not contain a record.
    """
    recognised = _recognise_psins(path) if _is_psins(path) else _recognise(path)
    times, of_times = _times(path, recognised.record)
    span = _samples(recognised.record, times)
    means = means_of(recognised.record, span, STANDARD_GRAVITY)
    sections = [
        _title(path, study),
        _study_section(path, recognised, times, of_times),
        _earth_section(recognised.record, means),
        _record_section(recognised, times, span, _latitude(recognised.record, means)),
        _coarse_section(times),
        _ALIGNMENT,
    ]
    return "\n".join(sections)


def _is_psins(path: Path) -> bool:
    """Whether the first line that is not a comment has six numbers between blanks."""
    try:
        lines = next(line_batches(path, 2**16)).lines
    except InputError:
        return False  # reading it in another format reports the error
    data = (line for line in lines if line.strip() and not line.lstrip().startswith(b"%"))
    words = next(data, b"").decode(errors="replace").split()
    try:
        return len([number_or_nan(word) for word in words]) == 6
    except ValueError:
        return False


def _recognise_psins(path: Path) -> _Recognised:
    note = Note("right, front and up, as in PSINS", "the file does not state its axes")
    return _Recognised(PSINS_LAYOUT, {"axes_order": note}, read_psins(path), "PSINS text")


def _recognise(path: Path) -> _Recognised:
    head = head_of(path)
    found = recognise(path, head)
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
    return _Recognised(layout, notes, record, head.told, found.tells_rate)


def _times(path: Path, record: Record) -> tuple[_Times, Note]:
    """Return the part of a record that can be aligned, the longest one without a gap."""
    rate = record.rate_hz
    meant = float(round(rate)) if round(rate) else rate
    rate = meant if abs(rate / meant - 1) <= _NOMINAL else rate
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
    return _Times(rate, interval_s, float(start_s), coarse * interval_s, fine * interval_s), note


def _samples(record: Record, times: _Times) -> tuple[int, int]:
    """Return the first sample that the study reads, and the one after the last."""
    begin = round(times.start_s * record.rate_hz)
    end = begin + round((times.coarse_s + times.fine_s) * times.rate_hz)
    return begin, min(end, len(record.dv))


def _shows_latitude(record: Record, means: Means) -> bool:
    """Whether its mean rate is the Earth rate, without a dead channel."""
    return sees_earth_rate(means) and not any(dead_among(record.dtheta.T))


def _latitude(record: Record, means: Means) -> float:
    """Return the geodetic latitude of the header, or an estimate from the Earth rate, deg."""
    if record.latitude_deg is not None:
        return record.latitude_deg
    if not _shows_latitude(record, means):
        return _LATITUDE
    sine = max(-0.99, min(0.99, rate_up(means) / EARTH_RATE))
    return round(math.asin(sine) / DEG, 1)


def _title(path: Path, study: Path) -> str:
    log, name = escape_controls(path.name), escape_controls(study.name)
    about = f"Alignment of {log}, written by `sinsjax init record`."
    look = f"Lines with {DOUBT.strip('# :')} list what the file does not show: check them first."
    return "\n".join(
        [
            schema_line(),
            f"# {about}",
            f"# {look}",
            "#",
            f"#   sinsjax validate {name}",
            f"#   sinsjax align {log} {name} -o out",
            "#",
            "# With --reference FILE the result is compared; its columns: docs/own_record.md.",
            "",
        ]
    )


def _study_section(path: Path, recognised: _Recognised, times: _Times, note: Note) -> str:
    rate = [*_entry("rate_hz", times.rate_hz, _rate_note(recognised, times))]
    if not recognised.gives_rate:  # the study is refused until it is given
        rate[-1] = "# rate_hz ="
    lines = [
        "[study]",
        *_entry("name", escape_controls(path.stem)),
        *_entry("duration_s", times.fine_s, Note(f"s, the alignment; {note.reason}", note.doubt)),
        *rate,
        *_entry("record_interval_s", times.interval_s, Note("s, between recorded values")),
        *_entry("settle_bands_arcmin", [60, 10], Note("arcmin, heading error bands")),
    ]
    return "\n".join([*lines, ""])


def _rate_note(recognised: _Recognised, times: _Times) -> Note:
    measured = f"{recognised.record.rate_hz:.6g}"
    if measured == f"{times.rate_hz:.6g}":
        return recognised.notes.get("rate_hz", Note("Hz, of the record"))
    return Note(f"Hz, the nominal rate; that of the stamps is {measured}")


def _earth_section(record: Record, means: Means) -> str:
    if record.latitude_deg is not None:
        return "\n".join(
            ["[earth]", *_entry("earth", "wgs84", Note("the header gives the place")), ""]
        )
    if _shows_latitude(record, means):
        note = Note("deg, from the vertical part of the mean rate", _ABOUT)
    else:
        note = Note("deg", "the gyros do not show the latitude: put the true one here")
    latitude = _entry("latitude_deg", _latitude(record, means), note)
    return "\n".join(["[earth]", *_entry("earth", "wgs84"), *latitude, ""])


def _record_section(
    recognised: _Recognised, times: _Times, span: tuple[int, int], latitude_deg: float
) -> str:
    layout, notes = recognised.layout, recognised.notes
    lines = ["[record]", _comment(f"{recognised.kind}."), *_entry("format", layout.format)]
    for key in Layout._fields:
        value = getattr(layout, key)
        if key in ("format", "rate_hz") or value in ("", 0.0, ()):
            continue
        elif layout.format != "psins" or key == "axes_order":
            if key != "time_unit" or layout.time_column:
                lines += _entry(key, value, notes.get(key, Note("")))
    lines += _entry("start_s", [times.start_s], Note("s, start of coarse alignment; may be a list"))
    expected = StationaryValues(
        earth_rate=EARTH_RATE,
        latitude=latitude_deg * DEG,
        gravity=STANDARD_GRAVITY,
        gyro_bias=10 * DEG_PER_H,
        accel_bias=5000 * micro_g(),
    )
    doubtful: list[Oddity | Finding] = [*told(recognised.record.oddities, [span])]
    if not any(odd.hard for odd in doubtful):  # otherwise they spoil the means
        doubtful += findings(recognised.record, span, layout, expected)
    for found in doubtful:
        refused = " (the study is refused)" if found.hard else ""
        lines.append(_comment(f"{found.text}{refused}", DOUBT))
    return "\n".join([*lines, ""])


def _coarse_section(times: _Times) -> str:
    lines = [
        "[coarse]",
        *_entry(
            "coarse_method", "inertial", Note("survives sway; 'analytic' needs a base at rest")
        ),
        *_entry("coarse_duration_s", times.coarse_s, Note("s; its end is t = 0 of the alignment")),
    ]
    return "\n".join([*lines, ""])


def _entry(key: str, value: Any, note: Note = _NOTHING) -> Iterator[str]:
    """Yield the lines of a key with its reason, above it if long, and its doubt above it."""
    if note.doubt:
        yield _comment(note.doubt, DOUBT)
    shown = list(value) if isinstance(value, tuple) else value
    line = f"{key} = {json.dumps(shown, ensure_ascii=False)}"
    beside = f"{line:<33} # {note.reason}"
    if not note.reason:
        yield line
    elif len(beside) <= _WIDTH:
        yield beside
    else:
        yield _comment(note.reason)
        yield line


def _comment(text: str, mark: str = "# ") -> str:
    """Return a comment, wrapped to lines."""
    text = escape_controls(text)
    return textwrap.fill(
        text, _WIDTH, initial_indent=mark, subsequent_indent="#   ", break_long_words=False
    )

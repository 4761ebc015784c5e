"""A study for a record that nobody described: ``sinsjax init record --from log.csv``.

Every key stands with its reason, and with what the file cannot tell.
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
"""Longest gap that is interpolated unasked: a base at rest does not sway in less."""

_LONGEST_S, _COARSE_S, _SHORTEST_S = 900.0, 10.0, 10.0
_NOMINAL = 1e-4  # relative: clocks are off by as much from the rate that was meant
_WIDTH = 100
_LATITUDE = 45.0
_NOTHING = Note("")
_ABOUT = "Earth rate tells the latitude as well as the gyros know it: put the true one here"
_ALIGNMENT = """\
# for a covariance: "kalman_sincos" with the noise of the sensors in [filter] (sinsjax keys filter)
[alignment]
method = "inertial"               # needs no numbers of the sensors
"""


class _Looked(NamedTuple):
    """A file as it was understood.

    Attributes:
        layout: how it holds the record.
        notes: by key of [record].
        record: what is read with it.
        told: what kind of file it is.
        tells_rate: whether the file tells its rate.
    """

    layout: Layout
    notes: dict[str, Note]
    record: Record
    told: str
    tells_rate: bool = True


class _Times(NamedTuple):
    """What of a record is aligned.

    Attributes:
        rate_hz: that was meant.
        interval_s: between recorded values, whole samples.
        start_s: where coarse alignment begins.
        coarse_s: how long it takes.
        fine_s: how long the alignment takes.
    """

    rate_hz: float
    interval_s: float
    start_s: float
    coarse_s: float
    fine_s: float


def study_of(path: Path, study: Path) -> str:
    """The text of a study that aligns a record, with reasons and doubts.

    Args:
        path: CSV with a header, Parquet, or PSINS text.
        study: the file that the text is for.

    Raises:
        InputError: no record can be found in it; one line says why.
    """
    looked = _looked_psins(path) if _is_psins(path) else _looked(path)
    times, of_times = _times(path, looked.record)
    span = _samples(looked.record, times)
    means = means_of(looked.record, span, STANDARD_GRAVITY)
    sections = [
        _title(path, study),
        _study_section(path, looked, times, of_times),
        _earth_section(looked.record, means),
        _record_section(looked, times, span, _latitude(looked.record, means)),
        _coarse_section(times),
        _ALIGNMENT,
    ]
    return "\n".join(sections)


def _is_psins(path: Path) -> bool:
    """Whether the first line that is no comment has six numbers with blanks between them."""
    try:
        lines = next(line_batches(path, 2**16)).lines
    except InputError:
        return False  # what it is else will tell what is wrong with it
    data = (line for line in lines if line.strip() and not line.lstrip().startswith(b"%"))
    words = next(data, b"").decode(errors="replace").split()
    try:
        return len([number_or_nan(word) for word in words]) == 6
    except ValueError:
        return False


def _looked_psins(path: Path) -> _Looked:
    note = Note("right, front and up, as PSINS has them", "the file does not tell its axes")
    return _Looked(PSINS_LAYOUT, {"axes_order": note}, read_psins(path), "PSINS text")


def _looked(path: Path) -> _Looked:
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
        doubt = "if the base moves in them, leave this out: the study then refuses them"
        notes["max_gap_s"] = Note(f"{record.filled} samples in {len(short)} gaps", doubt)
    return _Looked(layout, notes, record, head.told, found.tells_rate)


def _times(path: Path, record: Record) -> tuple[_Times, Note]:
    """What of a record can be aligned: its longest part without a gap."""
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
            f"{path}: has {intervals * interval_s:.3g} s without a gap, and an alignment needs"
            f" {_SHORTEST_S:g}"
        )
    coarse = min(round(_COARSE_S / interval_s), intervals // 4)
    # An ordinary reference ends a little earlier than its record.
    fine = min(intervals - coarse - 1, round(_LONGEST_S / interval_s))
    note = Note(f"of {len(record.dv) / rate:.4g} s in the file")
    if record.flaws:
        longest = f"{begin / rate:.4g} to {end / rate:.4g} s is the longest part without a gap"
        note = Note(f"{note.reason}, of which {longest}", record.flaws[0].text)
    return _Times(rate, interval_s, float(start_s), coarse * interval_s, fine * interval_s), note


def _samples(record: Record, times: _Times) -> tuple[int, int]:
    """The samples that the study reads."""
    begin = round(times.start_s * record.rate_hz)
    end = begin + round((times.coarse_s + times.fine_s) * times.rate_hz)
    return begin, min(end, len(record.dv))


def _tells_latitude(record: Record, means: Means) -> bool:
    """Whether its mean rate is Earth rate, and not in part what a dead channel holds."""
    return sees_earth_rate(means) and not any(dead_among(record.dtheta.T))


def _latitude(record: Record, means: Means) -> float:
    """Geodetic latitude, deg: of the header, or about that which Earth rate tells."""
    if record.latitude_deg is not None:
        return record.latitude_deg
    if not _tells_latitude(record, means):
        return _LATITUDE
    sine = max(-0.99, min(0.99, rate_up(means) / EARTH_RATE))
    return round(math.asin(sine) / DEG, 1)


def _title(path: Path, study: Path) -> str:
    log, name = escape_controls(path.name), escape_controls(study.name)
    about = f"Alignment of {log}, written by `sinsjax init record`."
    look = f"Lines with {DOUBT.strip('# :')} say what the file cannot tell: look at them first."
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


def _study_section(path: Path, looked: _Looked, times: _Times, note: Note) -> str:
    rate = [*_entry("rate_hz", times.rate_hz, _rate_note(looked, times))]
    if not looked.tells_rate:  # the study is refused until it is given
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


def _rate_note(looked: _Looked, times: _Times) -> Note:
    measured = f"{looked.record.rate_hz:.6g}"
    if measured == f"{times.rate_hz:.6g}":
        return looked.notes.get("rate_hz", Note("Hz, of the record"))
    return Note(f"Hz, the nominal rate: the stamps tell {measured}")


def _earth_section(record: Record, means: Means) -> str:
    if record.latitude_deg is not None:
        return "\n".join(["[earth]", *_entry("earth", "wgs84", Note("place: of the header")), ""])
    if _tells_latitude(record, means):
        note = Note("deg, by the vertical part of the mean rate", _ABOUT)
    else:
        note = Note("deg", "the gyros do not tell the latitude: put the true one here")
    latitude = _entry("latitude_deg", _latitude(record, means), note)
    return "\n".join(["[earth]", *_entry("earth", "wgs84"), *latitude, ""])


def _record_section(
    looked: _Looked, times: _Times, span: tuple[int, int], latitude_deg: float
) -> str:
    layout, notes = looked.layout, looked.notes
    lines = ["[record]", _comment(f"{looked.told}."), *_entry("format", layout.format)]
    for key in Layout._fields:
        value = getattr(layout, key)
        if key in ("format", "rate_hz") or value in ("", 0.0, ()):
            continue
        elif layout.format != "psins" or key == "axes_order":
            if key != "time_unit" or layout.time_column:
                lines += _entry(key, value, notes.get(key, Note("")))
    lines += _entry(
        "start_s", [times.start_s], Note("s, where coarse alignment begins; may be many")
    )
    expected = StationaryValues(
        earth_rate=EARTH_RATE,
        latitude=latitude_deg * DEG,
        gravity=STANDARD_GRAVITY,
        gyro_bias=10 * DEG_PER_H,
        accel_bias=5000 * micro_g(),
    )
    doubtful: list[Oddity | Finding] = [*told(looked.record.oddities, [span])]
    if not any(odd.hard for odd in doubtful):  # they are in the means
        doubtful += findings(looked.record, span, layout, expected)
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
    """A key with its reason beside it, or above where that is long, and its doubt above."""
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
    """A comment of as many lines as it takes."""
    text = escape_controls(text)
    return textwrap.fill(
        text, _WIDTH, initial_indent=mark, subsequent_indent="#   ", break_long_words=False
    )

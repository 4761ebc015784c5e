"""Records and references as text, with the study that reads them: heads, units, times and cells."""

from collections.abc import Iterator
from typing import Any, NamedTuple

from hypothesis import strategies as st

from fuzzing.edits import HiddenValue, mangle_bytes
from fuzzing.studies import KEYS, value_strategy
from sinsjax.records.layout import ACCEL_UNITS, GYRO_UNITS, TIME_UNITS

CELLS = [
    *("", " ", "nan", "NaN", "inf", "-inf", "1e999", "-1e308", "1e-320", "0", "-0", "1", "x"),
    *("1_0", "0x10", "1,5", '"1"', "1 2", "é", "\x00", "9" * 400, "2026-01-01T00:00:00", "None"),
    *("-", "+1"),
]
_STUDY: dict[str, Any] = {
    "study": {"duration_s": 2.0, "window_s": [0, 2], "record_interval_s": 0.5},
    "earth": {"latitude_deg": 32.0},
    "coarse": {"coarse_duration_s": 1.0},
}
_HEADS = [
    "t a b c d e f",
    "time_s gyro_x gyro_y gyro_z accel_x accel_y accel_z",
    "stamp_ms wx_dps wy_dps wz_dps ax_mps2 ay_mps2 az_mps2",
    "tow dtheta_front dtheta_neg_right dtheta_down dv_x_(g) dv_y_(g) dv_z_(g)",
    "sec nanosec pitch_rate roll_rate yaw_rate f1 f2",
]
"""Names of a log's columns."""


class Case(NamedTuple):
    """Tables of a study, and the content of the record and the reference that it reads."""

    study: dict[str, Any]
    record: bytes
    reference: bytes | None


@st.composite
def record_cases(draw: st.DrawFn) -> Case:
    """Draw a record of four seconds at rest in any layout, with some changes."""
    quantity = draw(st.sampled_from(list(GYRO_UNITS)))
    head = draw(st.sampled_from(_HEADS)).split()
    section: dict[str, Any] = {
        "format": draw(st.sampled_from(["csv"] * 6 + ["psins", "parquet"])),
        "quantity": quantity,
        "time_column": head[0],
        "time_unit": draw(st.sampled_from(list(TIME_UNITS))),
        "gyro_columns": head[1:4],
        "accel_columns": head[4:],
        "gyro_unit": draw(st.sampled_from(list(GYRO_UNITS[quantity]))),
        "accel_unit": draw(st.sampled_from(list(ACCEL_UNITS[quantity]))),
    }
    rows = [head, *_samples(draw(st.sampled_from([0.0, 1000.0, -5.0, 1.7e9])), **section)]
    if section["format"] == "psins":
        section = {"format": "psins"}
        rows = [["1e-9", "1e-6", "0.1"], ["32", "0", "0"], ["0", "0", "0"]]
        rows += [["0", "6", "4", "0", "0", "980000"]] * 40
    if draw(st.booleans()):
        key = draw(st.sampled_from([place for place in KEYS if place[0] == "record"]))
        section[key[1]] = draw(value_strategy(key))
    study: dict[str, Any] = _STUDY | {"record": section}
    if draw(st.booleans()):
        rate_hz = draw(st.sampled_from([10.0, 10.0, 9.9, 100.0, 1e-3]))
        study["study"] = study["study"] | {"rate_hz": rate_hz}
    yaw = draw(st.sampled_from(["yaw_deg", "heading_deg", "yaw_ccw_deg", "x"]))
    angles = [["time_s", "pitch_deg", "roll_deg", yaw]]
    angles += [[f"{t / 2:g}", "0", "0", f"{t}"] for t in range(12)]
    record = _change_rows(draw, rows)
    return Case(study, record, _change_rows(draw, angles) if draw(st.booleans()) else None)


def _samples(
    begin_s: float, quantity: str, time_unit: str, gyro_unit: str, accel_unit: str, **_: Any
) -> Iterator[list[str]]:
    """Yield 4 s at rest, at 10 Hz."""
    per_sample = 1.0 if quantity == "rates" else 0.1
    rate = 7.3e-5 * per_sample / GYRO_UNITS[quantity][gyro_unit]
    force = 9.8 * per_sample / ACCEL_UNITS[quantity][accel_unit]
    for k in range(1, 41):
        stamp = f"{(begin_s + k / 10) / TIME_UNITS[time_unit]:.17g}"
        if time_unit == "iso":
            stamp = f"2026-01-01T00:00:{k / 10:06.3f}"
        yield [stamp, *(f"{x:.17g}" for x in (0.0, rate * 0.85, rate * 0.53, 0.0, 0.0, force))]


def _change_rows(draw: st.DrawFn, rows: list[list[str]]) -> bytes:
    """Return rows as text, with some rows, cells and bytes changed."""
    rows = [list(row) for row in rows]
    for _ in range(draw(st.integers(0, 3))):
        index = draw(st.integers(0, len(rows) - 1))
        kind = draw(st.sampled_from(["cell"] * 3 + ["double", "swap", "cut", "add", "gap"]))
        row = rows[index]
        if kind == "cell" and row:
            cell = draw(st.sampled_from(CELLS) | st.floats().map(str))
            row[draw(st.integers(0, len(row) - 1))] = cell
        elif kind == "gap":
            rows[index : index + draw(st.integers(1, 30))] = [[]]
        elif kind == "double":
            rows.insert(index, list(row))
        elif kind == "swap":
            rows[index], rows[-1] = rows[-1], rows[index]
        elif kind == "cut":
            rows[index] = row[: draw(st.integers(0, max(0, len(row) - 1)))]
        elif kind == "add":
            rows[index] = [*row, draw(st.sampled_from(CELLS))]
    delimiter = draw(st.sampled_from([",", ",", ",", ";", "\t", " ", ", "]))
    end = draw(st.sampled_from(["\n", "\n", "\r\n", "\r"]))
    text = end.join(delimiter.join(row) for row in rows) + draw(st.sampled_from([end, ""]))
    content = text.encode("utf-8", "replace")
    return draw(mangle_bytes(HiddenValue(content))) if draw(st.integers(0, 3)) == 0 else content

"""Run the golden studies, each in its own process, and reduce results to numbers that diff well.

    python tests/golden/golden_studies.py STUDY FOLDER DEVICES

runs a study into an empty folder and prints its results as JSON: `run_alone` calls it, with an
environment of its own. It uses only what `sinsjax.__all__` names.
"""

import json
import os
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

HERE = Path(__file__).parent
NAMES = sorted(path.stem for path in (HERE / "studies").glob("*.toml"))
"""The golden studies; each is a file in `studies/`."""

DIGITS = 12
"""Significant digits of the numbers in expected files."""

ENVIRONMENT = {
    "JAX_PLATFORMS": "cpu",
    "XLA_FLAGS": "--xla_cpu_max_isa=SSE4_2",
    "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
}
"""What makes the numbers those of the formulas alone, the same on all machines of x86.

AVX2 and AVX-512 fuse products with sums, where XLA's own fusions let them: the sensors' noise, in
single precision, then differs in its last bits, and a heading by 1e-7 of itself. Without them a
program gives the same numbers whether it is optimised or not, and what is not compiles fast.
"""

_OTHERS = ("JAX_", "XLA_", "SINSJAX_XLA_")
_LEAST = 1e-3  # a column of smaller numbers counts as this large: shares of 1e-300 are nothing
_QUANTILES = (0.0, 0.25, 0.5, 0.75, 1.0)

Recorded = dict[str, Any]
"""A study's results: ``jaxlib``, and ``tables`` with their ``rows`` and ``columns`` by name."""


def run_alone(name: str, folder: Path, devices: int = 1) -> Recorded:
    """Run a golden study in a process of its own, with options of its own: `ENVIRONMENT`.

    Args:
        name: of the study.
        folder: where it may write.
        devices: threads that run it; the numbers are the same with any.
    """
    inherited = {key: value for key, value in os.environ.items() if not key.startswith(_OTHERS)}
    own = ENVIRONMENT | {"PYTHONPATH": str(HERE.parents[1])}
    done = subprocess.run(
        [sys.executable, __file__, name, folder, str(devices)],
        env=inherited | own,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, f"{name} does not run:\n{done.stderr}"
    return json.loads(done.stdout)


def expected(name: str) -> Recorded:
    """Return the expected results of a golden study."""
    return json.loads(expected_file(name).read_text("utf-8"))


def expected_file(name: str) -> Path:
    """Return the path of a study's expected results."""
    return HERE / "expected" / f"{name}.json"


def as_json(recorded: Recorded) -> str:
    """Return the text of an expected file: sorted, one line per column."""
    tables = []
    for name, table in sorted(recorded["tables"].items()):
        columns = [
            f"   {json.dumps(column)}: {json.dumps(summary, sort_keys=True, allow_nan=False)}"
            for column, summary in sorted(table["columns"].items())
        ]
        head = f'  "{name}": {{"rows": {table["rows"]}, "columns": {{\n'
        tables.append(head + ",\n".join(columns) + "}}")
    head = f'{{"jaxlib": "{recorded["jaxlib"]}",\n "tables": {{\n'
    return head + ",\n".join(tables) + "}}\n"


def differences(
    old: Recorded,
    new: Recorded,
    tolerance: float,
    renamed: Mapping[str, str] | None = None,
    added: Collection[str] = (),
) -> list[str]:
    """List the differences between two results of a study, one line per column.

    Args:
        old: the expected ones.
        new: those to judge.
        tolerance: of numbers, relative to the largest one of their column.
        renamed: new names of columns, by the old ones.
        added: columns that are new.
    """
    lines = []
    for name in sorted({*old["tables"], *new["tables"]}):
        was, now = old["tables"].get(name), new["tables"].get(name)
        if was is None or now is None:
            lines.append(f"{name}: is {'new' if was is None else 'missing'}")
            continue
        if was["rows"] != now["rows"]:
            lines.append(f"{name}: had {was['rows']} rows, has {now['rows']}")
        before = {(renamed or {}).get(key, key): one for key, one in was["columns"].items()}
        for column in sorted({*before, *now["columns"]} - ({*added} - {*before})):
            change = _change(before.get(column), now["columns"].get(column), tolerance)
            lines += [f"{name}: {column}: {change}"] if change else []
    return lines


def _change(was: Any, now: Any, tolerance: float) -> str:
    """Describe the largest change of a column; empty if there is none."""
    if was is None or now is None:
        return f"is new ({now['kind']})" if was is None else f"is missing (was {was['kind']})"
    one, other = dict(_parts(was)), dict(_parts(now))
    numbers = [abs(value) for value in one.values() if isinstance(value, float)]
    largest = max([_LEAST, *numbers])
    changes = {}
    for part in {**one, **other}:
        a, b = one.get(part), other.get(part)
        if isinstance(a, float) and isinstance(b, float):
            by = abs(b - a) / largest
        else:
            by = 0.0 if a == b else float("inf")
        if by > tolerance:
            changes[part] = by
    if not changes:
        return ""
    worst = max(changes, key=lambda part: changes[part])
    by = f" (by {changes[worst]:.1e} of the largest)" if changes[worst] < float("inf") else ""
    text = f"{worst} was {one.get(worst)!r}, is {other.get(worst)!r}{by}"
    return f"{text}; {len(changes)} of its {len(one)} numbers differ"


def _parts(summary: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every number and word of a column's summary, by its place: ``quantiles[2]``."""
    if isinstance(summary, dict):
        for key, value in summary.items():
            yield from _parts(value, f"{place} {key}".strip())
    elif isinstance(summary, list):
        for number, value in enumerate(summary):
            yield from _parts(value, f"{place}[{number}]")
    else:
        yield place, summary


def summarised(table: pa.Table) -> dict[str, Any]:
    """Return the number of rows of a table and a summary of each column, by name."""
    columns = {name: _column(table[name]) for name in table.column_names}
    return {"rows": table.num_rows, "columns": columns}


def _column(column: pa.ChunkedArray) -> dict[str, Any]:
    """Summarise a column: kind, nulls, three values, and quantiles and mean or counts."""
    values, kind = column.to_pylist(), column.type
    places = (0, len(values) // 2, len(values) - 1)
    summary: dict[str, Any] = {
        "kind": str(kind),
        "nulls": column.null_count,
        "sample": [_rounded(values[place]) for place in places],
    }
    known = [value for value in values if value is not None]
    if pa.types.is_list(kind):
        summary["kind"] = f"list of {kind.value_type}"
        summary["lengths"] = _counts(map(len, known))
        known = [entry for value in known for entry in value]
    if pa.types.is_string(kind) or pa.types.is_boolean(kind):
        return summary | {"counts": _counts(known)}
    if known:
        summary["quantiles"] = [_rounded(float(q)) for q in np.quantile(known, _QUANTILES)]
        summary["mean"] = _rounded(float(np.mean(known)))
    return summary


def _counts(values: Any) -> dict[str, int]:
    return {str(value): count for value, count in sorted(Counter(values).items())}


def _rounded(value: Any) -> Any:
    """Round a number to `DIGITS` significant digits; leave anything else as it is."""
    if isinstance(value, list):
        return [_rounded(entry) for entry in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def write_record(folder: Path) -> tuple[Path, Path]:
    """Write the record of the study ``recorded`` and its reference, without the package.

    40 s of a tilted base whose heading swings, its axes front-right-down, and two samples that are
    missing. Rates are those in the middle of a sample, times those of its end.
    """
    rate, latitude, earth = 50.0, np.radians(48.1), np.radians(15.041067 / 3600)
    end_s = np.arange(1, 40 * rate + 1) / rate
    time_s, turn = end_s - 0.5 / rate, 2 * np.pi / 7
    yaw = np.radians(-35 + 3 * np.sin(turn * time_s))
    yaw_rate = np.radians(3 * turn * np.cos(turn * time_s))
    pitch, roll = np.radians([2.0, -1.5])
    about_x = np.array(
        [[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]]
    )
    about_y = np.array(
        [[np.cos(roll), 0, np.sin(roll)], [0, 1, 0], [-np.sin(roll), 0, np.cos(roll)]]
    )
    tilt = about_x @ about_y  # from the body to level axes that turn with the heading
    north, up = earth * np.cos(latitude), earth * np.sin(latitude)
    gyro = np.column_stack([north * np.sin(yaw), north * np.cos(yaw), up + yaw_rate]) @ tilt
    accel = np.ones((len(time_s), 1)) * [0, 0, 9.81 / 9.80665] @ tilt
    noise = np.random.default_rng(17)
    gyro = np.degrees(gyro) + [1e-5, -2e-5, 1e-5] + 3e-5 * noise.normal(size=gyro.shape)
    accel = accel + [5e-5, -5e-5, 1e-4] + 1e-4 * noise.normal(size=accel.shape)
    frd = [1, 0, 2]
    columns = [5000 + 1e3 * end_s, gyro[:, frd] * [1, 1, -1], accel[:, frd] * [1, 1, -1]]
    rows = np.delete(np.column_stack(columns), [1000, 1001], axis=0)
    record, reference = folder / "record.csv", folder / "reference.csv"
    names = "time_ms,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"
    np.savetxt(record, rows, "%.12g", ",", header=names, comments="")
    heading = 35 - 3 * np.sin(turn * end_s)
    level = [np.full(len(end_s), 2.0), np.full(len(end_s), -1.5)]
    rows = np.column_stack([5 + end_s, *level, heading])
    names = "time_s,pitch_deg,roll_deg,heading_deg"
    np.savetxt(reference, rows, "%.12g", ",", header=names, comments="")
    return record, reference


def main(name: str, folder: str, devices: str) -> None:
    """Run a study in this process and print its summarised tables as JSON."""
    import sinsjax

    sinsjax.configure(devices=int(devices))
    file, out = HERE / "studies" / f"{name}.toml", Path(folder, "out")
    study, settings = sinsjax.load_study(file), tomllib.loads(file.read_text("utf-8"))["study"]
    stored = None
    if name == "recorded":
        stored = sinsjax.load_increments(study, *write_record(Path(folder)))
    sinsjax.run_into(study, out, stored)
    tables = {}
    if settings["estimate"] == "covariance":
        tables["estimates"] = sinsjax.read_estimates(out)
        tables["bound"] = sinsjax.information_bound(study)
    else:
        tables["summary"] = sinsjax.read_summary(out)
    if settings["curves"]:
        tables["curves"] = sinsjax.read_curves(out)
    summaries = {table: summarised(rows) for table, rows in tables.items()}
    print(json.dumps({"jaxlib": version("jaxlib"), "tables": summaries}))


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Run the golden studies, each in its own process, and reduce results to numbers that diff well.

    python tests/golden/golden_studies.py NAME FOLDER

runs a study, or what else `NAMES` lists, in an empty folder and prints its results as JSON:
`run_alone` calls it, with an environment of its own. It uses only commands and what
`sinsjax.__all__` names.
"""

import json
import os
import re
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import redirect_stdout, suppress
from html import unescape
from importlib.metadata import version
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pyarrow as pa
import pyarrow.csv

HERE = Path(__file__).parent
STUDIES = sorted(path.stem for path in (HERE / "studies").glob("*.toml"))
"""The golden studies; each is a file in `studies/`."""

TUNING, BOUND, ADVICE, SCORE = "tuning", "bound", "advice", "score"
NAMES = [*STUDIES, ADVICE, SCORE]
"""Everything with expected results: the studies, advice and schedules, and a scored program."""

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

_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:,\d{3})*(?:\.\d+)?(?:e[-+]?\d+)?")

REPORT = "report"
"""The table with the numbers of a report."""

Recorded = dict[str, Any]
"""A study's results: ``jaxlib``, and ``tables`` with their ``rows`` and ``columns`` by name."""


def run_alone(name: str, folder: Path, environment: Mapping[str, str] = ENVIRONMENT) -> Recorded:
    """Run one of `NAMES` in a process of its own, with options of JAX and XLA."""
    inherited = {key: value for key, value in os.environ.items() if not key.startswith(_OTHERS)}
    own = {**environment, "PYTHONPATH": str(HERE.parents[1])}
    done = subprocess.run(
        [sys.executable, __file__, name, folder],
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


def differences(old: Recorded, new: Recorded, tolerance: float) -> list[str]:
    """List the differences between two results of a study, one line per column.

    Numbers may differ by a tolerance, relative to the largest one of their column.
    """
    lines = []
    nothing: dict[str, Any] = {"rows": None, "columns": {}}
    for name in sorted({*old["tables"], *new["tables"]}):
        was, now = (results["tables"].get(name, nothing) for results in (old, new))
        if was["rows"] != now["rows"]:
            lines.append(f"{name}: had {was['rows']} rows, has {now['rows']}")
        for column in sorted({*was["columns"], *now["columns"]}):
            one, other = (dict(_parts(table["columns"].get(column, {}))) for table in (was, now))
            numbers = [abs(value) for value in one.values() if isinstance(value, float)]
            limit = tolerance * max([_LEAST, *numbers])
            changed = [
                f"{part} was {one.get(part)!r}, is {other.get(part)!r}"
                for part in {**one, **other}
                if not _are_close(one.get(part), other.get(part), limit)
            ]
            if changed:
                lines.append(f"{name}: {column}: {len(changed)} changes: {'; '.join(changed[:3])}")
    return lines


def _are_close(one: Any, other: Any, limit: float) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return abs(one - other) <= limit
    return one == other


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


def flattened(results: Any) -> dict[str, Any]:
    """Return the numbers of nested results as a table of one row; words are left out."""
    columns = {}
    for place, value in _parts(results):
        if isinstance(value, int | float | None):
            known = value if value is not None and np.isfinite(value) else None
            columns[place] = {"kind": type(value).__name__, "sample": [_rounded(known)]}
    return {"rows": 1, "columns": columns}


def numbers_of_tables(page: str) -> list[str]:
    """Return the numbers in the tables of an HTML page, one string per row, without words."""
    rows = re.findall("<tr>(.*?)</tr>", page, re.S)
    return [" ".join(_NUMBER.findall(unescape(re.sub("<[^>]+>", " ", row)))) for row in rows]


def run_command(*words: object) -> None:
    """Run ``sinsjax`` in this process, without its output and with figures that are not drawn."""
    from sinsjax import cli

    argv = mock.patch.object(sys, "argv", ["sinsjax", *map(str, words)])
    undrawn = mock.patch("sinsjax.plots.render_png", lambda *_: b"not drawn")
    with argv, undrawn, redirect_stdout(None), suppress(SystemExit):
        cli.main()


def reported(results: Path) -> dict[str, Any]:
    """Return the numbers in the tables of the report of some results."""
    page = results.parent / "page.html"
    run_command("report", results, "--html", page)
    rows = numbers_of_tables(page.read_text("utf-8"))
    columns = {f"row {n:02}": {"kind": "text", "sample": [row]} for n, row in enumerate(rows)}
    return {"rows": len(rows), "columns": columns}


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


def write_leveller(export: Path) -> Path:
    """Write the results of a program for an export: pitch and roll by its mean specific force."""
    lines = ["run_id,time_s,pitch_deg,roll_deg,yaw_deg,sigma_yaw_deg,study"]
    for run in pyarrow.csv.read_csv(export / "initial.csv").to_pylist():
        table = pyarrow.csv.read_csv(export / run["file"])
        x, y, z = (np.mean(table[name]) for name in table.column_names[-3:])
        pitch, roll = np.degrees([np.arctan2(y, np.hypot(x, z)), np.arctan2(-x, z)])
        yaw = 159.0 + run["run_id"]
        lines.append(f"{run['run_id']},{run['end_s']},{pitch},{roll},{yaw},2.0,{run['study']}")
    results = export.parent / "leveller.csv"
    results.write_text("\n".join(lines) + "\n")
    return results


def _study_tables(name: str, folder: Path) -> dict[str, Any]:
    """Run a study; return its summarised tables and its report."""
    import sinsjax

    file, out = HERE / "studies" / f"{name}.toml", folder / "out"
    study, settings = sinsjax.load_study(file), tomllib.loads(file.read_text("utf-8"))["study"]
    stored = sinsjax.load_increments(study, *write_record(folder)) if name == "recorded" else None
    sinsjax.run_into(study, out, stored)
    tables = {"summary": summarised(sinsjax.read_summary(out))}
    if settings["curves"]:
        tables["curves"] = summarised(sinsjax.read_curves(out))
    return tables | {REPORT: reported(out)}


def _tuning_tables(folder: Path) -> dict[str, Any]:
    """Tune a study; return its searches, its best point and what that gives on other draws."""
    import sinsjax

    out = folder / "out"
    tuned = sinsjax.tune(sinsjax.load_study(HERE / "studies" / f"{TUNING}.toml"), out)
    scores = {name: getattr(tuned, name) for name in ("score", "baseline", "law")}
    best = {"best": tuned.best} | {name: one and one._asdict() for name, one in scores.items()}
    history = summarised(sinsjax.read_history(out))
    return {"best": flattened(best), "history": history, REPORT: reported(out)}


def _bound_tables(_: Path) -> dict[str, Any]:
    """Return the information bound of a study, which needs no runs."""
    import sinsjax

    study = sinsjax.load_study(HERE / "studies" / f"{BOUND}.toml")
    return {"bound": summarised(sinsjax.information_bound(study))}


def _advice_tables() -> dict[str, Any]:
    """Return the advice for three data sheets, and reset schedules by the law."""
    import sinsjax

    sheets = {path.stem: sinsjax.advise(path) for path in sorted((HERE / "sheets").glob("*.toml"))}
    sheets["kvh1775"] = sinsjax.advise(
        imu="kvh1775", latitude_deg=55.0, time_s=200.0, motion="surging"
    )
    tables = {f"advice {name}": flattened(advice.to_dict()) for name, advice in sheets.items()}
    far_north = {"earth.latitude_deg": 60.0, "filter.r_velocity_m_per_s": 0.05}
    for name, changes in {"schedule": {}, "schedule far north": far_north}.items():
        study = sinsjax.load_study(HERE / "studies" / f"{TUNING}.toml", changes)
        plan = sinsjax.reset_schedule(study, heading_bound_deg=60.0)
        tables[name] = flattened(_numbers(plan))
    return tables


def _score_tables(folder: Path) -> dict[str, Any]:
    """Export the draws of a study and score the results of a few lines of code."""
    import sinsjax

    changes = {"axes.method": ["inertial"], "study.draws": 4, "study.curves": False}
    study = sinsjax.load_study(HERE / "studies" / "inertial.toml", changes)
    export = sinsjax.export_study(study, folder / "export")
    score = sinsjax.score_results(export, write_leveller(export))
    tables = {
        "record": summarised(pyarrow.csv.read_csv(next(iter(sorted(export.glob("imu/*")))))),
        "initial": summarised(pyarrow.csv.read_csv(export / "initial.csv").drop_columns("study")),
        "summary": summarised(score.summary),
    }
    return tables | {REPORT: reported(score.directory)}


def _numbers(value: Any) -> Any:
    """Return named tuples, at any depth, as dictionaries."""
    if hasattr(value, "_asdict"):
        return {key: _numbers(entry) for key, entry in value._asdict().items()}
    if isinstance(value, list | tuple):
        return [_numbers(entry) for entry in value]
    if isinstance(value, dict):
        return {str(key): _numbers(entry) for key, entry in value.items()}
    return value.item() if isinstance(value, np.generic) else value


def main(name: str, folder: str) -> None:
    """Run a study, or what else has a name, in this process; print its tables as JSON."""
    import sinsjax

    sinsjax.configure(devices=1)
    others = {TUNING: _tuning_tables, BOUND: _bound_tables, SCORE: _score_tables}
    if name == ADVICE:
        tables = _advice_tables()
    else:
        tables = others[name](Path(folder)) if name in others else _study_tables(name, Path(folder))
    print(json.dumps({"jaxlib": version("jaxlib"), "tables": tables}))


if __name__ == "__main__":
    main(*sys.argv[1:])

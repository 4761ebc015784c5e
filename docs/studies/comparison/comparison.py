"""Other programs and the methods of sinsjax on identical draws: every run, then the table.

    python -m docs.studies.comparison.comparison DIR --psins FOLDER [-o DOCS]

FOLDER is a copy of the PSINS toolbox, which Octave runs (Debian: ``apt install octave``);
python-ins comes from its registry (``pip install python-ins``). A program that is absent is left
out, with a line that says so. The settings of each program are the best of a few on four draws of
another seed. Everything is kept in DIR: an interrupted run continues. The table of
docs/comparison.md is printed, and written with all columns to DOCS/tables, docs by default.
"""

import argparse
import csv
import hashlib
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

import sinsjax
from sinsjax import analysis
from sinsjax.analysis import Estimate, format_estimate
from sinsjax.study.keys import is_condition_key

HERE = Path(__file__).resolve().parent
STUDY, OURS, ERROR = "arena", "sinsjax ", "phi_u_arcmin"
JUDGED = {"study.draws": 32}
CHOOSING = {"study.draws": 4, "study.seed": 2}
"""Changes to the study for the draws of the table, and for those that choose the settings."""

P0 = ("5 30", "15 80")  # deg
FILTER = tuple(f"[{r} {p0}]" for r in (0.01, 0.05) for p0 in P0)
COMPASS = ("[10 60 30 150]", "[20 30 50 300]", "[10 100 100 500]", "[5 30 20 100]")
SETTINGS = {
    "alignvn": FILTER,
    "alignvn_ekf": FILTER,
    "aligni0": ("[]",),
    "alignWahba": ("[]",),
    "aligncmps": COMPASS,
    "python-ins": ("0.1", "0.01"),
    "numpy filter": ("",),
}
"""Settings of each program that are tried, see the scripts."""


def find_programs(psins: Path | None) -> tuple[list[str], list[str]]:
    """Return the programs that are here, and versions of the packages or why they are left out."""
    names, made = ["numpy filter"], []
    octave = shutil.which("octave-cli")
    if psins is None or octave is None:
        made.append("PSINS: " + ("no --psins FOLDER" if psins is None else "no octave-cli"))
    else:
        names += [name for name in SETTINGS if name.startswith("align")]
        text = subprocess.run([octave, "--version"], capture_output=True, text=True).stdout
        digest = hashlib.sha256()  # copies differ
        for path in sorted(psins.glob("base/**/*.m")):
            digest.update(path.relative_to(psins).as_posix().encode() + path.read_bytes())
        made.append(f"PSINS (base/, sha256 {digest.hexdigest()[:8]})")
        made.append(text.splitlines()[0].removeprefix("GNU "))
    try:
        made.append(f"python-ins {version('python-ins')}")
        names.append("python-ins")
    except PackageNotFoundError:
        made.append("python-ins: not installed")
    return [name for name in SETTINGS if name in names], [*made, f"sinsjax {sinsjax.__version__}"]


def run_program(psins: Path | None, out: Path, name: str, settings: str) -> Path:
    """Return the results of a program on the exports in a folder, run unless they are there."""
    stem = re.sub(r"\W+", "_", f"{name} {settings}").strip("_")
    path, exported = out / f"{stem}.csv", export_of(out, name)
    if path.exists():
        return path
    part = path.with_suffix(".part")
    if name == "numpy filter":
        command = [sys.executable, HERE / "numpy_filter.py", exported, part]
    elif name == "python-ins":
        command = [sys.executable, HERE / "python_ins_runs.py", exported, settings, part]
    else:
        command = ["octave-cli", "--no-gui", "-q", HERE / "psins_runs.m", psins, exported, name]
        command += [settings, part]
    begun = time.monotonic()
    subprocess.run([str(word) for word in command], check=True, stdout=subprocess.DEVNULL)
    print(f"{path.stem}: {time.monotonic() - begun:.0f} s", flush=True)
    part.rename(path)
    return path


def export_of(out: Path, name: str) -> Path:
    """Return the export that a program reads."""
    return out / ("ned" if name == "python-ins" else "enu")


def export(out: Path, changes: dict[str, Any]) -> None:
    """Export the draws for MATLAB and for python-ins, with the own results, unless they exist."""
    study = sinsjax.load_study(STUDY, changes)
    sinsjax.run_into(study, out / "own", resume=(out / "own").exists())
    for folder, kind in ((out / "enu", "psins"), (out / "ned", "csv")):
        part = folder.with_suffix(".part")
        if not folder.exists():
            shutil.rmtree(part, ignore_errors=True)
            sinsjax.export_study(study, part, format=kind, frame=folder.name)
            shutil.copytree(out / "own", part / "own")
            part.rename(folder)


def score(out: Path, name: str, results: Path) -> pa.Table:
    """Return the summary of a program and of the own methods."""
    return sinsjax.score_results(export_of(out, name), results, name=name).summary


def mean_error(table: pa.Table, method: str) -> float:
    """Return the mean heading error of a method or program, arcmin; 180 deg without a result."""
    (rows,) = (r for key, r in analysis.group_rows(table, ["method"]) if key["method"] == method)
    return float(np.nan_to_num(np.abs(analysis.numeric_column(rows, ERROR)), nan=180 * 60).mean())


def run_all(
    names: list[str], psins: Path | None, out: Path, workers: int
) -> tuple[dict[str, str], dict[str, pa.Table]]:
    """Run what is missing; return the best settings of each program, and its summary."""
    choosing, judged = out / "choosing", out / "judged"
    for folder, changes in ((choosing, CHOOSING), (judged, JUDGED)):
        export(folder, changes)
    with ThreadPoolExecutor(workers) as pool:
        tried = {
            (name, settings): pool.submit(run_program, psins, choosing, name, settings)
            for name in names
            for settings in SETTINGS[name]
            if len(SETTINGS[name]) > 1
        }
        best = {name: SETTINGS[name][0] for name in names}
        for name in {name: None for name, _ in tried}:
            errors = {
                settings: mean_error(score(choosing, name, tried[name, settings].result()), name)
                for settings in SETTINGS[name]
            }
            best[name] = min(errors, key=errors.__getitem__)
        found = {n: pool.submit(run_program, psins, judged, n, best[n]) for n in names}
        return best, {name: score(judged, name, found[name].result()) for name in found}


def build_table(best: dict[str, str], tables: dict[str, pa.Table]) -> list[list[str]]:
    """Return the header, a row per program, and one per method of sinsjax."""
    first = next(iter(tables.values()))
    keys = [name for name in first.column_names if is_condition_key(name)]
    keys = [key for key in keys if len(first[key].unique()) > 1]
    points = [point for point, _ in analysis.group_rows(first, keys)]
    rows = [["program", *map(describe_condition, points), "within 40' of north (%)", "settings"]]
    for name, table in tables.items():
        groups = analysis.group_rows(table, ["method"])
        (own,) = (rows for key, rows in groups if key["method"] == name)
        rows.append([name, *error_cells(own, keys), describe_settings(name, best[name])])
    for key, own in analysis.group_rows(first, ["case", "method"]):
        if key["method"] not in SETTINGS:
            rows.append([f"{OURS}{key['case']}", *error_cells(own, keys), ""])
    return rows


def error_cells(rows: pa.Table, keys: list[str]) -> Iterator[str]:
    """Yield the mean heading error under each condition, and the share within 40' of north."""
    for _, some in analysis.group_rows(rows, keys):
        yield format_estimate(analysis.mean(np.abs(analysis.numeric_column(some, ERROR))))
    ok, draws = (analysis.numeric_column(rows, name) for name in ("ok_truth", "draw_id"))
    yield percent(analysis.share(ok > 0, draws))


def percent(one: Estimate) -> str:
    """Return a share as text, such as ``45 [43, 47]``."""
    return format_estimate(
        Estimate(100 * one.value, 100 * one.low, 100 * one.high, one.n), digits=0
    )


def describe_settings(name: str, settings: str) -> str:
    """Return the settings of a program in words, empty for none."""
    numbers = settings.strip("[]").split()
    if name in ("alignvn", "alignvn_ekf"):
        r, level, yaw = numbers
        return f"measurement noise {r} m/s; P0 of level {level} deg, of yaw {yaw} deg"
    if name == "aligncmps":
        return f"ctl0 [{' '.join(numbers[:2])}] s, ctl1 [{' '.join(numbers[2:])}] s"
    return f"measurement noise {settings} m/s once a second" if name == "python-ins" else ""


def describe_condition(values: dict[str, float]) -> str:
    """Return a condition in words."""
    base = "sway" if values["pitch_amplitude_deg"] else "still"
    start = ", ".join(f"{values[f'phi_{axis}0_deg']:g}" for axis in "enu")
    return f"{base}, ({start}) deg"


def to_markdown(header: list[str], *rows: list[str]) -> str:
    """Return the table of the page: heading errors only, equal methods of sinsjax in one row."""
    equal: dict[tuple[bool, *tuple[str, ...]], list[str]] = {}
    for name, *cells in rows:
        equal.setdefault((name.startswith(OURS), *cells[:-2]), []).append(name)
    lines = [header[:-2], ["---"] * (len(header) - 2)]
    for (_, *cells), (first, *others) in equal.items():
        names = [first, *(name.removeprefix(OURS) for name in others)]
        lines.append(["; ".join(names), *cells])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def main() -> None:
    """Run what is missing, and print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("directory", type=Path, help="of all results")
    parser.add_argument("--psins", type=Path, help="folder of the PSINS toolbox")
    parser.add_argument("--jobs", type=int, default=2, help="programs at a time")
    parser.add_argument("-o", "--out", type=Path, default=HERE.parents[1], help="folder of tables")
    given = parser.parse_args()
    names, made = find_programs(given.psins)
    rows = build_table(*run_all(names, given.psins, given.directory, given.jobs))
    print(f"{to_markdown(*rows)}\n\n*{'; '.join(made)}.*")
    (given.out / "tables").mkdir(parents=True, exist_ok=True)
    with (given.out / "tables" / "comparison_arena.csv").open("w", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


if __name__ == "__main__":
    main()

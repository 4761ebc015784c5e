"""Advice against Monte Carlo: rms, best method and dominant source of errors on 20 sheets.

    python benchmarks/advice.py -o DIR [--workers N]    runs what DIR lacks, then prints the table
    python benchmarks/advice.py -o DIR --page           also writes the table into docs/advise.md

Each task is a sheet and a method, all on the same 1,024 draws of noise, biases and first headings.
The best method is chosen on half of the draws, and both are judged on the other half.
"""

import argparse
import csv
import itertools
import json
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import sinsjax
from sinsjax.advice import advise as advising
from sinsjax.advice.heading import SOURCES, sheet_budget
from sinsjax.advice.method import choose_method, five_state
from sinsjax.advice.sheet import MOTIONS, Sheet, read_sheet, shipped_sheets
from sinsjax.methods.filters.section import level_surge
from sinsjax.report.base import Table

DRAWS, SEED, RATE_HZ = 1024, 11, 20.0
PAGE = Path(__file__).parents[1] / "docs" / "advise.md"
TABLE = PAGE.parent / "tables" / "advise.csv"
LATITUDES = (-60.0, -30.0, 0.0, 15.0, 32.0, 45.0, 48.0, 60.0, 70.0, 75.0)
TIMES = ((60.0, 120.0, 300.0), (60.0, 300.0, 600.0), (120.0, 600.0, 1800.0))
SURGE_TIMES = ((120.0, 300.0, 600.0), (300.0, 600.0, 900.0), (180.0, 600.0, 1800.0))
METHODS = (
    *("unscented", "kalman_surge", "ekf_azimuth", "invariant", "kalman10", "kalman_sincos"),
    *("kalman5", "kalman5 by the law", "gravity_fit", "compass", "inertial"),
    *("optimisation", "optimisation_position"),
)
WITHOUT_START = ("gravity_fit", "inertial", "optimisation", "optimisation_position")
MOST = 12
"""Tasks of one process, which share most of their programs."""
LARGE = 0.05
"""Share of a source that is set to zero."""
CLEAR = 1.2
"""Ratio of the two largest sources from which on the first is the largest."""
SMALL = 1e-3
"""Factor that stands for zero, so that the programs stay the same."""


class Case(NamedTuple):
    """A sheet and the times at which it is judged, s."""

    name: str
    sheet: Sheet
    motion: str
    times_s: tuple[float, ...]


def cases() -> list[Case]:
    """Return 20 sheets: shipped ones, and random ones between a laser gyro and a MEMS."""
    rng, out = np.random.default_rng(SEED), []
    shipped = [name for name in shipped_sheets() if name in ("kvh1775", "hg4930", "stim300")]
    names = [*shipped, *(f"random {k}" for k in range(1, 21 - len(shipped)))]
    for k, name in enumerate(names):
        motion = ("still", "sway", "surge")[k % 3]
        times = (SURGE_TIMES if motion == "surge" else TIMES)[k // 3 % 3]
        is_shipped = name in shipped
        sheet = read_sheet(
            None if is_shipped else random_sheet(rng),
            imu=name if is_shipped else None,
            latitude_deg=LATITUDES[k % len(LATITUDES)],
            time_s=times[-1],
            motion=motion,
        )
        out.append(Case(name, sheet, motion, times))
    return out


def random_sheet(rng: np.random.Generator) -> dict[str, Any]:
    """Return a sheet whose numbers are those of some grade, up to a factor."""
    grade = 10 ** rng.uniform(-2.5, 0.3)  # turn-on bias of the gyros, deg/h

    def number(typical: float) -> float:
        return float(f"{typical * 10 ** rng.uniform(-0.4, 0.4):.3g}")

    sensors = {
        "gyro_arw_deg_per_sqrt_h": number(0.1 * grade**0.8),
        "gyro_instability_deg_per_h": number(0.3 * grade),
        "accel_vrw_ug_per_sqrt_hz": number(40 * grade**0.25),
        "accel_instability_ug": number(30 * grade**0.3),
    }
    drawn = {
        "gyro_bias_deg_per_h": {"normal": [0.0, number(grade)]},
        "accel_bias_ug": {"normal": [0.0, number(500 * grade**0.4)]},
    }
    return {"earth": {}, "sensors": sensors, "drawn": drawn}


def sections(sheet: Sheet, method: str) -> dict[str, Any]:
    """Return the settings of a method: the sheet's own noise, and R of its motion."""
    if method == "gravity_fit":
        quiet = replace(sheet, tables=sheet.tables | {"motion": still_surge(sheet)})
        return choose_method(quiet).sections
    made: dict[str, Any] = {"alignment": {"method": method.removesuffix(" by the law")}}
    if method not in (*WITHOUT_START, "compass"):
        made["filter"] = five_state(sheet)["filter"]
    if method == "kalman10":
        made["filter"] = made["filter"] | {
            "p0_gyro_bias_deg_per_h": sheet.sigma("gyro_bias_deg_per_h"),
            "p0_accel_bias_ug": sheet.sigma("accel_bias_ug"),
        }
    if method == "kalman_surge":
        surge = level_surge(sheet.tables["motion"].get("surge_m_per_s")) or 0.01
        made["surge"] = {"r_surge_m_per_s": surge, "r_surge_time_s": 5.0}
    if method.endswith("law"):
        made["resets"] = {"schedule": "law", "settle_band_arcmin": 600.0}
    return made


def still_surge(sheet: Sheet) -> dict[str, Any]:
    """Return the motion of a sheet without surge."""
    return {k: v for k, v in sheet.tables["motion"].items() if not k.startswith("surge")}


def run_task(case: Case, method: str, source: str, file: Path) -> None:
    """Write the heading errors (times, draws), arcmin, of a method with a source set to zero."""
    sheet = advising.scale_source(case.sheet, source, SMALL) if source else case.sheet
    made = sections(sheet, method)
    if method not in WITHOUT_START:
        made["alignment"] = made["alignment"] | {"misalignment": "euler"}
        drawn = {"phi_u0_deg": {"uniform": [-180.0, 180.0]}, "phi_e0_deg": {"normal": [0.0, 2.0]}}
        made["drawn"] = sheet.tables["drawn"] | drawn
    *before, end = case.times_s
    study = sheet.study(
        made, rate_hz=RATE_HZ, duration_s=end, report_times_s=before, draws=DRAWS, seed=SEED
    )
    summary = sinsjax.run(study).summary
    names = [f"phi_u_at_{time:g}_arcmin" for time in before] + ["phi_u_arcmin"]
    errors = np.array([np.asarray(summary[name], float) for name in names])
    np.save(file, errors.astype(np.float32))


def tasks(given: list[Case]) -> list[tuple[int, str, str]]:
    """Return sheet, method and source of every task, alike programs next to each other."""
    out = [(k, method, "") for method in METHODS for k in by_motion(given)]
    for k in by_motion(given):
        budget, times = sheet_budget(given[k].sheet, given[k].times_s), given[k].times_s
        largest = {s: max(budget.shares(time)[s] for time in times) for s in budget.sources}
        method = choose_method(given[k].sheet).method
        out += [(k, method, source) for source, share in largest.items() if share > LARGE]
    return out


def by_motion(given: list[Case]) -> list[int]:
    """Return the numbers of the sheets, those of a motion together."""
    return sorted(range(len(given)), key=lambda k: (list(MOTIONS).index(given[k].motion), k))


def file_of(folder: Path, task: tuple[int, str, str]) -> Path:
    """Return the file of a task's errors."""
    return folder / ("_".join(map(str, task)).replace(" ", "-") + ".npy")


def rms(errors: np.ndarray) -> float:
    """Return the rms of some errors, arcmin; those without a heading are left out."""
    return float(np.sqrt(np.nanmean(np.square(errors.astype(float)))))


def interval(errors: np.ndarray) -> tuple[float, float]:
    """Return the 95 % interval of an rms by a bootstrap over draws."""
    picks = np.random.default_rng(1).integers(0, len(errors), (400, len(errors)))
    low, high = np.nanquantile([rms(errors[pick]) for pick in picks], [0.025, 0.975])
    return float(low), float(high)


class Row(NamedTuple):
    """A cell of the table."""

    name: str
    motion: str
    latitude_deg: float
    time_s: float
    method: str
    predicted: float
    measured: float
    low: float
    high: float
    best: str
    loss: float
    dominant: str
    ratio: float
    found: str
    is_right: bool


def rows(folder: Path, given: list[Case]) -> list[Row]:
    """Return the table, a row per sheet and time."""
    out = []
    for k, case in enumerate(given):
        budget, choice = sheet_budget(case.sheet, case.times_s), choose_method(case.sheet)
        chosen = choice.method
        errors = {
            method: np.load(file)
            for method in METHODS
            if (file := file_of(folder, (k, method, ""))).exists()
        }
        for place, time in enumerate(case.times_s):
            half = {method: rms(found[place, ::2]) for method, found in errors.items()}
            best = min(half, key=half.__getitem__)
            here = errors[chosen][place]
            loss = rms(here[1::2]) / rms(errors[best][place, 1::2])
            shares = budget.shares(time)
            first, second = itertools.islice([*shares.items(), ("", 0.0)], 2)
            zeroed = {
                source: rms(np.load(file)[place])
                for source in shares
                if (file := file_of(folder, (k, chosen, source))).exists()
            }
            found = min(zeroed, key=zeroed.__getitem__, default="")
            heading = advising.expect_heading(choice, time, float(budget.sigma[place]))
            out.append(
                Row(
                    case.name,
                    case.motion,
                    float(case.sheet.tables["earth"]["latitude_deg"]),
                    time,
                    chosen,
                    heading.rms_arcmin,
                    rms(here),
                    *interval(here),
                    best,
                    loss,
                    first[0],
                    first[1] / second[1] if second[1] else np.inf,
                    found,
                    found == first[0],
                )
            )
    return out


def table(found: list[Row]) -> Table:
    """Return the cells as a table of text."""
    head = (
        *("sheet", "motion", "latitude (deg)", "time (s)", "advised", "rms by advice (')"),
        *("measured (')", "ratio", "best method", "advised over best"),
        *("largest source", "largest by sweep"),
    )
    lines = []
    for row in found:
        cells = (
            *(row.name, row.motion, f"{row.latitude_deg:g}", f"{row.time_s:g}", row.method),
            f"{row.predicted:.3g}",
            f"{row.measured:.3g} [{row.low:.3g}, {row.high:.3g}]",
            f"{row.predicted / row.measured:.2f}",
            row.best,
            f"{row.loss:.2f}",
            SOURCES[row.dominant] if row.ratio > CLEAR else "no clear one",
            SOURCES[row.found] if row.found else "-",
        )
        lines.append(cells)
    return Table(f"{len(found)} cells", head, lines)


def count_right(found: list[Row]) -> str:
    """Return how many cells are right, as Markdown."""
    close = sum(abs(row.predicted / row.measured - 1) <= 0.15 for row in found)
    good = sum(row.loss <= 1.1 for row in found)
    clear = [row for row in found if row.ratio > CLEAR and row.found]
    right = sum(row.is_right for row in clear)
    count = len(found)
    return (
        f"\nRms within 15 %: {close} of {count} cells. Advised method within 10 % of the best"
        f" one: {good} of {count}.\nLargest source right: {right} of {len(clear)} cells where it"
        f" is more than {CLEAR:g} times the second. [The {count} cells](tables/{TABLE.name})\n\n"
    )


def main() -> None:
    """Run the tasks that are not done, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--page", action="store_true", help="write docs/advise.md and its table")
    parser.add_argument("--tasks", help="JSON list of tasks, of a worker")
    parser.add_argument("--list", action="store_true", help="count the tasks only")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    sinsjax.configure(devices=1)
    given = cases()
    if args.tasks:
        for k, method, source in json.loads(args.tasks):
            file = file_of(args.out, (k, method, source))
            if not file.exists():
                try:
                    run_task(given[k], method, source, file)
                except sinsjax.InputError as error:
                    print(f"{given[k].name}, {method}: {error}", file=sys.stderr)
        return
    todo = [task for task in tasks(given) if not file_of(args.out, task).exists()]
    print(f"{len(todo)} tasks")
    if args.list:
        return
    alike = itertools.groupby(todo, lambda task: (task[1], given[task[0]].motion, bool(task[2])))
    sets = [list(group) for _, group in alike]
    groups = [group[k : k + MOST] for group in sets for k in range(0, len(group), MOST)]
    command = [sys.executable, __file__, "-o", str(args.out), "--tasks"]
    with ThreadPoolExecutor(args.workers) as pool:
        list(pool.map(lambda group: subprocess.run([*command, json.dumps(group)]), groups))
    found = rows(args.out, given)
    text = count_right(found)
    cells = table(found)
    for line in (cells.header, *cells.rows):
        print("; ".join(line))
    print(text)
    if args.page:
        with TABLE.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([cells.header, *cells.rows])
        page = PAGE.read_text(encoding="utf-8")
        mark = r"(<!-- table -->\n).*(<!-- end of table -->)"
        PAGE.write_text(re.sub(mark, lambda m: m[1] + text + m[2], page, flags=re.S), "utf-8")


if __name__ == "__main__":
    main()

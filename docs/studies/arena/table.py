"""Other programs and the methods of sinsjax on identical draws: every run, then the table.

    python docs/studies/arena/table.py -o DIR --psins FOLDER [--page]

FOLDER is a copy of the PSINS toolbox, which Octave runs (Debian: ``apt install octave``);
python-ins comes from its registry (``pip install python-ins``). A program that is absent is left
out, with a line that says so. The settings of each program are the best of a few on four draws that
the table leaves out. Everything is kept in DIR: an interrupted run continues.
``--page`` writes the table into docs/comparison.md, and with all columns into a CSV file.
"""

import argparse
import hashlib
import re
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

import numpy as np

import sinsjax
from sinsjax.analysis import format_estimate
from sinsjax.analysis.formats import format_percent
from sinsjax.arena.comparison import ConditionResult
from sinsjax.arena.score import Score, score_results
from sinsjax.report.base import Table
from sinsjax.report.study_page import TABLES_FOLDER, write_table

HERE = Path(__file__).parent
PAGE = HERE.parents[1] / "comparison.md"
TABLE = PAGE.parent / TABLES_FOLDER / "comparison_arena.csv"
STUDY = "arena"
OURS = "sinsjax "  # before the name of a method
DRAWS, LAST = 32, 36  # draws of the table, and the end of those that choose the settings

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


class Programs(NamedTuple):
    """The programs that are here.

    Attributes:
        names: of the programs.
        psins: folder of PSINS; None without it.
        versions: of each package, in words.
        absent: why others are left out.
    """

    names: list[str]
    psins: Path | None
    versions: list[str]
    absent: list[str]


def find_programs(psins: Path | None) -> Programs:
    """Return the programs that can be run here."""
    names, versions, absent = ["numpy filter"], [], []
    octave = shutil.which("octave-cli")
    if psins is None or octave is None:
        absent.append("PSINS: " + ("no --psins FOLDER" if psins is None else "no octave-cli"))
    else:
        names += [name for name in SETTINGS if name.startswith("align")]
        text = subprocess.run([octave, "--version"], capture_output=True, text=True).stdout
        versions += [f"PSINS {digest_of(psins)}", text.splitlines()[0].removeprefix("GNU ")]
    try:
        versions.append(f"python-ins {version('python-ins')}")
        names.append("python-ins")
    except PackageNotFoundError:
        absent.append("python-ins: not installed")
    return Programs([n for n in SETTINGS if n in names], psins, versions, absent)


def digest_of(psins: Path) -> str:
    """Return a digest of the MATLAB files of a copy of PSINS, since copies differ."""
    digest = hashlib.sha256()
    for path in sorted(psins.glob("base/**/*.m")):
        digest.update(path.relative_to(psins).as_posix().encode() + path.read_bytes())
    return f"(base/, sha256 {digest.hexdigest()[:8]})"


def run_program(
    programs: Programs, out: Path, name: str, settings: str, draws: tuple[int, int]
) -> Path:
    """Return the results of a program on some draws, run unless they are there."""
    stem = re.sub(r"\W+", "_", f"{name} {settings} {draws[0]}").strip("_")
    path = out / "results" / f"{stem}.csv"
    if path.exists():
        return path
    part = path.with_suffix(".part")
    folder = {"python-ins": "ned"}.get(name, "enu")
    span = f"{folder}_{draws[0]}"
    if name == "numpy filter":
        command = [sys.executable, HERE / "numpy_filter.py", out / span, part]
    elif name == "python-ins":
        first, last = draws[0], draws[1] - 1
        script = HERE / "python_ins_runs.py"
        command = [sys.executable, script, out / span, str(first), str(last), settings, part]
    else:
        script = HERE / "octave" / "psins_runs.m"
        numbers = f"[{draws[0]} {draws[1] - 1}]"
        command = ["octave-cli", "--no-gui", "-q", script, programs.psins, out / span, name]
        command += [numbers, settings, part]
    begun = time.monotonic()
    subprocess.run([str(word) for word in command], check=True, stdout=subprocess.DEVNULL)
    print(f"{path.stem}: {time.monotonic() - begun:.0f} s", flush=True)
    part.rename(path)
    return path


def export_draws(out: Path, draws: tuple[int, int]) -> None:
    """Export some draws for MATLAB and for python-ins."""
    study = sinsjax.load_study(STUDY)
    for frame, kind in (("enu", "psins"), ("ned", "csv")):
        folder = out / f"{frame}_{draws[0]}"
        sinsjax.export_study(study, folder, draws=draws, format=kind, frame=frame, overwrite=True)


def score(out: Path, name: str, results: Path, draws: tuple[int, int]) -> Score:
    """Return the score of a program on some draws."""
    folder = out / f"{'ned' if name == 'python-ins' else 'enu'}_{draws[0]}"
    target = out / "scores" / results.stem
    return score_results(
        folder, results, name=name, against=out / "own", out=target, overwrite=True
    )


def main() -> None:
    """Run what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, required=True, help="directory of all results")
    parser.add_argument("--psins", type=Path, help="folder of the PSINS toolbox")
    parser.add_argument("--workers", type=int, default=2, help="programs at a time")
    parser.add_argument(
        "--page", action="store_true", help="write the table into docs/comparison.md"
    )
    arguments = parser.parse_args()
    out, programs = arguments.out, find_programs(arguments.psins)
    (out / "results").mkdir(parents=True, exist_ok=True)
    own = out / "own"
    sinsjax.run_into(STUDY, own, resume=own.exists())
    choosing, judged = (DRAWS, LAST), (0, DRAWS)
    for draws in (choosing, judged):
        export_draws(out, draws)

    def run(name: str, settings: str, draws: tuple[int, int]) -> Path:
        return run_program(programs, out, name, settings, draws)

    with ThreadPoolExecutor(arguments.workers) as pool:
        tried = {
            (name, settings): pool.submit(run, name, settings, choosing)
            for name in programs.names
            for settings in SETTINGS[name]
            if len(SETTINGS[name]) > 1
        }
        best = {name: SETTINGS[name][0] for name in programs.names}
        for name in programs.names:
            errors = {
                settings: score(out, name, tried[name, settings].result(), choosing)
                for settings in SETTINGS[name]
                if (name, settings) in tried
            }
            if errors:
                best[name] = min(errors, key=lambda s: errors[s].comparison.overall.program.value)
        found = {name: pool.submit(run, name, best[name], judged) for name in programs.names}
        scores = {name: score(out, name, found[name].result(), judged) for name in found}
    table = build_table(best, scores)
    text = render(table, programs)
    print(text)
    if arguments.page:
        write_table(table, TABLE)
        page = PAGE.read_text(encoding="utf-8")
        mark = r"(<!-- table -->\n).*(<!-- end of table -->)"
        page = re.sub(mark, lambda m: m[1] + text + m[2], page, flags=re.S)
        PAGE.write_text(page, "utf-8")


def build_table(best: dict[str, str], scores: dict[str, Score]) -> Table:
    """Return a row per program, then one per method of sinsjax."""
    first = next(iter(scores.values())).comparison
    conditions = [describe_condition(result, first.keys) for result in first.conditions]
    difference = f"less {first.best}, all"
    header = ["program", *conditions, difference, "within 40' of north (%)", "settings"]
    rows = []
    for name, found in scores.items():
        result = found.comparison
        rows.append(
            [
                name,
                *(format_estimate(c.program) for c in result.conditions),
                format_estimate(result.overall.difference),
                format_percent(result.overall.success),
                describe_settings(name, best[name]),
            ]
        )
    rows += own_rows(next(iter(scores.values())), first.conditions)
    return Table("Programs on identical draws", header, rows)


def render(table: Table, programs: Programs) -> str:
    """Return the table as Markdown: a row for equal methods of sinsjax, heading errors only."""
    equal: dict[tuple[bool, *tuple[str, ...]], list[str]] = {}
    for name, *cells in table.rows:
        equal.setdefault((name.startswith(OURS), *cells[:-3]), []).append(name)
    rows = [[join_names(names), *cells] for (_, *cells), names in equal.items()]
    head, *lines = (f"| {' | '.join(cells)} |" for cells in [table.header[:-3], *rows])
    rule = f"|{' --- |' * (len(table.header) - 3)}"
    made = "; ".join([*programs.versions, f"sinsjax {sinsjax.__version__}", *programs.absent])
    return "\n".join([head, rule, *lines, "", f"*{made}.*", ""])


def join_names(names: list[str]) -> str:
    """Return the names of rows with equal cells, the prefix of the methods of sinsjax once."""
    first, *others = names
    return "; ".join([first, *(name.removeprefix(OURS) for name in others)])


def describe_settings(name: str, settings: str) -> str:
    """Return the settings of a program in words, empty for none."""
    numbers = settings.strip("[]").split()
    if name in ("alignvn", "alignvn_ekf"):
        r, level, yaw = numbers
        return f"measurement noise {r} m/s; P0 of level {level} deg, of yaw {yaw} deg"
    if name == "aligncmps":
        return f"ctl0 [{' '.join(numbers[:2])}] s, ctl1 [{' '.join(numbers[2:])}] s"
    if name == "python-ins":
        return f"measurement noise {settings} m/s once a second"
    return ""


def describe_condition(result: ConditionResult, keys: list[str]) -> str:
    """Return a condition in words."""
    assert result.point is not None
    values = dict(zip(keys, result.point, strict=True))
    base = "sway" if values["pitch_amplitude_deg"] else "still"
    start = ", ".join(f"{values[f'phi_{axis}0_deg']:g}" for axis in "enu")
    return f"{base}, ({start}) deg"


def own_rows(found: Score, conditions: list[ConditionResult]) -> list[list[str]]:
    """Return a row for each method of sinsjax."""
    table = sinsjax.read_summary(found.directory).to_pandas()
    keys = found.comparison.keys
    rows_of_cases = []
    for case in dict.fromkeys(table["case"]):
        rows = table[table["case"] == case]
        if rows["method"].iloc[0] in (found.study.study.external or ()):
            continue
        cells = []
        for condition in conditions:
            here = np.ones(len(rows), bool)
            for key, value in zip(keys, condition.point or (), strict=True):
                here &= (rows[key] == value).to_numpy()
            error = rows.loc[here, "phi_u_arcmin"].abs()
            cells.append(format_estimate(sinsjax.analysis.mean(error)))
        share = sinsjax.analysis.share(rows["ok_truth"], rows["draw_id"])
        rows_of_cases.append([f"{OURS}{case}", *cells, "", format_percent(share), ""])
    return rows_of_cases


if __name__ == "__main__":
    main()

"""Writes docs/performance.md, its figures and tables from the history alone.

Every figure in the text is taken from a row; what was not measured has no paragraph. All rows of a
machine are in a CSV file next to the page. Ways that were tried and left, with their reasons, are
in ``notes.md``, to which the page links.
"""

import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import common
import costs
import figures
import store
from store import Machine
from targets import OF_OTHERS, PER_OPERATION, Judged, judge_operations, judged

from sinsjax.bench.timing import Row
from sinsjax.errors import InputError
from sinsjax.platform.files import atomic_write
from sinsjax.plots import render_png
from sinsjax.report.base import Block, Chapter, Picture, Table, Text
from sinsjax.report.output import FIGURES_FOLDER, block_to_markdown, save_figures
from sinsjax.report.study_page import TABLES_FOLDER, write_table

PAGE = common.ROOT / "docs" / "performance.md"
PREFIX = "performance_"


def sections(machines: Sequence[Machine], notes: str) -> list[Chapter]:
    """The page, from all of the history.

    Args:
        machines: oldest version first, at least one.
        notes: where to read what was left out and why; may be empty.
    """
    newest = [machine for machine in machines if machine.version == machines[-1].version]
    cpus = [machine for machine in newest if not machine.on_gpu]
    made = [
        Chapter("Machines", compared(newest)),
        Chapter("Targets", targets(newest)),
        Chapter("All rows", [block for machine in newest for block in all_rows(machine)]),
        Chapter("Methods", methods(cpus)),
        Chapter("Where the time goes", [block for machine in cpus for block in work(machine)]),
        Chapter("Cost model", costs.cost_model(cpus)),
        Chapter("Single precision", [block for machine in cpus for block in single(machine)]),
        Chapter("Starting up", [block for machine in cpus for block in cold_start(machine)]),
        Chapter("On a GPU", [block for machine in newest for block in gpu(machine)]),
        Chapter("History", over_versions(machines)),
        Chapter("Left out", [Text(notes)] if notes else []),
    ]
    return [section for section in made if section.blocks]


HEADLINE = (
    "Speed of `kalman5` on one core in float64, compared with the hand-written limit kernel, and"
    f" runs of {costs.RUN_S} s at {costs.RATE_HZ} Hz per minute:"
)


def headline(machine: Machine) -> list[str]:
    """Return the speed on a machine as an item of a list; empty if it was not measured."""
    kernel = machine.row("pairs", "limit_kernel")
    ours = machine.row("pairs", "kalman_shared_record")
    if not (kernel and ours):
        return []
    ns = ours["ns_per_step_run"]
    return [
        f"- {machine.name}: {ns:.1f} ns per step per run, {ours['ratio']:.2f} times the kernel's"
        f" {kernel['ns_per_step_run']:.1f} ns; {costs.runs_a_minute(ns):,.0f} runs."
    ]


def compared(machines: Sequence[Machine]) -> list[Block]:
    """Cores, versions and dates of each machine."""
    note = (
        "Compare machines by ratios to the limit kernel, built for the same instruction set, not by"
        " times."
    )
    return [Text("\n".join([*map(describe_machine, machines), "", note]))]


def describe_machine(machine: Machine) -> str:
    """Return a machine's cores, versions and dates as an item of a list."""
    rows = [row for named in machine.sets.values() for row in named.values()]

    def distinct(key: str, unit: str = "") -> str:
        return " and ".join(dict.fromkeys(f"{row[key]}{unit}" for row in rows if row.get(key)))

    parts = [distinct("cores", " cores"), f"jax {distinct('jax')}"]
    if distinct("jaxlib") != distinct("jax"):
        parts.append(f"jaxlib {distinct('jaxlib')}")
    dates = sorted({row["date"] for row in rows})
    parts += [f"Python {distinct('python')}", " to ".join(dict.fromkeys((dates[0], dates[-1])))]
    return f"- {machine.name}: {', '.join(filter(None, parts))}."


TARGETS_NOTE = "Medians of turns, ± half their range; bold: missed."

METHODS_NOTE = (
    "Targets bound the time per arithmetic operation relative to `kalman` (64 variants per draw) or"
    f" `kalman_alone` (one): {OF_OTHERS:g}"
    f" ({', '.join(f'{most:g} for `{name}`' for name, most in PER_OPERATION.items())})."
    " [All rows](#all-rows) list every method."
)


def bold_if_missed(row: Judged) -> str:
    """Return the measured value, in bold if it misses its target."""
    return row.measured if row.reached else f"**{row.measured}**"


def targets(machines: Sequence[Machine]) -> list[Block]:
    """The tables of targets, except those of the time per operation, which have a section."""
    tables: list[Block] = []
    for machine in machines:
        elsewhere = judge_operations(machine).values()
        by_name: dict[str, list[Judged]] = {}
        for row in judged(machine):
            if row not in elsewhere:
                by_name.setdefault(row.group or row.what, []).append(row)
        lines = [
            [name, merge(row.target for row in rows), merge(map(bold_if_missed, rows))]
            for name, rows in by_name.items()
        ]
        if lines:
            tables.append(Table(machine.name, ["quantity", "target", "measured"], lines))
    return [Text(TARGETS_NOTE), *tables] if tables else []


def merge(cells: Iterable[str]) -> str:
    """Return cells of several rows as one, such as ``≤ 3, 4``."""
    first, *others = cells
    sign = first.partition(" ")[0] + " "
    return ", ".join([first, *(cell.removeprefix(sign) for cell in others)])


def all_rows(machine: Machine) -> list[Block]:
    """Every row in a CSV file; the short set and the loops as a figure, with the limit kernel."""
    kernel = machine.row("short", "limit_kernel")
    limit = kernel["ns_per_step_run"] if kernel else None
    blocks: list[Block] = []
    if limit:
        shown = {**machine.sets["short"], **machine.sets.get("loops", {})}
        drawn = figures.beside_limit(
            machine,
            [
                (name, row["ns_per_step_run"])
                for name, row in shown.items()
                if "ns_per_step_run" in row
            ],
            limit,
        )
        caption = f"{machine.name}; dashed: the limit kernel."
        blocks.append(Picture(f"rows_{slug(machine)}", caption, drawn))
    per_operation = judge_operations(machine)
    lines = [
        row_cells(row, limit, per_operation.get(row["name"]) if row["set"] == "methods" else None)
        for named in machine.sets.values()
        for row in named.values()
    ]
    return [*blocks, Table(machine.name, ROW_HEADER, lines, folded=True)]


ROW_HEADER = (
    *("set", "row", "ns per step per run", "times the limit kernel"),
    *("time per operation, relative", "compile (s)", "runs", "steps", "devices", "median (s)"),
    *("half range (s)", "family/model", "date", "more"),
)
"""Columns of a machine's CSV file."""

_IN_COLUMNS = {
    *("set", "name", "ns_per_step_run", "compile_s", "runs", "steps", "devices"),
    *("median_s", "spread_s", "family", "date"),
}
_CONDITIONS = {
    *("sinsjax", "cpu", "instructions", "avx512", "cores", "platform", "device"),
    *("jax", "jaxlib", "python", "fused_loop", "dtype"),
}


def row_cells(row: Row, limit: float | None, operation: Judged | None = None) -> list[str]:
    """Return a row's cells; what only some rows have is in the last one.

    Args:
        row: of the history.
        limit: ns of the limit kernel in the short set; None without it.
        operation: the time per operation and its target; None if it has none.
    """
    ns = row.get("ns_per_step_run")
    keys = ("compile_s", "runs", "steps", "devices", "median_s", "spread_s", "family", "date")
    more = "; ".join(
        f"{key} {value}"
        for key, value in row.items()
        if key not in _IN_COLUMNS | _CONDITIONS and value is not None
    )
    return [
        row["set"],
        row["name"],
        "" if ns is None else f"{ns:g}",
        f"{ns / limit:.2f}" if ns and limit and row["set"] in ("short", "loops") else "",
        operation.measured if operation else "",
        *(str(row.get(key, "")) for key in keys),
        more,
    ]


def work(machine: Machine) -> list[Block]:
    """Instructions, cycles, loads and stores of the engine and of the limit kernel."""
    counted = ("instructions", "cycles", "loads", "stores")
    lines = [
        [f"`{name.removeprefix('instructions_')}`", *(f"{row[key]:.1f}" for key in counted)]
        for name, row in machine.sets.get("instructions", {}).items()
    ]
    note = "Counted by perf stat in user mode, without starting and compiling."
    header = ["row", *counted]
    return [Table(f"Per step and run, {machine.name}", header, lines, note)] if lines else []


def methods(machines: Sequence[Machine]) -> list[Block]:
    """Range of the cost of a step, and the methods that miss their target per operation."""
    items = []
    for machine in machines:
        if not (found := judge_operations(machine)):
            continue
        by_cost = sorted(
            machine.sets["methods"].items(), key=lambda item: item[1]["ns_per_step_run"]
        )
        least, most = (
            f"{number(row['ns_per_step_run'])} ns (`{name}`)"
            for name, row in (by_cost[0], by_cost[-1])
        )
        missed = [f"`{name}` ({row.measured})" for name, row in found.items() if not row.reached]
        items.append(
            f"- {machine.name}: {least} to {most} per step per run; "
            + (f"targets missed by {', '.join(missed)}." if missed else "all targets reached.")
        )
    return [Text("\n".join([METHODS_NOTE, "", *items]))] if items else []


def single(machine: Machine) -> list[Block]:
    """Gain of single precision, and the errors that it would cause."""
    row = machine.row("single_precision", "single_precision")
    if row is None:
        return []
    shares, worst = row["settle_changed_share"], row["settle_changed_s"]
    return [
        Text(
            "Not offered. With covariance and error states in float32 a step takes"
            f" {row['ratio']:.2f} ± {row['ratio_spread']:.2f} times as long, but over the default"
            f" sweep the final heading error changes by up to {row['phi_u_arcmin_max']:g} arcmin,"
            f" and {100 * min(shares):.1f} to {100 * max(shares):.1f} % of the settling times by up"
            f" to {max(worst):g} s: as much as the differences that a sweep measures."
        )
    ]


def number(value: float, digits: int = 1) -> str:
    """A number without decimals that say nothing."""
    return f"{value:,.{digits if value < 100 else 0}f}"


def slug(machine: Machine) -> str:
    """The machine's name as part of a file name."""
    row = next(iter(next(iter(machine.sets.values())).values()))
    return Path(store.file_name(row)).stem.partition("_")[2]


SHORT_S = 0.2
"""Phases that take less are in the CSV file only."""


def cold_start(machine: Machine) -> list[Block]:
    """Seconds of each phase before the first result."""
    rows = machine.sets.get("cold_start", {})
    whole = ("first_result", "cached")
    found = {name.removeprefix("cold_start_"): row for name, row in rows.items()}
    phases = ", ".join(
        f"{name.replace('_', ' ')} {row['median_s']:.2f} ± {row['spread_s']:.2f}"
        for name, row in found.items()
        if name not in whole and row["median_s"] >= SHORT_S
    )
    text = (
        f"Seconds of the first cold result on {machine.name}, phases above {SHORT_S:g} s: {phases}."
    )
    return [Text(text)] if phases else []


def gpu(machine: Machine) -> list[Block]:
    """Times of the engine on a GPU, by number of runs."""
    rows = machine.sets.get("gpu", {})
    if not rows:
        return []
    by_kind: dict[str, dict[int, Row]] = {}
    for name, row in rows.items():
        _, kind, runs = name.split("_")
        by_kind.setdefault(kind, {})[int(runs)] = row
    counts = list(dict.fromkeys(runs for found in by_kind.values() for runs in found))
    lines = [
        f"{machine.name}, ns per step per run with {', '.join(f'{n:,}' for n in counts)} runs:",
        "",
    ]
    for kind, found in by_kind.items():
        lanes = ", ".join(dict.fromkeys(f"{row['lanes']:,}" for row in found.values()))
        ns = [f"{found[n]['ns_per_step_run']:.3g}" if n in found else "-" for n in counts]
        name = f"tiles of {lanes}" if kind == "tiled" else kind
        lines.append(f"- {name}: {', '.join(ns)}")
    fastest = max(rows.values(), key=lambda row: row["runs_per_s"])
    compile_s = [row["compile_s"] for row in rows.values()]
    note = (
        f"At best {fastest['runs_per_s']:,} runs of {fastest['steps']:,} steps per second."
        f" Compiling takes {min(compile_s):.1f} to {max(compile_s):.1f} s."
    )
    return [Text("\n".join(lines)), Text(note)]


LEAST_VERSIONS = 5
"""Versions from which on their history says more than the newest one."""

LEFT = "Rejected ideas, with reasons: `benchmarks/notes.md`."

_OTHER_KERNEL = """\
Ratios of 0.2.0 and 0.3.0 are to a kernel with 64-byte vectors, which gcc spilled without AVX-512:
22 ns where the kernel since takes 15.5. To that one they would be 1.4 times as large."""


def over_versions(machines: Sequence[Machine]) -> list[Block]:
    """The ratio to the limit kernel by version."""
    known = [machine for machine in machines if machine.x_limit is not None]
    if len({machine.version for machine in known}) < LEAST_VERSIONS:
        return []
    lines = []
    for machine in known:
        row = (
            machine.row("pairs", "kalman_shared_record")
            or machine.sets["short"]["kalman_shared_record"]
        )
        ns = f"{row['ns_per_step_run']:.1f}"
        lines.append([machine.version, machine.name, ns, f"{machine.x_limit:.2f}", row["date"]])
    header = ["sinsjax", "machine", "ns per step per run", "times the limit", "date"]
    caption = "`kalman_shared_record` over the limit kernel, by version."
    return [
        Picture("history", caption, figures.history(known)),
        Table("`kalman_shared_record` by version", header, lines, _OTHER_KERNEL),
    ]


def write(page: Path, machines: Sequence[Machine], notes: str) -> None:
    """Write the page, its figures and its CSV files.

    Raises:
        InputError: the history is empty, or the page cannot be written.
    """
    if not machines:
        raise InputError(f"{store.HISTORY.name}: has no rows: run benchmarks/record.py first")
    newest = machines[-1].version
    lines = [
        f"<!-- Written by: python benchmarks/page.py (benchmarks/history, sinsjax {newest});"
        " do not edit -->",
        "# Performance",
    ]
    found = [line for m in machines if m.version == newest for line in headline(m)]
    lines += [HEADLINE, "\n".join(found)] if found else []
    images = {}
    for section in sections(machines, notes):
        lines.append(f"## {section.heading}")
        for block in section.blocks:
            if isinstance(block, Table) and block.folded:
                text = write_rows(block, page.parent)
            else:
                text = block_to_markdown(block, PREFIX)
            if isinstance(block, Picture):
                text = text.replace("![]", f"![{describe_picture(block)}]", 1)
                images[f"{PREFIX}{block.name}"] = render_png(block.figure)
            lines.append(text)
    save_figures(images, page.parent / FIGURES_FOLDER)
    with atomic_write(page) as file:
        file.write(("\n\n".join(lines) + "\n").encode())


def describe_picture(picture: Picture) -> str:
    """Return the text that stands for a picture: its caption up to the first semicolon."""
    return picture.caption.partition(";")[0].replace("`", "")


def write_rows(table: Table, folder: Path) -> str:
    """Write a folded table as a CSV file, and return the line that links to it."""
    name = re.sub(r"[^a-z0-9]+", "-", table.title.lower()).strip("-")
    path = f"{TABLES_FOLDER}/{PREFIX}{name}.csv"
    write_table(table, folder / path)
    return f"- Table: [{table.title}]({path})."


def main() -> None:
    """Write docs/performance.md."""
    try:
        write(PAGE, store.machines(), LEFT)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()

"""Writes docs/performance.md and its figures from the history alone.

Every figure in the text is taken from a row; what was not measured has no paragraph. Ways that were
tried and left, with their reasons, are in ``notes.md``, to which the page links.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import common
import costs
import figures
import store
from store import Machine
from targets import judged, sizes

from sinsjax.errors import InputError
from sinsjax.platform.files import atomic_write
from sinsjax.plots import render_png
from sinsjax.report.base import Block, Chapter, Picture, Table, Text
from sinsjax.report.output import FIGURES_FOLDER, block_to_markdown, save_figures

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
        Chapter("Machines", compared(cpus)),
        Chapter("Targets", [block for machine in newest for block in targets(machine)]),
        Chapter("Beside the limit", [block for machine in cpus for block in beside_limit(machine)]),
        Chapter("Methods", [block for machine in cpus for block in methods(machine)]),
        Chapter("An answer", [block for machine in cpus for block in answers(machine)]),
        Chapter("Where the time goes", [block for machine in cpus for block in work(machine)]),
        Chapter("Single precision", [block for machine in cpus for block in single(machine)]),
        Chapter("Cost model", costs.cost_model(cpus)),
        Chapter("Starting up", [block for machine in cpus for block in cold_start(machine)]),
        Chapter("On a GPU", [block for machine in newest for block in gpu(machine)]),
        Chapter("History", over_versions(machines)),
        Chapter("Left out, and why", [Text(notes)] if notes else []),
    ]
    return [section for section in made if section.blocks]


def headline(machine: Machine) -> list[str]:
    """What was found on a machine, in a line or none."""
    kernel = machine.row("pairs", "limit_kernel")
    ours = machine.row("pairs", "kalman_shared_record")
    if not (kernel and ours):
        return []
    ns = ours["ns_per_step_run"]
    return [
        f"{machine.name}: {ns:.1f} ns a step and run on one core in float64, {ours['ratio']:.2f}"
        f" times a hand-written kernel ({kernel['ns_per_step_run']:.1f} ns); that is"
        f" {costs.runs_a_minute(ns):,.0f} runs of {costs.RUN_S} s at {costs.RATE_HZ} Hz a minute."
    ]


WIDTHS = {"AVX512": 512, "AVX2": 256, "AVX": 256, "SSE4_2": 128}
"""Bits of a vector, by instruction set."""


def compared(machines: Sequence[Machine]) -> list[Block]:
    """What the machines are: a ns on one is no ns on another."""
    header = ["machine", "family/model", "cores", "vector (bits)", "GHz", "limit kernel (ns)"]
    lines = []
    for machine in machines:
        row = next(iter(next(iter(machine.sets.values())).values()))
        kernel = machine.row("pairs", "limit_kernel") or machine.row("short", "limit_kernel")
        if "instructions" in row and kernel:
            width = WIDTHS.get(row["instructions"])
            told = (str(width or "?"), f"{row['ghz']:.2f}" if row["ghz"] else "?")
            ns = f"{kernel['ns_per_step_run']:.1f}"
            lines.append([machine.name, row["family"], str(row["cores"]), *told, ns])
    note = (
        "Times compare within a machine only: read the ratios to the limit kernel, which is built"
        " for the same instruction set. GHz as the system tells it, which need not be what the"
        " cores ran at."
    )
    return [Table("Machines measured", header, lines, note)] if lines else []


def targets(machine: Machine) -> list[Block]:
    """The table of targets."""
    header = ["what", "target", "measured", "conditions", "reached"]
    lines = [[*row[:4], "yes" if row.reached else "no"] for row in judged(machine)]
    note = f"Medians of turns, ± half their range. {conditions(machine)}"
    return [Table(f"{machine.name}", header, lines, note)] if lines else []


def conditions(machine: Machine) -> str:
    """What all rows of a machine hold under."""
    rows = [row for named in machine.sets.values() for row in named.values()]
    told = dict.fromkeys(
        f"sinsjax {row['sinsjax']}, jax {row['jax']}, jaxlib {row['jaxlib']}, Python"
        f" {row['python']}, {row['cores']} cores, XLA:CPU options in force: {row['options']}"
        for row in rows
    )
    dates = sorted({row["date"] for row in rows})
    return f"{'; '.join(told)}. Measured {' to '.join(dict.fromkeys((dates[0], dates[-1])))}."


def beside_limit(machine: Machine) -> list[Block]:
    """Every row of the short set, and the loops, beside the limit kernel."""
    kernel = machine.row("short", "limit_kernel")
    if kernel is None:
        return []
    shown = {**machine.sets["short"], **machine.sets.get("loops", {})}
    rows = {name: row for name, row in shown.items() if "ns_per_step_run" in row}
    limit = kernel["ns_per_step_run"]
    header = ["row", "ns a step and run", "times the limit", "compile (s)", "conditions"]
    lines = [
        [
            f"`{name}`",
            number(row["ns_per_step_run"]),
            number(row["ns_per_step_run"] / limit, 2),
            f"{row['compile_s']:.1f}",
            sizes(row),
        ]
        for name, row in rows.items()
    ]
    drawn = figures.beside_limit(
        machine, [(name, row["ns_per_step_run"]) for name, row in rows.items()], limit
    )
    caption = f"ns a step and run of every row, {machine.name}; dashed: the limit kernel."
    return [
        Picture(f"rows_{slug(machine)}", caption, drawn),
        Table(f"ns a step and run, {machine.name}", header, lines, "Measured in turns in one run."),
    ]


def work(machine: Machine) -> list[Block]:
    """What the processor does in the engine and in the limit kernel."""
    counted = ("instructions", "cycles", "loads", "stores")
    lines = [
        [f"`{name.removeprefix('instructions_')}`", *(f"{row[key]:.1f}" for key in counted)]
        for name, row in machine.sets.get("instructions", {}).items()
    ]
    note = "Counted by perf stat, in user mode; what starting and compiling took is left out."
    header = ["row", *counted]
    return [Table(f"A step and run, {machine.name}", header, lines, note)] if lines else []


def methods(machine: Machine) -> list[Block]:
    """What a step of each method costs, in time and in arithmetic."""
    lines = []
    for name, row in machine.sets.get("methods", {}).items():
        ratios = [f"{row[key]:.2f}" if key in row else "1" for key in ("ratio", "operations_ratio")]
        counted = row["operations"]
        speed = counted / row["ns_per_step_run"]
        ns = number(row["ns_per_step_run"])
        lines.append([f"`{name}`", ns, ratios[0], number(counted), ratios[1], f"{speed:.1f}"])
    header = ["row", "ns", "times the filter's", "operations", "times the filter's", "a ns"]
    note = (
        "Operations: arithmetic on one number that the compiled program carries out. Silent"
        " sensors; 64 variants a draw, or one, beside `kalman_alone`; medians of turns."
    )
    return [Table(f"A step and run, {machine.name}", header, lines, note)] if lines else []


def answers(machine: Machine) -> list[Block]:
    """Return the cost of an expected settling time, with draws and without."""
    lines = [
        [
            f'`estimate = "{name}"`',
            str(row["draws"] or "-"),
            f"{row['half_width_s']:.1f}",
            f"{row['cell_ms']:.0f}",
            f"{row['ratio']:.2f}",
        ]
        for name, row in machine.sets.get("cells", {}).items()
    ]
    header = ["by", "draws of a cell", "widest half interval (s)", "a cell (ms)", "times draws"]
    note = (
        "The mean settling time of each of 64 cells, eight heading errors up to 90 deg by eight"
        " schedules of two resets, 900 s at 100 Hz; draws go on by [stop_when] until every cell is"
        " known to 2 s. By covariance analysis the interval is of the 1,024 sampled errors alone;"
        " how far it holds is in the time. CPU time of one core, compiled."
    )
    return (
        [Table(f"An expected settling time, {machine.name}", header, lines, note)] if lines else []
    )


def single(machine: Machine) -> list[Block]:
    """What single precision would gain, and what it costs."""
    row = machine.row("single_precision", "single_precision")
    if row is None:
        return []
    changed = ", ".join(f"{100 * share:.1f} %" for share in row["settle_changed_share"])
    worst = ", ".join(f"{seconds:g} s" for seconds in row["settle_changed_s"])
    return [
        Text(
            "Not offered. With the covariance and the error states in float32, and navigation in"
            f" float64, a step takes {row['ratio']:.2f} times as long. Over the default sweep the"
            f" final heading error changes by up to {row['phi_u_arcmin_max']:g} arcmin (median"
            f" {row['phi_u_arcmin_median']:g}), a sigma by up to"
            f" {100 * row['sigma_share_max']:.2g} %, and {changed} of the runs settle within 60,"
            f" 10 and 3 arcmin at another time, by up to {worst}: as much as what a sweep is run"
            f" to compare. {machine.name}."
        )
    ]


def number(value: float, digits: int = 1) -> str:
    """A number without decimals that say nothing."""
    return f"{value:,.{digits if value < 100 else 0}f}"


def slug(machine: Machine) -> str:
    """The machine's name as part of a file name."""
    row = next(iter(next(iter(machine.sets.values())).values()))
    return Path(store.file_name(row)).stem.partition("_")[2]


def cold_start(machine: Machine) -> list[Block]:
    """What passes before the first result."""
    rows = machine.sets.get("cold_start", {})
    lines = [
        [f"`{name}`", f"{row['median_s']:.2f} ± {row['spread_s']:.2f}"]
        for name, row in rows.items()
    ]
    return [Table(f"Seconds, {machine.name}", ["row", "s"], lines)] if lines else []


def gpu(machine: Machine) -> list[Block]:
    """The engine's rows on a GPU."""
    lines = [
        [
            f"`{name}`",
            f"{row['runs']:,}",
            f"{row['lanes']:,}",
            f"{row['ns_per_step_run']:.3g}",
            f"{row['runs_per_s']:,}",
            f"{row['compile_s']:.1f}",
        ]
        for name, row in machine.sets.get("gpu", {}).items()
    ]
    header = ["row", "runs", "lanes a tile", "ns a step and run", "runs a second", "compile (s)"]
    return [Table(f"{machine.name}, {conditions(machine)}", header, lines)] if lines else []


LEAST_VERSIONS = 5
"""Versions from which on their history says more than the newest one."""

LEFT = "Tried and left, with the reasons: `benchmarks/notes.md`."

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
    header = ["sinsjax", "machine", "ns a step and run", "times the limit", "date"]
    caption = "`kalman_shared_record` over the limit kernel, by version."
    return [
        Picture("history", caption, figures.history(known)),
        Table("`kalman_shared_record` by version", header, lines, _OTHER_KERNEL),
    ]


def write(page: Path, machines: Sequence[Machine], notes: str) -> None:
    """Write the page, and its figures beside it.

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
    lines += ["\n".join(f"- {line}" for line in found)] if found else []
    images = {}
    for section in sections(machines, notes):
        lines.append(f"## {section.heading}")
        for block in section.blocks:
            text = block_to_markdown(block, PREFIX)
            if isinstance(block, Picture):
                text = text.replace("![]", f"![{block.caption.replace('`', '')}]", 1)
                images[f"{PREFIX}{block.name}"] = render_png(block.figure)
            lines.append(text)
    save_figures(images, page.parent / FIGURES_FOLDER)
    with atomic_write(page) as file:
        file.write(("\n\n".join(lines) + "\n").encode())


def main() -> None:
    """Write docs/performance.md."""
    try:
        write(PAGE, store.machines(), LEFT)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()

"""The cost model in words and tables: what a step of a run costs, and where that bends."""

from collections.abc import Iterator, Sequence

import figures
from store import Machine

from sinsjax.bench.timing import Row
from sinsjax.report.base import Block, Picture, Table, Text

RUN_S, RATE_HZ = 900, 100
"""The run that speeds are told for: the papers' length and rate."""

_STEPS = RUN_S * RATE_HZ
_NOISE = {"noise_off": "none", "noise_64": "64", "noise_6": "6", "noise_1": "1"}


def cost_model(machines: Sequence[Machine]) -> list[Block]:
    """The section's blocks, of the CPUs among some machines; empty without rows."""
    found: list[Block] = []
    for machine in machines:
        found += [block for make in (_speeds, _bends) for block in make(machine)]
    if figure := figures.bends(machines):
        caption = "Where the cost bends; bars: half the range of the turns."
        found.append(Picture("bends", caption, figure))
    for machine in machines:
        found += _memory(machine)
    if not found:
        return []
    formula = (
        "**time = steps x runs x ns / speed-up of the devices**, with ns a step and run from the"
        " table: it depends on the method and its readings, and on how many variants share a"
        " draw's noise, not on the schedule or the length of the runs. Compiling comes once a"
        " program on top."
    )
    return [Text(formula), *found]


def runs_a_minute(ns: float, speedup: float = 1.0) -> float:
    """How many runs of 900 s at 100 Hz a minute gives."""
    return 60e9 / (_STEPS * ns) * speedup


def speedup(machine: Machine) -> tuple[int, float] | None:
    """The most devices that were measured, and what they give; None for one or none."""
    rows = [row for row in machine.sets.get("devices", {}).values() if "speedup" in row]
    most = max(rows, key=lambda row: row["devices"], default=None)
    return (most["devices"], most["speedup"]) if most and most["devices"] > 1 else None


def _speeds(machine: Machine) -> Iterator[Block]:
    """How many runs a minute to expect."""
    shown = [(w, row) for name, w in _NOISE.items() if (row := machine.row("noise", name))]
    if not shown:
        return
    many = speedup(machine)
    header = ["variants a draw (noise)", "ns a step and run", "runs a minute, one core"]
    header += [f"{many[0]} cores"] if many else []
    lines = []
    for words, row in shown:
        ns = row["ns_per_step_run"]
        line = [words, f"{ns:.1f}", f"{runs_a_minute(ns):,.0f}"]
        lines.append(line + ([f"{runs_a_minute(ns, many[1]):,.0f}"] if many else []))
    note = f"Runs of {RUN_S} s at {RATE_HZ} Hz, {_STEPS:,} steps each."
    if many:
        note += f" The last column is the one before it times {many[1]:.2f}, the measured speed-up."
    yield Table(f"Runs a minute to expect, {machine.name}", header, lines, note)


def _bends(machine: Machine) -> Iterator[Block]:
    """What each size does, in a list."""
    points = [*_lanes(machine), *_tiles(machine), *_variants(machine), *_curves(machine)]
    points += _devices(machine)
    if points:
        yield Text("\n".join([f"Where it bends on {machine.name}:", "", *points]))


def _ns(row: Row) -> str:
    return f"{row['ns_per_step_run']:.1f} ns"


def _of(machine: Machine, prefix: str) -> list[tuple[int, Row]]:
    panel = next(panel for panel in figures.PANELS if panel.prefix == prefix)
    return list(zip(*panel.points(machine), strict=True))


def _lanes(machine: Machine) -> Iterator[str]:
    if found := _of(machine, "lanes_"):
        least, most = found[0], found[-1]
        best = min(found, key=lambda point: point[1]["ns_per_step_run"])
        used = dict(found).get(64)
        yield (
            f"- *Lanes a tile:* {least[0]} take {_ns(least[1])}, {most[0]} take {_ns(most[1])}; the"
            f" best count is {best[0]} with {_ns(best[1])}"
            + (f", the engine's 64 take {_ns(used)}" if used and best[0] != 64 else "")
            + ". Few lanes share the fixed cost of a step; many push its state out of the"
            " first-level cache."
        )


def _tiles(machine: Machine) -> Iterator[str]:
    if len(found := _of(machine, "tiles_")) > 1:
        ns = [row["ns_per_step_run"] for _, row in found]
        yield (
            f"- *Tiles a call:* from {found[0][0]} to {found[-1][0]} of them, {min(ns):.1f} to"
            f" {max(ns):.1f} ns."
        )


def _variants(machine: Machine) -> Iterator[str]:
    if found := _of(machine, "variants_"):
        told = ", ".join(f"{count}: {_ns(row)}" for count, row in found)
        yield (
            f"- *Variants a draw, with noise:* {told}. Noise is drawn once a draw and handed to its"
            " variants."
        )


def _curves(machine: Machine) -> Iterator[str]:
    on, off = (machine.row("throughput", f"curves_{word}") for word in ("on", "off"))
    if on and off:
        yield f"- *Curves:* kept at every record {_ns(on)}, not kept {_ns(off)}."


def _devices(machine: Machine) -> Iterator[str]:
    if many := speedup(machine):
        yield f"- *Devices:* {many[0]} give {many[1]:.2f} times the speed of one."
    for row in machine.sets.get("devices", {}).values():
        if "share" in row:
            yield (
                f"- *Whole `sweep`:* {row['runs']:,} runs of {row['steps']:,} steps into Parquet"
                f" keep {100 * row['share']:.0f} % of the compiled call's throughput."
            )


def _memory(machine: Machine) -> Iterator[Block]:
    """What a run takes in the compiled call, and what a whole sweep takes."""
    rows = machine.sets.get("memory", {}).items()
    header = ["row", "runs", "steps", "bytes a run"]
    lines = [
        [*_sizes(name, row), f"{row['bytes_per_run']:,}"]
        for name, row in rows
        if "bytes_per_run" in row
    ]
    if lines:
        note = "Arguments, results and temporaries of one call."
        yield Table(f"Memory of the compiled call, {machine.name}", header, lines, note)
    header = ["row", "runs", "steps", "before (MiB)", "peak (MiB)"]
    lines = [
        [*_sizes(name, row), f"{row['before_mib']:,}", f"{row['peak_mib']:,}"]
        for name, row in rows
        if "peak_mib" in row
    ]
    if lines:
        note = "Of a process that sweeps into Parquet; before: with the package imported."
        yield Table(f"Memory of `sweep`, {machine.name}", header, lines, note)


def _sizes(name: str, row: Row) -> list[str]:
    return [f"`{name}`", f"{row['runs']:,}", f"{row['steps']:,}"]

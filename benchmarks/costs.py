"""The cost model in words and tables: cost of a step of a run, and where it bends."""

from collections.abc import Iterator, Sequence

import figures
from store import Machine

from sinsjax.bench.timing import Row
from sinsjax.report.base import Block, Picture, Text

RUN_S, RATE_HZ = 900, 100
"""The run that speeds are given for: the papers' length and rate."""

_STEPS = RUN_S * RATE_HZ
_NOISE = {"noise_off": "no noise", "noise_64": "64", "noise_6": "6", "noise_1": "1"}


def cost_model(machines: Sequence[Machine]) -> list[Block]:
    """The section's blocks, of the CPUs among some machines; empty without rows."""
    found: list[Block] = []
    found += _speeds(machines)
    for machine in machines:
        found += _bends(machine)
    if figure := figures.bends(machines):
        caption = "Where the cost bends; bars: half the range of the turns."
        found.append(Picture("bends", caption, figure))
    for machine in machines:
        found += _memory(machine)
    if not found:
        return []
    formula = (
        "**time = steps x runs x ns / speed-up of the devices**, and compiling once per program."
        " ns depends on the method, its inputs and how many variants share a draw's noise, not on"
        " schedule or duration."
    )
    return [Text(formula), *found]


def runs_a_minute(ns: float, speedup: float = 1.0) -> float:
    """How many runs of 900 s at 100 Hz a minute gives."""
    return 60e9 / (_STEPS * ns) * speedup


def _speeds(machines: Sequence[Machine]) -> Iterator[Block]:
    """How many runs per minute to expect."""
    measured = [machine for machine in machines if machine.sets.get("noise")]
    shown = [name for name in _NOISE if any(machine.row("noise", name) for machine in measured)]
    if not shown:
        return
    sentences = [
        f"Runs of {RUN_S} s at {RATE_HZ} Hz per minute on one core, by variants per draw"
        f" ({', '.join(_NOISE[name] for name in shown)}):"
    ]
    for machine in measured:
        rows = [machine.row("noise", name) for name in shown]
        counts = ", ".join(
            f"{runs_a_minute(row['ns_per_step_run']):,.0f}" if row else "-" for row in rows
        )
        sentences.append(f"- {machine.name}: {counts}.")
    yield Text("\n".join([sentences[0], "", *sentences[1:]]))


def _bends(machine: Machine) -> Iterator[Block]:
    """What each size does, in a list."""
    points = [*_lanes(machine), *_tiles(machine), *_curves(machine)]
    if points:
        yield Text("\n".join([f"On {machine.name}:", "", *points]))


def _ns(row: Row) -> str:
    return f"{row['ns_per_step_run']:.1f} ns"


def _lanes(machine: Machine) -> Iterator[str]:
    if found := figures.rows_by_size(machine, "lanes_"):
        least, most = found[0], found[-1]
        best = min(found, key=lambda point: point[1]["ns_per_step_run"])
        used = dict(found).get(64)
        yield (
            f"- *Lanes per tile:* {least[0]} take {_ns(least[1])}, {most[0]} {_ns(most[1])};"
            f" the best count is {best[0]} with {_ns(best[1])}"
            + (f", the engine's 64 take {_ns(used)}" if used and best[0] != 64 else "")
            + ". Few lanes share a step's fixed cost; many overflow the first-level cache."
        )


def _tiles(machine: Machine) -> Iterator[str]:
    if len(found := figures.rows_by_size(machine, "tiles_")) > 1:
        ns = [row["ns_per_step_run"] for _, row in found]
        yield (
            f"- *Tiles per call:* {found[0][0]} to {found[-1][0]} take {min(ns):.1f} to"
            f" {max(ns):.1f} ns."
        )


def _curves(machine: Machine) -> Iterator[str]:
    on, off = (machine.row("throughput", f"curves_{word}") for word in ("on", "off"))
    if on and off:
        yield f"- *Curves:* kept {_ns(on)}, not kept {_ns(off)}."


def _memory(machine: Machine) -> Iterator[Block]:
    """Memory of a run in the compiled call, and of a whole sweep."""
    rows = machine.sets.get("memory", {})
    calls = {name: row for name, row in rows.items() if "bytes_per_run" in row}
    sweeps = [row for row in rows.values() if "peak_mib" in row]
    plain = [row for name, row in calls.items() if not name.endswith("_curves")]
    curves = [row for name, row in calls.items() if name.endswith("_curves")]
    parts = []
    if plain:
        parts.append(
            f"in calls of {_listed(plain, 'runs')} runs a run takes"
            f" {_listed(plain, 'bytes_per_run')} bytes"
        )
    if curves:
        parts.append(f"with curves {_listed(curves, 'bytes_per_run')}")
    if sweeps:
        before = max(row["before_mib"] for row in sweeps)
        parts.append(
            f"sweeping {_listed(sweeps, 'runs')} runs into Parquet peaks at"
            f" {_listed(sweeps, 'peak_mib')} MiB ({before:,} before)"
        )
    if parts:
        yield Text(f"Memory, {machine.name}: {'; '.join(parts)}.")


def _listed(rows: Sequence[Row], key: str) -> str:
    return ", ".join(f"{row[key]:,}" for row in rows)

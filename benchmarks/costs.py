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
            f"- *Lanes per tile:* {_ns(least[1])} with {least[0]}, too few to share a step's fixed"
            f" cost, {_ns(most[1])} with {most[0]}, too many for the first-level cache; {best[0]}"
            f" are best with {_ns(best[1])}"
            + (f", the engine's 64 take {_ns(used)}." if used and best[0] != 64 else ".")
        )


def _tiles(machine: Machine) -> Iterator[str]:
    if len(found := figures.rows_by_size(machine, "tiles_")) > 1:
        ns = [row["ns_per_step_run"] for _, row in found]
        yield (
            f"- *Tiles per call:* {min(ns):.1f} to {max(ns):.1f} ns with {found[0][0]} to"
            f" {found[-1][0]} tiles."
        )


def _curves(machine: Machine) -> Iterator[str]:
    on, off = (machine.row("throughput", f"curves_{word}") for word in ("on", "off"))
    if on and off:
        yield f"- *Curves:* {_ns(on)} with curves, {_ns(off)} without."


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
            f"a run takes {_range(plain, 'bytes_per_run')} bytes in calls of"
            f" {_range(plain, 'runs')} runs"
        )
    if curves:
        parts.append(f"with curves {_range(curves, 'bytes_per_run')}")
    if sweeps:
        before = max(row["before_mib"] for row in sweeps)
        parts.append(
            f"sweeps of {_range(sweeps, 'runs')} runs into Parquet peak at"
            f" {_range(sweeps, 'peak_mib')} MiB ({before:,} before)"
        )
    if parts:
        yield Text(f"Memory on {machine.name}: {'; '.join(parts)}.")


def _range(rows: Sequence[Row], key: str) -> str:
    return " to ".join(dict.fromkeys(f"{rows[at][key]:,}" for at in (0, -1)))

"""The targets of speed, each with its measurement; one that was not measured is left out."""

from collections.abc import Iterator
from typing import NamedTuple

from store import Machine

from sinsjax.bench.timing import Row

NOISE = {64: 1.05}
"""Variants a draw, and how many times the silent row they may take."""

DISTURBED = 1.5
"""Times the row with noise alone, of surge, lever arm and bias instability, 1 variant a draw."""

BASE_NS = 120.0
"""Of a step and run with a base of its own for each draw of 2 variants, ns."""

PAIRS = {
    "kalman_shared_record": {"AVX512": 1.45, "AVX2": 1.0},
    "kalman_feedback_each_sample": {"AVX512": 2.3},
    "kalman_shared_covariance": {"AVX512": 0.75},
}
"""Times the limit kernel, by instruction set."""

BESIDE = {"kalman_noise_6": {"AVX512": 2.6}, "kalman_noise_1": {"AVX512": 3.2}}
"""The same, of rows of the short set."""

PER_OPERATION = {"kalman10": 1.6}
"""Times the time per operation of `kalman5`, of methods other than `OF_OTHERS`."""

OF_OTHERS = 1.25

OF_METHODS = {"optimisation": 0.35, "kalman_sincos": 0.55}
"""Times a step of `kalman5`, of methods that are to be quicker."""

SPEEDUP, SHARE = 1.8, 0.85

FIRST_S = {"first_result": 4.5, "cached": 2.0}
"""Seconds to the first result, with nothing compiled and with all of it."""

FIRST_RATIO, FIRST_MORE_S, REPORT_CPU_S = 1.1, 3.0, 2.0
"""Most wall time of the first command with cached programs: the first times its compiled calls,
plus the second, s; and most CPU time of its report, s."""

RESOLVED_S = {"resolve": 0.5, "part": 0.05}
"""Seconds to resolve a study of 600,000 variants, and to make a part's arguments."""

DERIVATIVE = 1.2
"""Times 1 + 2 p, or times the ratio of compiled operations, whichever is larger."""

MEMORY = 0.1
"""By how much the memory of a derivative may change with the number of steps."""


class Judged(NamedTuple):
    """A target and its measurement.

    Attributes:
        what: is measured.
        target: in words.
        measured: the number, with half the range of the turns.
        conditions: sizes and devices.
        reached: whether it is.
        group: name of the row that a page shows it in with others; empty for its own row.
    """

    what: str
    target: str
    measured: str
    conditions: str
    reached: bool
    group: str = ""


def judged(machine: Machine) -> list[Judged]:
    """The targets that a machine's rows speak of."""
    return [
        *_limit(machine),
        *_noise(machine),
        *_disturbed(machine),
        *_bases(machine),
        *_methods(machine),
        *judge_operations(machine).values(),
        *_devices(machine),
        *_start(machine),
        *_first(machine),
        *_resolved(machine),
        *_slopes(machine),
        *_tuning(machine),
    ]


def sizes(row: Row) -> str:
    """Runs, steps and devices of a row in words."""
    devices = row["devices"]
    spread = f"{devices} devices" if devices > 1 else "one core"
    runs = "1 run" if row["runs"] == 1 else f"{row['runs']:,} runs"
    return f"{runs} of {row['steps']:,} steps, {spread}"


def plus_minus(row: Row, key: str, digits: int = 2) -> str:
    """A number with half the range of its turns."""
    return f"{row[key]:.{digits}f} ± {row[f'{key}_spread']:.{digits}f}"


def _limit(machine: Machine) -> Iterator[Judged]:
    for name, targets in PAIRS.items():
        row = machine.row("pairs", name)
        most = targets.get(_set_of(row)) if row else None
        if row and most is not None:
            yield Judged(
                f"`{name}`, times the limit kernel",
                f"≤ {most:g}",
                plus_minus(row, "ratio"),
                f"{len(row['ratios'])} alternating pairs; {sizes(row)}",
                row["ratio"] <= most,
            )
    kernel = machine.row("short", "limit_kernel")
    for name, targets in BESIDE.items():
        row = machine.row("short", name)
        most = targets.get(_set_of(row)) if row else None
        if row and kernel and most is not None:
            ratio = row["ns_per_step_run"] / kernel["ns_per_step_run"]
            yield Judged(
                f"`{name}`, times the limit kernel",
                f"≤ {most:g}",
                f"{ratio:.2f}",
                f"medians of turns; {sizes(row)}",
                ratio <= most,
            )


def _set_of(row: Row) -> str:
    return "AVX512" if row["avx512"] else "AVX2"


def _noise(machine: Machine) -> Iterator[Judged]:
    for variants, most in NOISE.items():
        if row := machine.row("noise", f"noise_{variants}"):
            yield Judged(
                f"noise shared by {variants} variants, times the silent row",
                f"≤ {most:g}",
                plus_minus(row, "ratio"),
                sizes(row),
                row["ratio"] <= most,
            )


def _disturbed(machine: Machine) -> Iterator[Judged]:
    plain, row = (machine.row("noise", name) for name in ("noise_1", "disturbed_1"))
    if plain and row:
        ratio = row["ns_per_step_run"] / plain["ns_per_step_run"]
        yield Judged(
            "surge, lever arm and bias instability, 1 variant per draw, times noise alone",
            f"≤ {DISTURBED:g}",
            f"{ratio:.2f}",
            f"medians of turns; {sizes(row)}",
            ratio <= DISTURBED,
        )


def _bases(machine: Machine) -> Iterator[Judged]:
    if row := machine.row("noise", "base_2"):
        yield Judged(
            "new base motion per draw of 2 variants, per step",
            f"≤ {BASE_NS:g} ns",
            f"{row['ns_per_step_run']:.0f} ns",
            sizes(row),
            row["ns_per_step_run"] <= BASE_NS,
        )


def _methods(machine: Machine) -> Iterator[Judged]:
    for name, row in machine.sets.get("methods", {}).items():
        if name in OF_METHODS:
            yield Judged(
                f"step of `{name}`, times one of `kalman5`",
                f"≤ {OF_METHODS[name]:g}",
                plus_minus(row, "ratio"),
                sizes(row),
                row["ratio"] <= OF_METHODS[name],
            )


def judge_operations(machine: Machine) -> dict[str, Judged]:
    """Return the targets of the time per operation, by the name of the row."""
    found = {}
    for name, row in machine.sets.get("methods", {}).items():
        if "operations_ratio" in row:
            most = PER_OPERATION.get(name, OF_OTHERS)
            each = row["ratio"] / row["operations_ratio"]
            spread = row["ratio_spread"] / row["operations_ratio"]
            found[name] = Judged(
                f"`{name}`, time per operation, times that of `kalman5`",
                f"≤ {most:g}",
                f"{each:.2f} ± {spread:.2f}",
                sizes(row),
                each <= most,
            )
    return found


def _devices(machine: Machine) -> Iterator[Judged]:
    if row := machine.row("devices", "devices_2"):
        yield Judged(
            "two devices on two cores, times one",
            f"≥ {SPEEDUP:g}",
            plus_minus(row, "speedup"),
            sizes(row),
            row["speedup"] >= SPEEDUP,
        )
    for name, row in machine.sets.get("devices", {}).items():
        if name.startswith("sweep_"):
            yield Judged(
                "whole `sweep`, share of its compiled throughput",
                f"≥ {SHARE:g}",
                plus_minus(row, "share"),
                sizes(row),
                row["share"] >= SHARE,
            )


def _start(machine: Machine) -> Iterator[Judged]:
    for name, most in FIRST_S.items():
        if row := machine.row("cold_start", f"cold_start_{name}"):
            cold = "first result, cold"
            yield Judged(
                "the same, compile cache full" if name == "cached" else cold,
                f"< {most:g} s",
                f"{row['median_s']:.1f} ± {row['spread_s']:.1f} s",
                f"all of a command, {sizes(row)}",
                row["median_s"] < most,
            )


def _first(machine: Machine) -> Iterator[Judged]:
    if row := machine.row("first_command", "first_command"):
        yield Judged(
            "`sinsjax sweep reset_sweep`, compile cache full, beyond"
            f" {FIRST_RATIO:g} times its compiled calls",
            f"≤ {FIRST_MORE_S:g} s",
            f"{row['more_s']:.1f} ± {row['spread_s']:.1f} s",
            f"{row['median_s']:.1f} s of which {row['calls_s']:.1f} s are calls",
            row["more_s"] <= FIRST_MORE_S,
        )
    if row := machine.row("first_command", "report_command"):
        yield Judged(
            "`sinsjax report` of it, CPU time",
            f"≤ {REPORT_CPU_S:g} s",
            f"{row['cpu_s']:.1f} s",
            "all of the command",
            row["cpu_s"] <= REPORT_CPU_S,
        )


def _resolved(machine: Machine) -> Iterator[Judged]:
    words = {"resolve": "resolving", "part": "arguments of a part of"}
    for name, row in machine.sets.get("resolve", {}).items():
        kind, _, variants = name.partition("_")
        most = RESOLVED_S[kind]
        yield Judged(
            f"{words[kind]} {int(variants):,} variants",
            f"< {1e3 * most:g} ms",
            f"{1e3 * row['median_s']:.0f} ± {1e3 * row['spread_s']:.0f} ms",
            "one core, nothing compiled",
            row["median_s"] < most,
        )


def _slopes(machine: Machine) -> Iterator[Judged]:
    for p in range(1, 5):
        if row := machine.row("derivative", f"derivative_p{p}"):
            by_count = 1 + 2 * p
            most = DERIVATIVE * max(by_count, row.get("operations_ratio", by_count))
            yield Judged(
                f"derivative by {p} parameter{'s' if p > 1 else ''}, times a plain run",
                f"≤ {most:.1f}",
                plus_minus(row, "ratio"),
                sizes(row),
                row["ratio"] <= most,
                "derivative by 1, 2, ... parameters, times a plain run",
            )
        if row and "temp_bytes_double" in row:
            sizes_kb = [row[f"temp_bytes{key}"] / 1e3 for key in ("_half", "", "_double")]
            yield Judged(
                f"memory of a derivative by {p} over half, all, twice the steps",
                f"equal to {100 * MEMORY:g} %",
                f"{', '.join(f'{size:,.0f}' for size in sizes_kb)} kB",
                sizes(row),
                max(sizes_kb) <= (1 + MEMORY) * min(sizes_kb),
            )


def _tuning(machine: Machine) -> Iterator[Judged]:
    if row := machine.row("derivative", "tune_gradient_p2"):
        yield Judged(
            "gradient by 2 reset times, times its plain runs",
            f"≤ {row['counted']:g}",
            plus_minus(row, "ratio"),
            sizes(row),
            row["ratio"] <= row["counted"],
        )

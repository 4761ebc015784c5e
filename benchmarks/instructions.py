"""What the processor does a step and run, in the limit kernel and in the engine: why the ratio.

Counted by ``perf stat``: for the engine during its calls only, for the kernel as the difference
between a longer and a shorter run. Without perf, or where it may not count, there are no rows.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import common

from sinsjax import machine
from sinsjax.bench.limit import limit_kernel
from sinsjax.bench.timing import Row
from sinsjax.types import InputError

EVENTS = {
    "AuthenticAMD": {"loads": "ls_dispatch.ld_dispatch", "stores": "ls_dispatch.store_dispatch"},
    "GenuineIntel": {
        "loads": "mem_inst_retired.all_loads",
        "stores": "mem_inst_retired.all_stores",
    },
}
"""Names of the counters that each maker has for itself."""

BOTH = {"instructions": "instructions", "cycles": "cycles"}

VECTORS, STEPS = 32, 20000
KERNEL_REPEATS = 5
"""Times that the kernel's program runs it, to tell the best."""

RECORDS, CALLS = 90, 20

_ENGINE = """
import os, sys
from sinsjax.bench.timing import use_one_core
use_one_core()
from sinsjax.bench.cases import at_rest, default_group, engine, shortened, without_noise
change = {"shared_record": lambda g: g, "shared_covariance": at_rest}[sys.argv[1]]
case = engine("x", change(shortened(without_noise(default_group()), int(sys.argv[2]))))
with open(os.environ["COUNTING"], "w") as counting:
    print("enable", file=counting, flush=True)
    for _ in range(int(sys.argv[3])):
        case.call()
    print("disable", file=counting, flush=True)
print(case.runs * case.steps * int(sys.argv[3]))
"""
"""Runs in a process of its own, and tells perf when to count."""


def rows(quick: bool, repeats: int) -> list[Row]:
    """Count for the limit kernel, the engine, and the engine with a shared covariance.

    Returns:
        Rows with ``instructions``, ``cycles``, ``loads`` and ``stores`` a step and run.
    """
    names = EVENTS.get(machine.cpu().get("vendor_id", ""))
    perf, compiler = shutil.which("perf"), shutil.which("gcc")
    if not (names and perf and compiler):
        print("warning: nothing to count with: perf, gcc and an AMD or Intel CPU", file=sys.stderr)
        return []
    events = BOTH | names
    steps, records = (STEPS // 10, RECORDS // 10) if quick else (STEPS, RECORDS)
    made = []
    try:
        with tempfile.TemporaryDirectory(prefix="sinsjax-limit-") as folder:
            limit_kernel(compiler, folder)
            kernel = [os.path.join(folder, "limit")]
            few, _ = counted(perf, [*kernel, str(steps), str(VECTORS)], events)
            many, _ = counted(perf, [*kernel, str(2 * steps), str(VECTORS)], events)
            done = KERNEL_REPEATS * steps * VECTORS * 8
            made.append(row("instructions_limit_kernel", few, many, done))
            for case in ("shared_record", "shared_covariance"):
                command = [sys.executable, "-c", _ENGINE, case, str(records), str(CALLS)]
                counts, done = counted(perf, command, events, Path(folder) / f"{case}.fifo")
                nothing = dict.fromkeys(counts, 0)
                made.append(row(f"instructions_kalman_{case}", nothing, counts, int(done)))
    except PermissionError:
        print("warning: perf may not count here", file=sys.stderr)
        return []
    return made


def counted(
    perf: str, command: list[str], events: dict[str, str], fifo: Path | None = None
) -> tuple[dict[str, int], str]:
    """Counts of a command's user-mode events, and what it printed.

    Args:
        perf: path of the program.
        command: to count in.
        events: names of perf's events.
        fifo: where the command tells perf when to count; None counts all of it.

    Raises:
        InputError: the command failed.
        PermissionError: perf may not count here.
    """
    flags = ["-x", ";", "-e", ",".join(f"{event}:u" for event in events.values())]
    if fifo is not None:
        os.mkfifo(fifo)
        flags += ["-D", "-1", "--control", f"fifo:{fifo}"]
    ended = subprocess.run(
        [perf, "stat", *flags, "--", *command],
        capture_output=True,
        text=True,
        env=os.environ | {"COUNTING": str(fifo)},
    )
    lines = [line.split(";") for line in ended.stderr.splitlines() if line.count(";") > 2]
    counts = [line[0] for line in lines]
    if ended.returncode or len(counts) != len(events):
        raise InputError(f"perf stat: {ended.stderr.strip().splitlines()[-1]}")
    if not all(count.isdigit() for count in counts):
        raise PermissionError
    return dict(zip(events, map(int, counts), strict=True)), ended.stdout.strip()


def row(name: str, few: dict[str, int], many: dict[str, int], done: int) -> Row:
    """Counts a step and run, from those of a shorter and a longer run."""
    counts = {event: round((many[event] - few[event]) / done, 2) for event in few}
    return {"name": name, "step_runs": done} | counts


if __name__ == "__main__":
    common.main(rows)

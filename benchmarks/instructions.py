"""What the processor does a step and run, in the limit kernel and in the engine: why the ratio.

Counted by ``perf stat``: for the engine during its calls only, for the kernel as the difference
between a longer and a shorter run. Without a perf that counts there are no rows.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import common

from sinsjax.bench.limit import find_compiler, limit_kernel_workload
from sinsjax.bench.timing import Row
from sinsjax.errors import InputError
from sinsjax.platform import machine

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
from sinsjax.bench.timing import pin_to_one_core
pin_to_one_core()
from sinsjax.bench.cases import default_group, engine_workload, remove_noise
from sinsjax.bench.cases import shared_covariance_group, shorten_runs
change = {"shared_record": lambda g: g, "shared_covariance": shared_covariance_group}[sys.argv[1]]
case = engine_workload("x", change(shorten_runs(remove_noise(default_group()), int(sys.argv[2]))))
with open(os.environ["COUNTING"], "w") as counting:
    print("enable", file=counting, flush=True)
    for _ in range(int(sys.argv[3])):
        case.call()
    print("disable", file=counting, flush=True)
print(case.runs * case.steps * int(sys.argv[3]))
"""
"""Runs in a process of its own, and tells perf when to count."""

_TRIAL = """
import os, time
with open(os.environ["COUNTING"], "w") as counting:
    print("enable", file=counting, flush=True)
    until = time.monotonic() + 1
    while time.monotonic() < until:
        pass
    print("disable", file=counting, flush=True)
"""
"""The same with nothing in it: a second, in which perf takes notice."""


def rows(quick: bool, repeats: int) -> list[Row]:
    """Count for the limit kernel, the engine, and the engine with a shared covariance.

    Returns:
        Rows with ``instructions``, ``cycles``, ``loads`` and ``stores`` a step and run.
    """
    vendor = machine.cpu_info().get("vendor_id", "")
    events = BOTH | EVENTS.get(vendor, {})
    steps, records = (STEPS // 10, RECORDS // 10) if quick else (STEPS, RECORDS)
    made = []
    with tempfile.TemporaryDirectory(prefix="sinsjax-limit-") as folder:
        try:
            if vendor not in EVENTS:
                raise InputError("only the counters of AMD and Intel are known")
            gcc = find_compiler()
            # Whether perf is there says nothing: a virtual machine may lack the counters, and the
            # system may forbid them.
            counted([sys.executable, "-c", _TRIAL], events, Path(folder) / "trial.fifo")
        except InputError as error:
            print(f"warning: nothing is counted: {error}", file=sys.stderr)
            return []
        limit_kernel_workload(gcc, folder)
        kernel = [os.path.join(folder, "limit")]
        few, _ = counted([*kernel, str(steps), str(VECTORS)], events)
        many, _ = counted([*kernel, str(2 * steps), str(VECTORS)], events)
        done = KERNEL_REPEATS * steps * VECTORS * 8
        made.append(row("instructions_limit_kernel", few, many, done))
        for case in ("shared_record", "shared_covariance"):
            command = [sys.executable, "-c", _ENGINE, case, str(records), str(CALLS)]
            counts, done = counted(command, events, Path(folder) / f"{case}.fifo")
            nothing = dict.fromkeys(counts, 0)
            made.append(row(f"instructions_kalman_{case}", nothing, counts, int(done)))
    return made


def counted(
    command: list[str], events: dict[str, str], fifo: Path | None = None
) -> tuple[dict[str, int], str]:
    """Counts of a command's user-mode events, and what it printed.

    Args:
        command: to count in.
        events: names of perf's events.
        fifo: where the command tells perf when to count; None counts all of it.

    Raises:
        InputError: perf cannot be started or cannot count here, or the command failed.
    """
    flags = ["-x", ";", "-e", ",".join(f"{event}:u" for event in events.values())]
    if fifo is not None:
        os.mkfifo(fifo)
        flags += ["-D", "-1", "--control", f"fifo:{fifo}"]
    try:
        ended = subprocess.run(
            ["perf", "stat", *flags, "--", *command],
            capture_output=True,
            text=True,
            env=os.environ | {"COUNTING": str(fifo)},
        )
    except OSError as error:
        raise InputError(f"perf cannot be started: {error.strerror}") from None
    lines = [line.split(";") for line in ended.stderr.splitlines() if line.count(";") > 2]
    counts = [line[0] for line in lines]
    if ended.returncode or len(counts) != len(events):
        said = [line for line in ended.stderr.splitlines() if line.strip() not in ("", "Error:")]
        raise InputError(f"perf stat: {said[0] if said else f'exit status {ended.returncode}'}")
    for line in lines:
        if not line[0].isdigit():
            raise InputError(f"perf stat: {line[2]}: {line[0].strip('<>')}")
    return dict(zip(events, map(int, counts), strict=True)), ended.stdout.strip()


def row(name: str, few: dict[str, int], many: dict[str, int], done: int) -> Row:
    """Counts a step and run, from those of a shorter and a longer run."""
    counts = {event: round((many[event] - few[event]) / done, 2) for event in few}
    return {"name": name, "step_runs": done} | counts


if __name__ == "__main__":
    common.main(rows)

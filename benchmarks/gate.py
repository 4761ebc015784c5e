"""CI's gate: fails if the engine has fallen behind the limit kernel, by instruction set.

For each set that this machine has, a process of its own builds the kernel for it, lets XLA use no
larger one, and times `kalman_shared_record` and the kernel in alternating pairs on one core; the
median of the ratios counts. `gate.json` holds a target for each set, and the ratio last committed.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import common
import pairs

from sinsjax.bench.limit import compiler
from sinsjax.bench.timing import Row, conditions, use_one_core
from sinsjax.errors import InputError
from sinsjax.platform import machine
from sinsjax.platform.files import replacing

COMMITTED = Path(__file__).parent / "gate.json"
"""Target and committed ratio of each instruction set, and what the ratio was measured with."""

ALLOWED = 1.25
"""Times the larger of the two."""

PAIRS = 7
SETS = ("AVX512", "AVX2")

Ratios = dict[str, dict[str, Any]]


class Verdict(NamedTuple):
    """What the gate says: an exit status and a line."""

    status: int
    line: str


def judge(measured: float, instructions: str, committed: Ratios) -> Verdict:
    """Compare a median ratio with the target and the committed one.

    Args:
        measured: median ratio of the engine to the limit kernel.
        instructions: a set of `SETS`.
        committed: content of gate.json.
    """
    known = committed[instructions]
    target, ratio = known["target"], known.get("ratio", 0.0)
    told = f"{measured:.2f} x the limit with {instructions}"
    beside = f"the target of {target:.2f}" + (f", committed {ratio:.2f}" if ratio else "")
    if measured > ALLOWED * max(target, ratio):
        return Verdict(1, f"gate failed: {told} is more than {ALLOWED:g} times {beside}")
    if measured > target:
        return Verdict(0, f"gate warning: {told} is above {beside}")
    return Verdict(0, f"gate passed: {told} is within {beside}")


def unable() -> str:
    """Why the kernel cannot be built here; empty if it can."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return f"the limit kernel is for x86-64, this is {platform.machine()}"
    try:
        compiler()
    except InputError as error:
        return str(error)
    return "" if sets() else f"this processor has none of {', '.join(SETS)}"


def sets() -> list[str]:
    """The sets of `SETS` that this machine has."""
    largest = machine.instructions()
    return list(SETS[SETS.index(largest) :]) if largest in SETS else []


def measured(instructions: str) -> Row:
    """The engine's row of a set, measured in a process of its own.

    Raises:
        InputError: the kernel cannot be built or dies.
    """
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_max_isa={instructions}".strip()
    process = subprocess.run(
        [sys.executable, str(Path(__file__).resolve()), "--here"],
        env=os.environ | {"XLA_FLAGS": flags},
        stdout=subprocess.PIPE,
        text=True,
    )
    if process.returncode:
        raise InputError(f"no ratio with {instructions}: exit status {process.returncode}")
    row: Row = json.loads(process.stdout)
    return row


def here() -> Row:
    """The engine's row under the instruction set in force.

    Raises:
        InputError: the kernel cannot be built or dies.
    """
    use_one_core()
    kernel, ours = pairs.rows(False, PAIRS, ("kalman_shared_record",))
    return conditions() | ours | {"kernel_ns": kernel["ns_per_step_run"]}


def entry(row: Row, target: float) -> dict[str, Any]:
    """What gate.json keeps of a set."""
    kept = {key: row[key] for key in ("cpu", "jax", "jaxlib")}
    ratio = round(row["ratio"], 3)
    return {"target": target, "ratio": ratio, "sinsjax": common.source_version()} | kept


def gate(*, commit: bool, path: Path = COMMITTED) -> list[Verdict]:
    """Measure and judge, or measure and write the ratios down.

    Args:
        commit: whether this machine's ratios become the committed ones.
        path: of gate.json.

    Returns:
        A verdict for each set that this machine has, or one that says why there is none.

    Raises:
        InputError: the kernel cannot be built or dies, or the file cannot be written.
    """
    if why := unable():
        return [Verdict(0, f"gate skipped: {why}")]
    committed: Ratios = json.loads(path.read_text(encoding="utf-8"))
    verdicts = []
    for instructions in sets():
        row = measured(instructions)
        listed = ", ".join(f"{ratio:.2f}" for ratio in row["ratios"])
        print(f"{instructions}: limit {row['kernel_ns']} ns, engine {row['ns_per_step_run']} ns")
        print(f"ratios of {PAIRS} pairs: {listed}; median {row['ratio']:.2f}", flush=True)
        if commit:
            committed[instructions] = entry(row, committed[instructions]["target"])
            told = f"committed for {instructions}: {row['ratio']:.2f} x the limit"
            verdicts.append(Verdict(0, told))
        else:
            verdicts.append(judge(row["ratio"], instructions, committed))
    if commit:
        with replacing(path) as file:
            file.write((json.dumps(committed, indent=2, sort_keys=True) + "\n").encode())
    return verdicts


def main() -> None:
    """Print the verdicts; exit with the worst status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--commit", action="store_true", help="write this machine's ratios down")
    parser.add_argument(
        "--here", action="store_true", help="one row as JSON, with the set that XLA may use here"
    )
    flags = parser.parse_args()
    try:
        if flags.here:
            print(json.dumps(here()))
            return
        verdicts = gate(commit=flags.commit)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    for verdict in verdicts:
        print(verdict.line)
    sys.exit(max(verdict.status for verdict in verdicts))


if __name__ == "__main__":
    main()

"""CI's gate: fails if the engine has fallen behind the limit kernel since the committed ratio.

Both are built and run here, in alternating pairs on one core; the median of the ratios counts. It
is a question only where the kernel's 512-bit vectors are the machine's own.
"""

import argparse
import json
import platform
import sys
from pathlib import Path
from typing import Any, NamedTuple

import common
import pairs

from sinsjax.bench.limit import compiler
from sinsjax.bench.timing import Row, conditions, use_one_core
from sinsjax.files import replacing
from sinsjax.types import InputError

COMMITTED = Path(__file__).parent / "gate.json"
"""The committed ratio of each instruction set, and what it was measured with."""

ALLOWED = 1.5
"""Times the committed ratio."""

PAIRS = 7
FOR_INFORMATION = 3

Ratios = dict[str, dict[str, Any]]


class Verdict(NamedTuple):
    """What the gate says: an exit status and a line."""

    status: int
    line: str


def judge(measured: float, instructions: str, committed: Ratios) -> Verdict:
    """Compare a median ratio with the committed one.

    Args:
        measured: median ratio of the engine to the limit kernel.
        instructions: set of the machine: avx512 or avx2.
        committed: content of gate.json.
    """
    known = committed.get(instructions, {}).get("ratio")
    beside = "" if known is None else f" (committed for {instructions}: {known:.2f})"
    if instructions != "avx512":
        return Verdict(
            0,
            f"gate skipped: no AVX-512 here; {measured:.2f} x the limit on {instructions}{beside}",
        )
    if known is None:
        return Verdict(
            0,
            f"gate skipped: no ratio is committed for avx512; {measured:.2f} x the limit here"
            " (python benchmarks/gate.py --commit writes it)",
        )
    if measured > ALLOWED * known:
        return Verdict(
            1,
            f"gate failed: {measured:.2f} x the limit is more than {ALLOWED:g} times the"
            f" committed {known:.2f}",
        )
    return Verdict(
        0,
        f"gate passed: {measured:.2f} x the limit, at most {ALLOWED:g} times the committed"
        f" {known:.2f}",
    )


def unable() -> str:
    """Why the kernel cannot be built here; empty if it can."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return f"the limit kernel is for x86-64, this is {platform.machine()}"
    try:
        compiler()
    except InputError as error:
        return str(error)
    return ""


def entry(measured: float, holds: Row) -> dict[str, Any]:
    """What gate.json keeps of a measurement."""
    kept = {key: holds[key] for key in ("cpu", "jax", "jaxlib")}
    return {"ratio": round(measured, 3), "sinsjax": common.source_version()} | kept


def gate(*, commit: bool, path: Path = COMMITTED) -> Verdict:
    """Measure and judge, or measure and write the ratio down.

    Args:
        commit: whether this machine's ratio becomes the committed one.
        path: of gate.json.

    Raises:
        InputError: the kernel cannot be built or dies, or the file cannot be written.
    """
    if why := unable():
        return Verdict(0, f"gate skipped: {why}")
    use_one_core()
    holds = conditions()
    instructions = "avx512" if holds["avx512"] else "avx2"
    count = PAIRS if commit or holds["avx512"] else FOR_INFORMATION
    kernel, ours, *_ = pairs.rows(False, count)
    listed = ", ".join(f"{ratio:.2f}" for ratio in ours["ratios"])
    print(f"limit {kernel['ns_per_step_run']} ns, engine {ours['ns_per_step_run']} ns")
    print(f"ratios of {count} pairs: {listed}; median {ours['ratio']:.2f}", flush=True)
    committed = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    if not commit:
        return judge(ours["ratio"], instructions, committed)
    committed[instructions] = entry(ours["ratio"], holds)
    with replacing(path) as file:
        file.write((json.dumps(committed, indent=2, sort_keys=True) + "\n").encode())
    return Verdict(0, f"committed for {instructions}: {ours['ratio']:.2f} x the limit")


def main() -> None:
    """Print the verdict; exit with its status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--commit", action="store_true", help="write this machine's ratio down")
    try:
        verdict = gate(commit=parser.parse_args().commit)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    print(verdict.line)
    sys.exit(verdict.status)


if __name__ == "__main__":
    main()

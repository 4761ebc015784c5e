"""The limit kernel, a hand-written lower bound of the time: ``limit_kernel.c``."""

import shutil
import subprocess
import tempfile
import time
from pathlib import Path

from timing import Workload

from sinsjax.errors import InputError
from sinsjax.platform import machine

SOURCE = Path(__file__).with_name("limit_kernel.c")

_FLAGS = "-O3 -ffast-math -Wno-psabi -mprefer-vector-width=512".split()
_LEVELS = {"AVX512": "x86-64-v4", "AVX2": "x86-64-v3", "SSE4_2": "x86-64-v2"}
"""gcc's names of the minimal processors with each instruction set."""


def find_compiler() -> str:
    """Return the path of gcc; raises InputError if it cannot build a program that runs here."""
    found = shutil.which("gcc")
    if found is None:
        raise InputError("gcc not found")
    with tempfile.TemporaryDirectory(prefix="sinsjax-limit-") as folder:
        source, program = Path(folder) / "empty.c", str(Path(folder) / "empty")
        source.write_text("int main(void) { return 0; }\n", encoding="utf-8")
        _run_command(
            [found, *_FLAGS, _architecture_option(), str(source), "-o", program, "-lm"], "gcc"
        )
        _run_command([program], "a program built by gcc")
    return found


def _architecture_option() -> str:
    """Return gcc's option for XLA's instruction set, so that kernel and engine use the same."""
    instructions = machine.instruction_set()
    if instructions == machine.instruction_set(""):
        return "-march=native"
    return f"-march={_LEVELS.get(instructions, 'native')}"


def limit_kernel_workload(
    compiler: str, folder: str, *, steps: int = 20000, vectors: int = 32
) -> Workload:
    """The hand-written kernel in a folder that stays, in CPU time; `vectors` of 8 runs each."""
    program = str(Path(folder) / "limit")
    since = time.perf_counter()
    options = [*_FLAGS, _architecture_option(), "-DREAL=double"]
    _run_command([compiler, *options, str(SOURCE), "-o", program, "-lm"], "gcc")
    compile_s = time.perf_counter() - since
    runs = 8 * vectors

    def call() -> float:
        printed = _run_command([program, str(steps), str(vectors)], "the limit kernel")
        return float(printed.split()[0]) * 1e-9 * steps * runs

    return Workload("limit_kernel", runs, steps, compile_s, call)


def _run_command(command: list[str], name: str) -> str:
    """Run a command and give its output; raises a one-line InputError if it fails."""
    try:
        ended = subprocess.run(command, capture_output=True, text=True)
    except OSError as error:
        raise InputError(f"{name} cannot be started: {error.strerror}") from None
    if ended.returncode:
        complaint = ended.stderr.strip().partition("\n")[0]
        code = ended.returncode
        reason = complaint or (f"signal {-code}" if code < 0 else f"exit status {code}")
        raise InputError(f"{name} failed: {reason}")
    return ended.stdout

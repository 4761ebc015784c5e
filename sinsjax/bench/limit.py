"""The limit kernel: ``benchmarks/limit_kernel.c``, built for the instruction set in force."""

import shutil
import subprocess
import tempfile
import time
from pathlib import Path

from sinsjax.bench.assets import asset
from sinsjax.bench.timing import Workload
from sinsjax.errors import InputError
from sinsjax.platform import machine, xla

_FLAGS = "-O3 -ffast-math -Wno-psabi -mprefer-vector-width=512".split()
_LEVELS = {"AVX512": "x86-64-v4", "AVX2": "x86-64-v3", "SSE4_2": "x86-64-v2"}
"""gcc's names of the smallest processors that have a set."""


def compiler() -> str:
    """Path of the gcc here, which has just built and run a program with the kernel's options.

    Raises:
        InputError: there is none, or it cannot build what runs here.
    """
    found = shutil.which("gcc")
    if found is None:
        raise InputError("there is no gcc here")
    with tempfile.TemporaryDirectory(prefix="sinsjax-limit-") as folder:
        source, program = Path(folder) / "empty.c", str(Path(folder) / "empty")
        source.write_text("int main(void) { return 0; }\n", encoding="utf-8")
        _told([found, *_FLAGS, _architecture(), str(source), "-o", program, "-lm"], "gcc")
        _told([program], "what gcc builds")
    return found


def _architecture() -> str:
    """The option of gcc for the set that XLA may use: the kernel gets no more than the engine."""
    instructions = xla.instructions()
    if instructions == machine.instructions():
        return "-march=native"
    return f"-march={_LEVELS.get(instructions, 'native')}"


def limit_kernel(compiler: str, folder: str, *, steps: int = 20000, vectors: int = 32) -> Workload:
    """The hand-written kernel of ``benchmarks/limit_kernel.c``, in CPU time.

    Args:
        compiler: path of gcc, see `compiler`.
        folder: where the program goes; it has to stay as long as the case is called.
        steps: of each run.
        vectors: of 8 runs.

    Raises:
        InputError: gcc cannot build it; from the case, when the kernel dies.
    """
    program = str(Path(folder) / "limit")
    source = str(asset("benchmarks/limit_kernel.c"))
    since = time.perf_counter()
    options = [*_FLAGS, _architecture(), "-DREAL=double"]
    _told([compiler, *options, source, "-o", program, "-lm"], "gcc")
    compile_s = time.perf_counter() - since
    runs = 8 * vectors

    def call() -> float:
        told = _told([program, str(steps), str(vectors)], "the limit kernel")
        return float(told.split()[0]) * 1e-9 * steps * runs

    return Workload("limit_kernel", runs, steps, compile_s, call)


def _told(command: list[str], name: str) -> str:
    """What a command prints; raises InputError with one line when it fails."""
    try:
        ended = subprocess.run(command, capture_output=True, text=True)
    except OSError as error:
        raise InputError(f"{name} cannot be started: {error.strerror}") from None
    if ended.returncode:
        complaint = ended.stderr.strip().partition("\n")[0]
        code = ended.returncode
        why = complaint or (f"signal {-code}" if code < 0 else f"exit status {code}")
        raise InputError(f"{name} failed: {why}")
    return ended.stdout

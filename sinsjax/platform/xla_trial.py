"""Trial compilation of a small step in a separate process, to find options jaxlib does not know.

An option unknown to XLA or LLVM ends the process, in LLVM's case only when something is compiled.
The process also dumps LLVM's optimised code, which shows whether loops are vectorised. Run as a
script, this module compiles the step without importing anything of `sinsjax`.
"""

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

_TIMEOUT_S = 120.0
_ARRAYS, _LANES = 24, 64
_UNKNOWN_FLAGS = re.compile(r"Unknown flags? in XLA_FLAGS:(.*)")
_UNKNOWN_OPTION = re.compile(r"Unknown command line argument '(--[\w-]+)")
_LABEL = re.compile(r'^([\w.$-]+|"[^"]*"):(?:\s*; preds = (.*))?$')
_ARITHMETIC = re.compile(r"= f(?:add|sub|mul|div|neg)\b[^<%]* (?:<(\d+) x double>|double) ")
_FUSED = re.compile(r"= (?:tail )?call\b.*@llvm\.f(?:muladd|ma)\.(?:v(\d+))?f64\(")


class Trial(NamedTuple):
    """Result of compiling with a value of ``XLA_FLAGS``.

    Attributes:
        unknown: unknown flags and options; if there are any, nothing was compiled.
        vectorised: share of a step's arithmetic in vectorised loops, None if unknown.
    """

    unknown: frozenset[str]
    vectorised: float | None


def attempt(flags: str) -> Trial | None:
    """Compile a small step for the CPU in a separate process.

    Args:
        flags: value of ``XLA_FLAGS``.

    Returns:
        The result; None if the process failed for another reason.
    """
    with tempfile.TemporaryDirectory(prefix="sinsjax-trial-") as folder:
        environment = {
            **os.environ,
            "XLA_FLAGS": f"{flags} --xla_dump_to={folder}".strip(),
            "JAX_PLATFORMS": "cpu",
            "JAX_ENABLE_COMPILATION_CACHE": "false",
        }
        try:
            process = subprocess.run(
                # -P keeps modules beside this one off the path, where they could shadow Python's.
                [sys.executable or "", "-P", __file__],
                env=environment,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=_TIMEOUT_S,
            )
        except (OSError, subprocess.TimeoutExpired):
            return None
        if process.returncode == 0:
            code = [path.read_text() for path in Path(folder).glob("*.ir-with-opt.ll")]
            return Trial(frozenset(), vectorised_share("\n".join(code)))
    unknown = set(_UNKNOWN_OPTION.findall(process.stderr))
    for complaint in _UNKNOWN_FLAGS.findall(process.stderr):
        unknown |= set(re.findall(r"--(\w+)", complaint))
    return Trial(frozenset(unknown), None) if unknown else None


def refused(flags_without: Callable[[frozenset[str]], str]) -> frozenset[str] | None:
    """The flags and options that this jaxlib does not know, found one after another.

    Args:
        flags_without: (those refused so far) -> value of ``XLA_FLAGS`` without them.

    Returns:
        Their names; None if a trial failed.
    """
    found: frozenset[str] = frozenset()
    while True:
        trial = attempt(flags_without(found))
        if trial is None or (trial.unknown and trial.unknown <= found):
            return None
        if not trial.unknown:
            return found
        found |= trial.unknown


def vectorised_share(code: str) -> float | None:
    """Share of the double-precision arithmetic that is done in vectorised loops.

    A vectorised loop has a scalar twin for overlapping arrays, with the same exit block. Of the
    two, the scalar one is counted, as vectorised.

    Args:
        code: LLVM's optimised code, as text with the predecessors of each block.

    Returns:
        From 0 to 1; None if no arithmetic was found.
    """
    vector: dict[str, int] = {}
    scalar: dict[str, int] = {}
    leaves: dict[str, set[str]] = {}
    label = ""
    for line in code.splitlines():
        if head := _LABEL.match(line):
            label = head[1]
            for before in re.findall(r'%([\w.$-]+|"[^"]*")', head[2] or ""):
                leaves.setdefault(before, set()).add(label)
        elif found := _ARITHMETIC.search(line) or _FUSED.search(line):
            counts = vector if found[1] else scalar
            counts[label] = counts.get(label, 0) + 1
    exits = {place for block in vector for place in leaves.get(block, set()) - {block}}
    loops = [block for block in scalar if block in leaves.get(block, set())]
    done = sum(scalar[block] for block in loops if leaves[block] & exits)
    paired = {place for block in loops for place in leaves[block]}
    done += sum(n for block, n in vector.items() if not leaves.get(block, set()) & paired)
    left = sum(scalar[block] for block in loops if not leaves[block] & exits)
    return done / (done + left) if done + left else None


def compile_step() -> None:
    """Compile a loop whose step reads and writes many arrays over lanes, as a filter does."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)

    def step(carry: tuple, time: jax.Array) -> tuple:
        n = len(carry)
        moved = [
            a + carry[(i + 1) % n] * carry[(i + 7) % n] - 0.5 * carry[(i + 3) % n]
            for i, a in enumerate(carry)
        ]
        gain = 1 / (moved[0] * moved[0] + time)
        return tuple(a - gain * moved[(i + 5) % n] for i, a in enumerate(moved)), None

    def loop(carry: tuple) -> tuple:
        return jax.lax.scan(step, carry, jnp.arange(1.0, 8.0))[0]

    lanes = jax.ShapeDtypeStruct((_LANES,), jnp.float64)
    jax.jit(loop).lower((lanes,) * _ARRAYS).compile()


if __name__ == "__main__":
    compile_step()

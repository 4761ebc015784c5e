"""The short benchmark set: the engine's step on one core, told in ns per step and run.

Every row times a compiled function that is used elsewhere; compiling is timed apart. Machines are
shared and drift, so rows to be compared are measured in turns, and the median is told.
"""

import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from sinsjax import runtime
from sinsjax.types import InputError

_TILES = 2
_BASELINE_SAMPLES = 2000
_KERNEL_FLAGS = "-O3 -march=native -ffast-math -Wno-psabi -mprefer-vector-width=512".split()
_KERNEL_SIZE = (20000, 32)


class Case(NamedTuple):
    """Something to time.

    Attributes:
        name: of the row.
        runs: that one call takes.
        steps: of each run.
        compile_s: what compiling took, s.
        call: does the work and returns the seconds it took.
    """

    name: str
    runs: int
    steps: int
    compile_s: float
    call: Callable[[], float]


def run(console: Console, *, as_json: bool, limit: bool, repeats: int) -> None:
    """Time the short set on one core and print it.

    Args:
        console: where to print.
        as_json: one JSON object a line instead of a table.
        limit: also build and time the limit kernel, where there is a gcc.
        repeats: timings a row.

    Raises:
        InputError: the limit kernel cannot be built or dies.
    """
    # Before XLA sizes its thread pool: one core is what the rows are about.
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    runtime.configure(devices=1)
    with tempfile.TemporaryDirectory(prefix="sinsjax-limit-") as folder:
        rows = measure(cases(limit_folder=folder if limit else None), repeats)
    facts = runtime.info()
    rows = [row | {"cpu": facts["cpu"], "sinsjax": facts["sinsjax"]} for row in rows]
    if not facts["fused_loop"]:
        print("warning: the fused loop is absent, see `sinsjax info`", file=sys.stderr)
    if as_json:
        for row in rows:
            console.print(json.dumps(row), soft_wrap=True, highlight=False, markup=False)
        return
    console.print(_table(rows))
    console.print(
        f"{facts['cpu']}, jax {facts['jax']}, median of {repeats} turns on one core",
        highlight=False,
    )


def cases(*, limit_folder: str | None) -> list[Case]:
    """The rows of the short set, compiled and ready to time.

    Args:
        limit_folder: where to build the limit kernel; None for a set without it. Where there is
            no gcc a line on stderr says so, and the set goes without it.
    """
    out = []
    compiler = limit_folder and shutil.which("gcc")
    if limit_folder and compiler:
        out.append(limit_kernel(compiler, limit_folder))
    elif limit_folder:
        print("warning: no limit kernel: there is no gcc here to build it", file=sys.stderr)
    group = default_group()
    silent = without_noise(group)
    out.append(engine("kalman_shared_record", silent))
    for variants in (64, 6, 1):
        out.append(engine(f"kalman_noise_{variants}", some_variants(group, variants)))
    out.append(numpy_baseline(silent))
    return out


def measure(timed: list[Case], repeats: int) -> list[dict[str, Any]]:
    """Time cases in turns; one row each with the median and the spread (half the range)."""
    seconds: dict[str, list[float]] = {case.name: [] for case in timed}
    for _ in range(repeats):
        for case in timed:
            seconds[case.name].append(case.call())
    rows = []
    for case in timed:
        taken = seconds[case.name]
        median = statistics.median(taken)
        rows.append(
            {
                "name": case.name,
                "ns_per_step_run": round(median / (case.runs * case.steps) * 1e9, 2),
                "runs": case.runs,
                "steps": case.steps,
                "dtype": "float64",
                "devices": 1,
                "compile_s": round(case.compile_s, 3),
                "median_s": round(median, 5),
                "spread_s": round((max(taken) - min(taken)) / 2, 5),
            }
        )
    return rows


def asset(name: str) -> Path:
    """A file of the repository that the benchmarks need, in a source tree or as installed."""
    installed = Path(str(files("sinsjax"))) / "assets" / name
    return installed if installed.exists() else Path(__file__).parents[1] / name


def default_group() -> Any:
    """What `sweep` runs for the default sweep, ``configs/reset_sweep.toml``."""
    from sinsjax.config import load_study
    from sinsjax.scenario import parts

    (part,) = parts(load_study(asset("configs/reset_sweep.toml")))
    return part.group


def without_noise(group: Any) -> Any:
    """The group with silent sensors: one setting off, the program is the same."""
    errors = group.world.errors
    quiet = errors._replace(gyro_noise=np.zeros(3), accel_noise=np.zeros(3))
    return group._replace(world=group.world._replace(errors=quiet))


def some_variants(group: Any, count: int) -> Any:
    """The group with its last variants only, and draws enough to fill the tiles."""
    import jax

    from sinsjax.batch import LANES
    from sinsjax.simulate import Draw

    draws = _TILES * LANES // count + 1
    zeros = np.zeros(draws, int)
    return group._replace(
        variants=jax.tree.map(lambda a: a[-count:], group.variants),
        draws=Draw(np.arange(draws), zeros, zeros),
        q=np.tile(group.q[:1], (draws, 1)),
    )


def engine(name: str, group: Any) -> Case:
    """The compiled function of `sweep` on the first tiles of a group, on one device."""
    import jax

    from sinsjax.batch import LANES, compiled, tiles_of

    tiles = tiles_of(group, np.arange(_TILES * LANES))
    since = time.perf_counter()
    program = compiled(group.static, 1).lower(group.world, tiles).compile()
    compile_s = time.perf_counter() - since
    arguments = jax.device_put((group.world, tiles))

    def call() -> float:
        since = time.perf_counter()
        jax.block_until_ready(program(*arguments))
        return time.perf_counter() - since

    call()
    steps = group.static.records * group.static.record_every
    return Case(name, _TILES * LANES, steps, compile_s, call)


def numpy_baseline(group: Any) -> Case:
    """The first run of a noise-free group as a plain NumPy loop, checked against the engine."""
    from sinsjax.baseline import Setting, align

    increments = np.asarray(group.world.tape[:_BASELINE_SAMPLES])
    errors, place = group.world.errors, group.world.site.place
    dt = group.static.options.dt
    increments = increments + np.concatenate([errors.gyro_bias, errors.accel_bias]) * dt
    first = _first_run(group)
    setting = Setting(
        dt=dt,
        rate_n=float(place.rate_n),
        rate_u=float(place.rate_u),
        tan_latitude=float(place.tan_latitude),
        radius=float(1 / place.curvature_n),
        p0=np.array(first.method.p0),
        q=np.array(first.method.q),
        r=float(first.method.r),
        feedback_every=int(first.method.feedback.every),
        resets=tuple(int(n) for n in first.method.resets.samples if np.isfinite(n)),
    )
    start = _start(first)
    _check(group, first, align(increments, start, setting)[0])

    def call() -> float:
        since = time.perf_counter()
        align(increments, start, setting)
        return time.perf_counter() - since

    return Case("numpy_baseline", 1, _BASELINE_SAMPLES, 0.0, call)


def _first_run(group: Any) -> Any:
    import jax

    from sinsjax.types import Quat

    first = jax.tree.map(lambda a: np.asarray(a)[0], group.variants)
    return first._replace(q=Quat(*group.q[0]))


def _start(first: Any) -> np.ndarray:
    from sinsjax.rotations import matrix, misalign

    return np.array(matrix(misalign(first.phi, first.q)))


def _check(group: Any, first: Any, c: np.ndarray) -> None:
    """The baseline must give the engine's attitude, or its time means nothing."""
    import jax

    from sinsjax.simulate import Draw, simulate

    static = group.static._replace(records=_BASELINE_SAMPLES // group.static.record_every)
    draw = jax.tree.map(lambda a: np.asarray(a)[0], group.draws)
    outcome, _ = jax.jit(lambda *a: simulate(static, *a))(group.world, Draw(*draw), first)
    ours = np.array([outcome.last.pitch, outcome.last.roll, outcome.last.yaw])
    theirs = np.array(
        [np.arcsin(c[2, 1]), np.arctan2(-c[2, 0], c[2, 2]), np.arctan2(-c[0, 1], c[1, 1])]
    )
    if not np.allclose(ours, theirs, atol=1e-9):
        raise RuntimeError(f"the NumPy baseline and the engine differ: {theirs} and {ours} rad")


def limit_kernel(compiler: str, folder: str) -> Case:
    """The hand-written kernel of ``benchmarks/limit_kernel.c``, built for this machine.

    Args:
        compiler: path of gcc.
        folder: where the program goes; it has to stay as long as the case is called.

    Raises:
        InputError: gcc cannot build it; from the case, when the kernel dies.
    """
    program = str(Path(folder) / "limit")
    source = str(asset("benchmarks/limit_kernel.c"))
    since = time.perf_counter()
    _told([compiler, *_KERNEL_FLAGS, "-DREAL=double", source, "-o", program, "-lm"], "gcc")
    compile_s = time.perf_counter() - since
    steps, vectors = _KERNEL_SIZE
    runs = 8 * vectors

    def call() -> float:
        told = _told([program, str(steps), str(vectors)], "the limit kernel")
        return float(told.split()[0]) * 1e-9 * steps * runs

    return Case("limit_kernel", runs, steps, compile_s, call)


def _told(command: list[str], name: str) -> str:
    """What a command prints; raises InputError with one line when it fails."""
    try:
        ended = subprocess.run(command, capture_output=True, text=True)
    except OSError as error:
        raise InputError(f"--limit: {name} cannot be started: {error.strerror}") from None
    if ended.returncode:
        complaint = ended.stderr.strip().partition("\n")[0]
        code = ended.returncode
        why = complaint or (f"signal {-code}" if code < 0 else f"exit status {code}")
        raise InputError(f"--limit: {name} failed: {why}")
    return ended.stdout


def _table(rows: list[dict[str, Any]]) -> Table:
    table = Table(title="ns a step and run", box=box.SIMPLE)
    shown = {
        "name": "name",
        "ns_per_step_run": "ns",
        "compile_s": "compile s",
        "median_s": "median s",
        "spread_s": "+- s",
    }
    for key, heading in shown.items():
        table.add_column(heading, justify="left" if key == "name" else "right", no_wrap=True)
    kernel = next((r["ns_per_step_run"] for r in rows if r["name"] == "limit_kernel"), None)
    if kernel:
        table.add_column("x limit", justify="right", no_wrap=True)
    for row in rows:
        ratio = [f"{row['ns_per_step_run'] / kernel:.2f}"] if kernel else []
        table.add_row(*(str(row[key]) for key in shown), *ratio)
    return table

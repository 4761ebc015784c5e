"""What a derivative by filter parameters costs: forward mode beside the plain run.

The mean over a tile of phi_u^2 at the end (arcmin^2) is differentiated by p scales of the filter's
beliefs, in their order: P0 of the yaw, P0 of the level angles, Q, R. Both programs go over the same
tiles of the default sweep with silent sensors, as `sweep` does.

A step of `sinsjax tune` by gradient is timed as a whole: the mean settling time of 4 descents, with
noise, by two reset times; its resets are windows and its band has a soft edge. Beside it the plain
runs of the same lanes, whose resets are hard.
"""

import re
import time
import tomllib
from functools import cache
from typing import Any

import common
import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.bench.cases import TILES, default_group, engine_workload, remove_noise, shorten_runs
from sinsjax.bench.timing import Row, Workload, measure_relative_to_base
from sinsjax.engine.batch import compile_program, plan
from sinsjax.engine.build import parts
from sinsjax.engine.lanes import LANES, Group, Tiles, tiles_of
from sinsjax.engine.run import RunParams, run_tile
from sinsjax.engine.samples import block_size
from sinsjax.platform.assets import asset_path
from sinsjax.study.load import study_from_dict
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study
from sinsjax.tuning import search
from sinsjax.tuning.gradient import (
    TANGENT_STEPS,
    ParameterMap,
    Slope,
    Softness,
    sensitivities,
)
from sinsjax.types import Array
from sinsjax.units import ARCMIN

MOST = 4
"""Parameters that can be scaled."""

RECORDS, QUICK = 90, 4

STARTS, DRAWS, VARIANTS = 4, 4, 8
"""Descents, draws a step and variants of a tuning, which fill `TILES`."""

_ARITHMETIC = frozenset(
    "add subtract multiply divide negate abs maximum minimum sqrt rsqrt power sine cosine atan2"
    " exponential log round-nearest-even floor remainder".split()
)
_HEAD = re.compile(r"^(ENTRY )?%?([\w.-]+) .*\{$")
_INSTRUCTION = re.compile(r" = \w+\[([\d,]*)\](?:\{[^}]*\})? ([\w-]+)\(")
_CALLED = re.compile(r"\b(calls|to_apply|body|branch_computations)=(?:\{([^}]*)\}|%?([\w.-]+))")
_TRIPS = re.compile(r'"known_trip_count":\{"n":"(\d+)"')


def scaled(params: RunParams, scales: Array) -> RunParams:
    """Runs whose filter believes in scaled variances: of yaw and level in P0, of Q, of R."""
    yaw, level, q, r = (*scales, *(1.0,) * (MOST - len(scales)))
    method = params.method
    factors = (1.0, 1.0, level, level, yaw, *(1.0,) * (len(method.p0) - 5))
    return params._replace(
        method=method._replace(
            p0=tuple(f * value for f, value in zip(factors, method.p0, strict=True)),
            q=tuple(q * value for value in method.q),
            r=r * method.r,
        )
    )


def loops_of(group: Group, tiles: Tiles) -> tuple[int, ...]:
    """How often loops run whose trip count does not stand in the program, the outermost first.

    They are those over the events of a record interval, of which the default sweep has one, over
    the pieces in which samples are made, and over the samples.
    """
    every = group.static.record_every
    one = jax.tree.map(lambda a: a[0], tiles.draws)
    size = block_size(group.static.record_every, one)
    return (1, every // size, size) if size > 1 else (1, every)


def operations(
    program: jax.stages.Compiled, loops: tuple[int, ...] = (), *, without: int | None = None
) -> int:
    """Arithmetic operations on one element that a compiled program carries out.

    XLA's own ``cost_analysis`` counts the body of a loop once, however often it runs, so that what
    is done once a record weighs as much as what is done at each of its samples. Here every
    instruction of the optimised program counts once an element of its result and as often as the
    loops around it run; their trip counts stand in the program, or are given. A function of the
    library counts as one operation, in both programs alike.

    Args:
        program: compiled.
        loops: trip counts of the loops that do not tell theirs, the outermost first.
        without: trip count of loops whose bodies are left out; None counts all.
    """
    lines: dict[str, list[str]] = {}
    body: list[str] = []
    entry = ""
    for line in (program.as_text() or "").splitlines():
        if head := _HEAD.match(line):
            body = lines.setdefault(head[2], [])
            entry = head[2] if head[1] else entry
        else:
            body.append(line)

    @cache
    def count(name: str, depth: int) -> int:
        total = 0
        for line in lines[name]:
            found = _INSTRUCTION.search(line)
            if found and found[2] in _ARITHMETIC:
                total += int(np.prod([int(n) for n in found[1].split(",") if n], dtype=np.int64))
            trips = _TRIPS.search(line)
            if trips and int(trips[1]) == without:
                continue
            for how, several, one in _CALLED.findall(line):
                told = trips is not None or how != "body"
                times = int(trips[1]) if how == "body" and trips else 1 if told else loops[depth]
                names = several.split(",") if several else [one]
                deeper = depth if told else depth + 1
                total += times * sum(count(name.strip(" %"), deeper) for name in names)
        return total

    return count(entry, 0)


def program_of(group: Group, p: int) -> tuple[jax.stages.Compiled, tuple, float]:
    """The compiled value, for p = 0, or value and derivatives; its arguments; s to compile."""

    def whole(group_world: Any, tiles: Tiles, scales: Array) -> Any:
        def one_tile(tile: Tiles) -> Any:
            def objective(scales: Array) -> Array:
                lanes = tile._replace(params=scaled(tile.params, scales))
                outcome, _ = run_tile(group.static, group_world, lanes)
                return jnp.mean((outcome.last.phi.z / ARCMIN) ** 2)

            return sensitivities(objective, scales, jnp.eye(p)) if p else objective(scales)

        return jax.lax.map(one_tile, tiles)

    tiles = tiles_of(group, plan(group, tiles_per_chunk=TILES)[0])
    arguments = (group.environment, tiles, np.ones(max(p, 1)))
    since = time.perf_counter()
    program = jax.jit(whole).lower(*arguments).compile()
    return program, jax.device_put(arguments), time.perf_counter() - since


def case(name: str, group: Group, p: int) -> tuple[Workload, jax.stages.Compiled]:
    """What is timed, and its program."""
    program, arguments, compile_s = program_of(group, p)

    def call() -> float:
        since = time.perf_counter()
        jax.block_until_ready(program(*arguments))
        return time.perf_counter() - since

    call()
    steps = group.static.records * group.static.record_every
    return Workload(name, TILES * LANES, steps, compile_s, call), program


def temporary(program: jax.stages.Compiled) -> int:
    """Bytes that a program needs beside its arguments and results."""
    return int(program.memory_analysis().temp_size_in_bytes)


def tuned_study(seconds: float) -> Study:
    """The default sweep's base, sensors and filter; two reset times are tuned."""
    data = tomllib.loads(asset_path("configs/reset_sweep.toml").read_text("utf-8"))
    data["study"] |= {"duration_s": seconds, "window_s": [seconds / 2, seconds]}
    data["study"]["judged_from"] = "truth"  # a short run has no limit
    data["resets"] = {"reset_times_s": [seconds / 3, seconds / 2]}
    data["axes"] = {"phi_u0_deg": [10.0 * i for i in range(1, VARIANTS + 1)]}
    halves = ({"low": seconds * low, "high": seconds * (low + 0.3)} for low in (0.2, 0.5))
    data["tune"] = {
        "searches": ["gradient"],
        "variables": {"reset_times_s": list(halves)},
        "tune_draws": DRAWS,
    }
    return study_from_dict(data)


def tuning(seconds: float, repeats: int) -> list[Row]:
    """Time a gradient of `sinsjax tune` in pairs with the plain runs of the same lanes."""
    study = tuned_study(seconds)
    space = SearchSpace.from_study(study)
    box = np.linspace(0.3, 0.7, 2 * STARTS).reshape(STARTS, 2)
    points = {f"start {i}": space.make_point(space.to_values(own), {}) for i, own in enumerate(box)}
    (part,) = parts(search.derive_study(study, points, name="plain"), curves=False)
    base = engine_workload("tune_plain", part.group)
    arguments = (box, np.arange(DRAWS), Softness(seconds / 20, 4.0))
    since = time.perf_counter()
    slope = Slope(ParameterMap(study, {}), starts=STARTS, draws=DRAWS)
    (program,) = slope.programs(*arguments)
    compile_s = time.perf_counter() - since

    def call() -> float:
        since = time.process_time()
        slope(*arguments)
        return time.process_time() - since

    call()
    gradient = Workload(f"tune_gradient_p{len(box[0])}", base.runs, base.steps, compile_s, call)
    first, row = measure_relative_to_base(base, [gradient], repeats)
    tiles = tiles_of(part.group, plan(part.group, tiles_per_chunk=TILES)[0])
    plain = compile_program(part.group, tiles)
    row |= {
        "operations_ratio": round(
            operations(program) / operations(plain, loops_of(part.group, tiles)), 3
        ),
        "counted": 1 + TANGENT_STEPS * len(box[0]),
        "temp_bytes": temporary(program),
    }
    return [first, row]


def rows(quick: bool, repeats: int) -> list[Row]:
    """Time derivatives by 1 to 4 parameters over 9,000 steps, in turns with the plain run.

    Returns:
        ``derivative_plain``, then ``derivative_pN`` with ``ratio`` (of the times, in turns),
        ``operations_ratio``, ``limit`` (what ``ratio`` may be) and ``temp_bytes``; that of the
        most parameters also with ``temp_bytes_half`` and ``temp_bytes_double``, of runs of half
        and twice the length (a quick run has only the latter): forward mode stores no step. Then
        ``tune_plain`` and ``tune_gradient_p2``, with ``counted``, the plain runs that the cost of a
        tuning counts.
    """
    records = QUICK if quick else RECORDS
    silent = remove_noise(default_group())
    group = shorten_runs(silent, records)
    base, plain = case("derivative_plain", group, 0)
    counts = (1,) if quick else range(1, MOST + 1)
    made = {p: case(f"derivative_p{p}", group, p) for p in counts}
    first, *others = measure_relative_to_base(base, [one for one, _ in made.values()], repeats)
    loops = loops_of(group, tiles_of(group, plan(group, tiles_per_chunk=TILES)[0]))
    by = operations(plain, loops)
    for row, (p, (_, program)) in zip(others, made.items(), strict=True):
        ratio = operations(program, loops) / by
        row |= {
            "operations_ratio": round(ratio, 3),
            "limit": round(1.2 * max(1 + 2 * p, ratio), 2),
            "temp_bytes": temporary(program),
        }
    lengths = {"half": records // 2, "double": 2 * records}
    for key, length in [*lengths.items()][quick:]:
        program, *_ = program_of(shorten_runs(silent, length), max(counts))
        others[-1][f"temp_bytes_{key}"] = temporary(program)
    return [first, *others, *tuning(float(records), repeats)]


if __name__ == "__main__":
    common.main(rows)

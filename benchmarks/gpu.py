"""The engine on a GPU, float64: 1e3 to 1e6 runs, in two wide tiles or in many narrower ones."""

import sys

import common
import jax
from cases import (
    default_group,
    engine_workload,
    remove_noise,
    select_last_variants,
    shorten_runs,
)
from timing import Row, measure_workloads

RUNS = (1_000, 10_000, 100_000, 1_000_000)
TILE = 16_384
"""Lanes of a tile that is a part of the runs."""


def rows(quick: bool, repeats: int) -> list[Row]:
    """Time runs of 90 s on a GPU: silent in two tiles and in narrow ones, and with noise."""
    if jax.devices()[0].platform != "gpu":
        print(f"no GPU: JAX has {jax.devices()[0].platform} only", file=sys.stderr)
        return []
    out = []
    for runs in RUNS[:1] if quick else RUNS:
        out += sized(runs, 2 if quick else 90, repeats)
    return out


def sized(runs: int, records: int, repeats: int) -> list[Row]:
    """The rows of one number of runs; what they hold on the GPU is free again after."""
    group, half = shorten_runs(default_group(), records), runs // 2
    silent = remove_noise(select_last_variants(group, group.sizes[1], runs))
    noisy = select_last_variants(group, 64, runs)
    cases = [
        engine_workload(f"gpu_silent_{runs}", silent, lanes=half),
        engine_workload(f"gpu_noise_{runs}", noisy, lanes=half),
    ]
    if half > TILE:
        cases.append(engine_workload(f"gpu_tiled_{runs}", silent, tiles=runs // TILE, lanes=TILE))
    return measure_workloads(cases, repeats)


if __name__ == "__main__":
    common.main(rows, one_core=False, repeats=3)

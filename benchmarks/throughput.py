"""Where time a step and run bends: lanes a tile, tiles a call, variants a draw, curves."""

import common
from cases import (
    TILES,
    default_group,
    engine_workload,
    remove_noise,
    select_last_variants,
    shorten_runs,
)
from timing import Row, Workload, measure_workloads

from sinsjax.engine.batch import LANES, Batch

LANE_COUNTS = (16, 32, 48, 64, 80, 96, 128, 192, 256)
TILE_COUNTS = (2, 4, 8, 16, 32)
VARIANT_COUNTS = (1, 2, 4, 8, 16, 32, 64)


def rows(quick: bool, repeats: int) -> list[Row]:
    """Time runs of 90 s on one core, everything in turns.

    Returns:
        ``lanes_N`` and ``tiles_N`` without noise; ``variants_N`` with noise, N variants a draw;
        ``curves_off`` and ``curves_on``, which keeps the observations of every record. All have
        ``lanes``, ``tiles`` and ``variants``.
    """
    noisy = shorten_runs(default_group(), 2 if quick else 90)
    silent = remove_noise(noisy)
    every = silent.n_variants
    storing = silent._replace(spec=silent.spec._replace(curves=True))
    cases: list[Workload] = []
    sizes: list[Row] = []

    def add(
        name: str, group: Batch, *, lanes: int = LANES, tiles: int = TILES, variants: int = every
    ) -> None:
        cases.append(engine_workload(name, group, tiles=tiles, lanes=lanes))
        sizes.append({"lanes": lanes, "tiles": tiles, "variants": variants})

    for lanes in (LANES,) if quick else LANE_COUNTS:
        add(f"lanes_{lanes}", silent, lanes=lanes)
    for tiles in TILE_COUNTS[:1] if quick else TILE_COUNTS:
        add(f"tiles_{tiles}", silent, tiles=tiles)
    for count in VARIANT_COUNTS[-1:] if quick else VARIANT_COUNTS:
        add(f"variants_{count}", select_last_variants(noisy, count), variants=count)
    add("curves_off", silent)
    add("curves_on", storing)
    return [row | size for row, size in zip(measure_workloads(cases, repeats), sizes, strict=True)]


if __name__ == "__main__":
    common.main(rows)

"""What draws cost: noise with 64, 6, 2 and 1 variants that share one, and bases of their own."""

import common
from cases import (
    default_group,
    disturbed_group,
    drawn_motion_group,
    engine_workload,
    remove_noise,
    select_last_variants,
    shorten_runs,
)
from timing import Row, measure_relative_to_base

BASE_VARIANTS = 2
"""Variants a draw where each draw has a base of its own."""


def rows(quick: bool, repeats: int) -> list[Row]:
    """Time the engine with noise, in turns with the same without.

    Returns:
        ``noise_off``, then rows with ``variants`` and their ``ratio`` to it: ``noise_N``,
        ``silent_N``, which has the samples of several draws a tile to hand out but none to draw,
        ``disturbed_1``, ``noise_1`` with surge, lever arm and bias instability on top, and
        ``base_2``, ``noise_2`` with a base of its own for each draw.
    """
    group, based = default_group(), drawn_motion_group(BASE_VARIANTS)
    if quick:
        group, based = shorten_runs(group, 2), shorten_runs(based, 2)
    off = engine_workload("noise_off", remove_noise(group))
    cases, variants = [], []
    for count in (64, BASE_VARIANTS) if quick else (64, 6, BASE_VARIANTS, 1):
        some = select_last_variants(group, count)
        cases.append(engine_workload(f"noise_{count}", some))
        variants.append(count)
        if count < 64:
            cases.append(engine_workload(f"silent_{count}", remove_noise(some)))
            variants.append(count)
    if not quick:
        cases.append(engine_workload("disturbed_1", disturbed_group(1)))
        variants.append(1)
    cases.append(engine_workload(f"base_{BASE_VARIANTS}", based))
    variants.append(BASE_VARIANTS)
    base, *others = measure_relative_to_base(off, cases, repeats)
    sizes = [{"variants": count} for count in variants]
    return [base, *(row | size for row, size in zip(others, sizes, strict=True))]


if __name__ == "__main__":
    common.main(rows)

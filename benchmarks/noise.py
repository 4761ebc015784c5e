"""What noise costs: against silent sensors, with 64, 6 and 1 variants that share a draw."""

import common

from sinsjax.bench.cases import default_group, engine, shortened, some_variants, without_noise
from sinsjax.bench.timing import Row, measure_against


def rows(quick: bool, repeats: int) -> list[Row]:
    """Time the engine with noise, in turns with the same without.

    Returns:
        ``noise_off``, then rows with ``variants`` and their ``ratio`` to it: ``noise_N``, and
        ``silent_N``, which has the samples of several draws a tile to hand out but none to draw.
    """
    group = default_group()
    if quick:
        group = shortened(group, 2)
    off = engine("noise_off", without_noise(group))
    cases, variants = [], []
    for count in (64, 1) if quick else (64, 6, 1):
        some = some_variants(group, count)
        cases.append(engine(f"noise_{count}", some))
        variants.append(count)
        if count < 64:
            cases.append(engine(f"silent_{count}", without_noise(some)))
            variants.append(count)
    base, *others = measure_against(off, cases, repeats)
    told = [row | {"variants": count} for row, count in zip(others, variants, strict=True)]
    return [base, *told]


if __name__ == "__main__":
    common.main(rows)

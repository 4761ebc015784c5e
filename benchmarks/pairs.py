"""The engine beside the limit kernel, in alternating pairs on one core: how far from the limit?"""

import shutil
import tempfile

import common

from sinsjax.bench.cases import default_group, engine, shortened, without_noise
from sinsjax.bench.limit import limit_kernel
from sinsjax.bench.timing import Row, ratios, row, spread, turns
from sinsjax.types import InputError


def rows(quick: bool, repeats: int) -> list[Row]:
    """Time ``limit_kernel`` and ``kalman_shared_record`` in pairs.

    Returns:
        A row each; the engine's has ``ratios``, one a pair, with their median and half range.

    Raises:
        InputError: there is no gcc, or it cannot build the kernel.
    """
    compiler = shutil.which("gcc")
    if compiler is None:
        raise InputError("no gcc here to build the limit kernel")
    group = without_noise(default_group())
    if quick:
        group = shortened(group, 2)
    with tempfile.TemporaryDirectory(prefix="sinsjax-limit-") as folder:
        kernel = limit_kernel(compiler, folder, **({"steps": 200} if quick else {}))
        ours = engine("kalman_shared_record", group)
        its, taken = turns([kernel, ours], repeats)
    found = ratios(ours, kernel, taken, its)
    told = spread("ratio", found) | {"ratios": [round(ratio, 3) for ratio in found]}
    return [row(kernel, its), row(ours, taken) | told]


if __name__ == "__main__":
    common.main(rows)

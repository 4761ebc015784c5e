"""The cost of an answer without draws: covariance analysis, compared with plain runs."""

import common
import numpy as np

from sinsjax.bench.cases import default_group, engine_workload, shorten_runs
from sinsjax.bench.timing import Row, measure_relative_to_base
from sinsjax.covariance import analysis

SAMPLES = (2, 64)
"""Errors sampled beside a noise-free run; the fewest tell what the run and its covariance cost."""


def rows(quick: bool, repeats: int) -> list[Row]:
    """Time each in turns with plain runs of 64 variants a draw.

    Returns:
        ``plain``, then ``covariance_N`` with N sampled errors, with their ``ratio`` to it.
    """
    group = shorten_runs(default_group(), 2) if quick else default_group()
    one = group.select(np.arange(1), np.arange(group.sizes[1]))
    cases = [engine_workload(f"covariance_{n}", analysis.analysis_group(one, n)) for n in SAMPLES]
    return measure_relative_to_base(engine_workload("plain", group), cases, repeats)


if __name__ == "__main__":
    common.main(rows)

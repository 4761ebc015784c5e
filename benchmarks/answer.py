"""What an answer costs without draws: covariance analysis and companions, beside plain runs."""

import time

import common
import jax
import numpy as np

from sinsjax.bench.cases import default_group, engine, shortened, some_variants
from sinsjax.bench.timing import Row, Workload, measure_against
from sinsjax.engine import companions, covariance
from sinsjax.engine.lanes import Group
from sinsjax.engine.realisations import Draw

SAMPLES = (2, 64)
"""Errors sampled beside a noise-free run; the fewest tell what the run and its covariance cost."""


def rows(quick: bool, repeats: int) -> list[Row]:
    """Time each in turns with plain runs of 64 variants a draw.

    Returns:
        ``plain``, then ``covariance_N`` with N sampled errors and ``companion``, with their
        ``ratio`` to it.
    """
    group = shortened(default_group(), 2) if quick else default_group()
    one = group._replace(draws=_draws(group, 1), q=group.q[:1])
    cases = [engine(f"covariance_{n}", covariance.watched(one, n)) for n in SAMPLES]
    return measure_against(engine("plain", group), [*cases, _companions(group)], repeats)


def _draws(group: Group, count: int) -> Draw:
    """As many draws as asked for, beginning as the group's first."""
    first: Draw = jax.tree.map(lambda a: np.repeat(a[:1], count) if np.ndim(a) else a, group.draws)
    ids = np.arange(count, dtype=first.draw_id.dtype)
    return first._replace(draw_id=ids)


def _companions(group: Group) -> Workload:
    """A call of companions: some variants by many draws."""
    width, height = companions.FEW_VARIANTS
    some, draws = some_variants(group, width), _draws(group, height)
    some = some._replace(draws=draws, q=np.repeat(group.q[:1], height, axis=0))

    def call() -> float:
        since = time.process_time()
        list(companions.of_group(some))
        return time.process_time() - since

    compile_s = call()
    steps = some.static.records * some.static.record_every
    return Workload(
        "companion",
        width * height,
        steps,
        compile_s,
        call,
    )


if __name__ == "__main__":
    common.main(rows)

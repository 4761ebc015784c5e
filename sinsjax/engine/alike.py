"""Variants that have the same runs: one of them is computed, and its results are those of all."""

from typing import NamedTuple

import jax
import numpy as np

from sinsjax.engine.batch import Chunk, Plan
from sinsjax.engine.realisations import Static

LEAST_SAVED = 1 / 4
"""Share of its tiles that a group has to save: else all its variants are computed."""


class Alike(NamedTuple):
    """Variants of a part, those with the same runs side by side.

    Attributes:
        computed: (computed,) one variant of each kind, as places in the part.
        variants: (variants,) places in the part, kind by kind in the order of ``computed``.
        counts: (computed,) how many variants are of each kind.
    """

    computed: np.ndarray
    variants: np.ndarray
    counts: np.ndarray

    def runs(self, plan: Plan, call: int) -> int:
        """How many runs a call of the computed variants stands for."""
        _, variant = plan.busy(call)
        return int(self.counts[variant].sum())

    def spread(self, chunk: Chunk) -> Chunk:
        """Results of computed variants as those of all, by draw and variant of the part."""
        counts = self.counts[chunk.variant]
        run = np.repeat(np.arange(len(counts)), counts)
        within = np.arange(len(run)) - np.repeat(np.cumsum(counts) - counts, counts)
        starts = np.cumsum(self.counts) - self.counts
        variant = self.variants[starts[chunk.variant][run] + within]
        in_order = np.lexsort((variant, chunk.draw[run]))
        run, variant = run[in_order], variant[in_order]
        outcome, curves = jax.tree.map(lambda a: a[run], (chunk.outcome, chunk.curves))
        return Chunk(chunk.draw[run], variant, outcome, curves)


def find_alike(static: Static, draws: int, kinds: np.ndarray) -> Alike | None:
    """Which variants of a part are computed; None for all of them.

    Args:
        static: its program.
        draws: how many it has.
        kinds: (variants,) a number that variants with the same runs share.
    """
    _, computed, kind, counts = np.unique(
        kinds, return_index=True, return_inverse=True, return_counts=True
    )
    all_tiles, tiles = (Plan(static, draws, count).tiles for count in (len(kinds), len(computed)))
    if tiles > (1 - LEAST_SAVED) * all_tiles:
        return None
    return Alike(computed, np.argsort(kind, kind="stable"), counts)

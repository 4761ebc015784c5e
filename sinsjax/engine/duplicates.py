"""Variants with identical runs: one of them is computed, and its results are copied to all."""

from typing import NamedTuple

import jax
import numpy as np

from sinsjax.engine.batch import Chunk, Layout
from sinsjax.engine.inputs import ProgramSpec

LEAST_SAVED = 1 / 4
"""Share of its tiles that a program must save; else all its variants are computed."""


class DuplicateVariants(NamedTuple):
    """Variants of a program, grouped by identical runs.

    Attributes:
        computed: (computed,) one variant of each group, as places in the program.
        variants: (variants,) places in the program, group by group in the order of ``computed``.
        counts: (computed,) number of variants of each group.
    """

    computed: np.ndarray
    variants: np.ndarray
    counts: np.ndarray

    def count_runs(self, computed: np.ndarray) -> int:
        """Return the number of runs whose results are those of runs of some computed variants."""
        return int(self.counts[computed].sum())

    def expand(self, chunk: Chunk) -> Chunk:
        """Return the results of all variants from those computed, by draw and variant."""
        counts = self.counts[chunk.variant]
        run = np.repeat(np.arange(len(counts)), counts)
        within = np.arange(len(run)) - np.repeat(np.cumsum(counts) - counts, counts)
        starts = np.cumsum(self.counts) - self.counts
        variant = self.variants[starts[chunk.variant][run] + within]
        in_order = np.lexsort((variant, chunk.draw[run]))
        run, variant = run[in_order], variant[in_order]
        outcome, curves = jax.tree.map(lambda a: a[run], (chunk.outcome, chunk.curves))
        return Chunk(chunk.draw[run], variant, outcome, curves)


def find_duplicates(spec: ProgramSpec, draws: int, kinds: np.ndarray) -> DuplicateVariants | None:
    """Return the duplicate variants of a program; None if all of them are to be computed.

    Args:
        spec: their program.
        draws: number of its draws.
        kinds: (variants,) a number that variants with identical runs share.
    """
    _, computed, kind, counts = np.unique(
        kinds, return_index=True, return_inverse=True, return_counts=True
    )
    all_tiles, tiles = (Layout(spec, draws, count).tiles for count in (len(kinds), len(computed)))
    if tiles > (1 - LEAST_SAVED) * all_tiles:
        return None
    return DuplicateVariants(computed, np.argsort(kind, kind="stable"), counts)

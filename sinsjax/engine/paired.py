"""Runs and their companions, a few variants and draws at a time."""

from typing import NamedTuple

import jax
import numpy as np

from sinsjax.engine import companions
from sinsjax.engine.batch import Calls, Chunk
from sinsjax.engine.companions import FEW_VARIANTS, Block, Companions
from sinsjax.engine.lanes import Group


class PairedChunk(NamedTuple):
    """Results of some runs of a group and of their companions.

    Attributes:
        runs: those of the runs.
        companions: `Companions` with leaves (..., runs).
    """

    runs: Chunk
    companions: Companions


LEAST_VARIANTS = 32
"""Of the runs of a block: the more of them a draw has, the less its noise costs each."""


class Blocks:
    """The runs of a group cut into blocks of some variants by some draws.

    Attributes:
        size: of a block.
        of_companions: variants and draws of a call of companions, of which a block takes several.
    """

    def __init__(self, draws: int, variants: int, of_companions: Block = FEW_VARIANTS) -> None:
        self.of_companions, width = of_companions, max(LEAST_VARIANTS, of_companions.variants)
        self._draws, self._variants = draws, variants
        self.size = Block(min(width, variants), of_companions.draws)
        self._across = -(-variants // self.size.variants)

    def __len__(self) -> int:
        return self._across * -(-self._draws // self.size.draws)

    def __getitem__(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Places of a block's draws, and of its variants."""
        down, across = divmod(number, self._across)
        (width, height), (end, last) = self.size, (self._variants, self._draws)
        draws = np.arange(down * height, min((down + 1) * height, last))
        return draws, np.arange(across * width, min((across + 1) * width, end))

    def call_of(self, draw: int, variant: int) -> int:
        """The number of the block that has a run."""
        return draw // self.size.draws * self._across + variant // self.size.variants

    def runs(self, number: int) -> int:
        """How many runs a block has."""
        draws, variants = self[number]
        return len(draws) * len(variants)


class PairedCalls:
    """The blocks of a group, any of them in any order and from any thread."""

    def __init__(
        self, group: Group, records: np.ndarray, of_companions: Block = FEW_VARIANTS
    ) -> None:
        """Trace the programs of a group.

        Args:
            group: what to run.
            records: numbers, from 0, of the records at which companions are told.
            of_companions: variants and draws of a call of companions.
        """
        self._group, self._records = group, records
        self.plan = Blocks(*group.sizes, of_companions)
        self._of_companions = companions.program(group, records, of_companions)
        self._of_runs = self._calls(*self.plan[0])

    def compile(self) -> None:
        """Compile what the first block would else compile."""
        self._of_runs.compile()
        self._of_companions.compiled()

    def _calls(self, draws: np.ndarray, variants: np.ndarray) -> Calls:
        """The runs of a block; filled up to the variants of the first, they share its program."""
        filled = np.pad(variants, (0, self.plan.size.variants - len(variants)), mode="edge")
        return Calls(self._group.some(draws, filled))

    def _companions(self, draws: np.ndarray, variants: np.ndarray) -> Companions:
        """Of the runs of a block, leaves (..., variants, draws)."""
        size = self.plan.of_companions
        cuts = np.split(variants, range(size.variants, len(variants), size.variants))
        made = [companions.of_block(self._group, some, draws, self._records, size) for some in cuts]
        whole: Companions = jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=-2), *made)
        return whole

    def chunk(self, number: int) -> PairedChunk:
        """Run a block of the plan, and the companions of its runs."""
        draws, variants = self.plan[number]
        made = self._calls(draws, variants).whole()
        asked = made.variant < len(variants)
        made = jax.tree.map(lambda a: a[asked], made)
        beside = self._companions(draws, variants)
        row = np.searchsorted(self._group.draws.draw_id[draws], made.draw)
        return PairedChunk(
            made._replace(variant=variants[made.variant]),
            jax.tree.map(lambda a: a[..., made.variant, row], beside),
        )

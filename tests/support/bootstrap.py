"""How far the spread of draws may be off."""

from functools import cache

import numpy as np


def intervals(errors: np.ndarray, tail: float, resamples: int = 4000) -> np.ndarray:
    """(2, n) ends of the bootstrap intervals of the standard deviations of errors (draws, n).

    Args:
        errors: a row a draw.
        tail: share of resamples beyond either end.
        resamples: how many.
    """
    draws = len(errors)
    # Only how often a draw is taken matters: sums by matrix products, and no draw is looked up.
    off = errors - errors.mean(axis=0)
    mean, square = (_taken(draws, resamples) @ power / draws for power in (off, off**2))
    found = np.sqrt((square - mean**2) * draws / (draws - 1))
    return np.quantile(found, [tail, 1 - tail], axis=0)


@cache
def _taken(draws: int, resamples: int) -> np.ndarray:
    """(resamples, draws) how often each draw is taken."""
    random = np.random.default_rng(1)
    return random.multinomial(draws, np.full(draws, 1 / draws), resamples).astype(float)

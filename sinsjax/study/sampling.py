"""The values of drawn keys per draw, functions of the seed, of [drawn] and of the draw's number.

With random sampling each key has a separate stream; Sobol points have one dimension per number of
all keys.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np

from sinsjax.study.schema import NUMBERS_DRAWN, Distribution, DrawnSection
from sinsjax.study.study import Study

_SOBOL_BITS = 30  # 2^30 points, more than the draws of a study
_RANDOM_BITS = 52  # the middle of an interval of 2^-52 is still a double


def drawn_values(study: Study, count: int, *, first: int = 0) -> dict[str, np.ndarray]:
    """Return the values of all drawn keys in the draws ``first`` to ``first + count - 1``.

    By key, in the order and in the units of the file: (count,), or (count, 3 or 6) for a key with
    one number per axis.
    """
    if study.drawn is None:
        return {}
    laws, seed = study.drawn.laws, study.seed
    continuous = [key for key, law in laws.items() if law.uniform or law.normal]
    make_points = _sobol_points if study.drawn.sampling == "sobol" else _random_points
    points = make_points(continuous, seed, first, count)
    drawn = _listed_values(laws, np.arange(first, first + count))
    drawn |= {key: _apply_distribution(laws[key], points[key]) for key in continuous}
    return {key: drawn[key] if NUMBERS_DRAWN[key] > 1 else drawn[key][:, 0] for key in laws}


def truncate_drawn_table(drawn: DrawnSection, count: int) -> dict[str, Any]:
    """Return [drawn] of a study with fewer draws, with the same values in each of them."""
    table = drawn.model_dump(exclude_none=True)
    for key, rows in _listed_values(drawn.laws, np.arange(count)).items():
        table[key] = {"values": (rows if NUMBERS_DRAWN[key] > 1 else rows[:, 0]).tolist()}
    return table


def _random_points(keys: Iterable[str], seed: int, first: int, count: int) -> dict[str, np.ndarray]:
    """Return independent points in (0, 1), (count, numbers) by key, from one stream per key."""
    points = {}
    for key in keys:
        # Raw words instead of a Generator, whose methods numpy may change.
        bits = np.random.PCG64(np.random.SeedSequence(seed, spawn_key=tuple(key.encode())))
        bits.advance(first * NUMBERS_DRAWN[key])
        words = bits.random_raw(count * NUMBERS_DRAWN[key]) >> np.uint64(64 - _RANDOM_BITS)
        points[key] = (words.reshape(count, NUMBERS_DRAWN[key]) + 0.5) * 2.0**-_RANDOM_BITS
    return points


def _sobol_points(keys: list[str], seed: int, first: int, count: int) -> dict[str, np.ndarray]:
    """Return scrambled Sobol points in (0, 1), (count, numbers) by key, a dimension per number."""
    if not keys:
        return {}
    # The import takes a second or more, and few studies need it.
    from scipy.stats import qmc

    numbers = [NUMBERS_DRAWN[key] for key in keys]
    rng = np.random.Generator(np.random.PCG64(seed))
    engine = qmc.Sobol(sum(numbers), bits=_SOBOL_BITS, rng=rng)
    if first:
        engine.fast_forward(first)
    # One point first: scipy warns if the first call does not ask for 2^m points.
    points = np.concatenate([engine.random(min(count, 1)), engine.random(max(count - 1, 0))])
    points += 2.0 ** -(_SOBOL_BITS + 1)
    return dict(zip(keys, np.split(points, np.cumsum(numbers)[:-1], axis=1), strict=True))


def _apply_distribution(law: Distribution, points: np.ndarray) -> np.ndarray:
    """Transform points in (0, 1) to a distribution."""
    if law.uniform:
        low, high = law.uniform
        return low + (high - low) * points
    # Slow to import, as above.
    from scipy.special import ndtri

    mean, deviation = law.normal or (0.0, 0.0)
    return mean + deviation * ndtri(points)


def _listed_values(laws: dict[str, Distribution], draws: np.ndarray) -> dict[str, np.ndarray]:
    """Return the entries of lists in some draws, (draws, numbers) by key."""
    rows_by_key = {}
    for key, law in laws.items():
        if law.values:
            numbers = (
                np.broadcast_to(np.asarray(v, float), NUMBERS_DRAWN[key]) for v in law.values
            )
            rows_by_key[key] = np.stack(list(numbers))[draws % len(law.values)]
    return rows_by_key

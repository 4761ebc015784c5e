"""The values of keys in some variants of a study, and those of drawn keys in its draws.

Drawn values are functions of the seed, of [drawn] and of the number of the draw. With random
sampling each key has a separate stream; Sobol points have one dimension per number of all keys.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from typing import Any

import numpy as np

from sinsjax.study.schema import NUMBERS_DRAWN, Distribution, DrawnSection
from sinsjax.study.study import Study
from sinsjax.study.sweep import CodedColumn
from sinsjax.units import si_factor

Lookup = Callable[[str], Any]
"""Function of a key that returns its common value in all variants of a program, or its draws."""


class Variants:
    """Columns of a study for some of its variants, as a method reads them.

    Attributes:
        ids: (variants,) numbers of the variants in the study.
        site, micro_g: `methods.method.Site`, and the micro-g that the study counts in, m/s^2; for
            params only.
        record_interval_s, run_s: time between two record times, length of the shortest run, s.

    Its other attributes are those of the study.
    """

    def __init__(
        self,
        study: Study,
        ids: np.ndarray,
        drawn: Mapping[str, np.ndarray] | None = None,
        *,
        site: Any = None,
        micro_g: float = math.nan,
    ) -> None:
        """Take some variants by their ids; ``drawn`` has the values of the study's draws by key."""
        self.study, self._drawn = study, drawn or {}
        self.ids, self.count = ids, len(ids)
        self.site, self.micro_g = site, micro_g
        self.run_s, self.end, self.rate_hz = study.run_s, study.end, study.rate_hz
        self.record_interval_s, self.is_recorded = study.study.record_interval_s, study.is_recorded
        self.has, self.given_in, self.refuse = study.has, study.given_in, study.refuse
        self.combinations, self.given_combinations = study.combinations, study.given_combinations

    @cached_property
    def _are_all(self) -> bool:
        return self.count == self.study.n_variants and bool(np.all(np.diff(self.ids) == 1))

    def coded(self, *keys: str) -> CodedColumn:
        """Return the column of these variants, see `Study.coded`."""
        whole = self.study.coded(*keys)
        return whole if self._are_all else whole.take(self.ids)

    def _map(self, function: Callable[..., Any], keys: tuple[str, ...]) -> CodedColumn:
        """Return the column of a function of the values of some keys."""
        return self.coded(*keys).map(function if len(keys) == 1 else lambda row: function(*row))

    def value(self, key: str, variant: int) -> Any:
        """Return the value of a key in the variant with this index in the program."""
        codes, choices = self.study.coded(key)
        return choices[codes[self.ids[variant]]]

    def column(self, key: str, factor: float = 1.0) -> Any:
        """Return the values of a numeric key times a factor, (variants,); zeros for a drawn key."""
        if key in self.study.drawn_keys:
            return np.zeros(self.count)
        return self.compute(lambda value: math.nan if value is None else value * factor, key)

    def si(self, key: str) -> Any:
        """Return the values of a numeric key in SI units, (variants,); zeros for a drawn key."""
        return self.column(key, si_factor(key, self.micro_g))

    def rms(self, key: str) -> np.ndarray:
        """Return the size of a numeric key, (variants,): rms over draws of the largest axis."""
        law = None if self.study.drawn is None else self.study.drawn.laws.get(key)
        if law is not None:
            return np.full(self.count, law.rms)
        return self.compute(lambda value: float(np.abs(value or 0.0).max()), key)

    def compute(self, function: Callable[..., Any], *keys: str, dtype: Any = float) -> Any:
        """Return a function of the values of some keys, called once per combination."""
        return self._map(function, keys).expand(dtype)

    def lists(self, function: Callable[..., Any], *keys: str, padding: float) -> Any:
        """Return a function that gives lists, (variants, longest), padded with ``padding``."""
        column = self._map(function, keys)
        longest = max(map(len, column.choices))
        padded = column.map(lambda entries: [*entries, *[padding] * (longest - len(entries))])
        return padded.expand()

    def common(self, key: str) -> Any:
        """Return the value of a key that all these variants share.

        For a drawn key, None, or the values of the draws, (draws, ...), if they were given.
        """
        return self._drawn[key] if key in self._drawn else self.value(key, 0)

    def is_active(self, *keys: str) -> bool:
        """Return whether one of some keys, which all variants share, is drawn or not zero."""
        drawn = self.study.drawn_keys
        return any(key in drawn or np.any(self.value(key, 0) or 0) for key in keys)

    @classmethod
    def all_of(cls, study: Study) -> "Variants":
        """Return all variants of a study."""
        return cls(study, np.arange(study.n_variants))


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
    from scipy.special import ndtri  # slow to import, as above

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

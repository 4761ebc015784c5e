"""The values of keys in a part of a study, which is some of its variants."""

import math
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import numpy as np

from sinsjax.study.study import Study
from sinsjax.study.sweep_columns import CodedColumn
from sinsjax.units import si_factor

Lookup = Callable[[str], Any]
"""Function of a key that returns its common value in all variants of a part, or its draws."""


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
        """Return the value of a key in the variant with this index in the part."""
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

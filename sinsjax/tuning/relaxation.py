"""Differentiable dependence of a method's parameters on the tuning variables.

Each variable changes its method's parameters by the ratio of its value to that at a base point, see
`methods.base.Relaxed`. Where a variable moves resets, these become smooth windows.
"""

from collections.abc import Iterator
from typing import Any, NoReturn

import jax.numpy as jnp

from sinsjax.errors import InputError
from sinsjax.methods.base import Relaxed
from sinsjax.methods.registry import METHODS
from sinsjax.study.keys import SECTION_OF, TomlTable
from sinsjax.study.load import with_point
from sinsjax.study.rules import is_modelled
from sinsjax.study.search_space import SearchSpace, Variable
from sinsjax.study.study import Study
from sinsjax.study.sweep import COUNT, TIMES
from sinsjax.types import Array, Scalar


class Relaxation:
    """Conversion of a method's parameters from a base point to any other, with resets relaxed.

    Attributes:
        point: the base point.
        moves_resets: whether a variable moves resets, all of which are then smooth windows.
        by_covariance: whether covariance analysis can stand for runs with noise: none of that, and
            it holds for the study.
    """

    def __init__(self, study: Study, space: SearchSpace, combination: TomlTable) -> None:
        """Check that all variables have a gradient.

        Args:
            study: study with [tune].
            space: search space of the study.
            combination: values of the candidates.

        Raises:
            InputError: ``[tune.variables] key: what is wrong (hint)``.
        """
        self._variables = {i: space.variables[i] for i in space.used(combination)}
        self.point = space.point(space.values([0.5] * len(space.variables)), combination)
        based = with_point(study, self.point)
        methods = sorted({point["method"] for point in based.combinations("method")})
        relaxed = [METHODS[name].implementation.relaxed or Relaxed({}) for name in methods]
        for variable in self._variables.values():
            if all(variable.key not in (r.times, *r.changes) for r in relaxed):
                _refuse(study, f"[tune.variables] {variable.key}")
        keys = {variable.key for variable in self._variables.values()}
        self.moves_resets = any(
            one.soften and not keys.isdisjoint({one.times, *one.moves}) for one in relaxed
        )
        self.by_covariance = not self.moves_resets and is_modelled(based)
        for one in relaxed:
            if what := one.refused(based, self.moves_resets):
                _refuse(study, what)
        self._left_out = {
            twin
            for one in relaxed
            for twin in one.follows.values()
            if not based.has(SECTION_OF[twin]) or based.values(twin)[0] is None
        }
        self._rate_hz = study.rate_hz
        ranges = space.ranges.get(TIMES, ())
        assert isinstance(ranges, tuple)
        count = combination.get(COUNT, len(ranges))
        self._fixed = [kind.fixed for kind in ranges[:count]]

    def __call__(self, method: str, params: Any, box: Array, width: Scalar) -> Any:
        """The method's parameters of one run at a point.

        Args:
            method: name of the method.
            params: parameters of the method at the base point.
            box: (p,) positions of the used variables in their ranges, 0 to 1.
            width: half width of the windows, samples.
        """
        relaxed = METHODS[method].implementation.relaxed or Relaxed({})
        times: list[Any] = list(self._fixed)
        for at, variable in zip(box, self._variables.values(), strict=True):
            value, base = variable.value(at), variable.value(0.5)
            if variable.key == TIMES:
                times[variable.entry or 0] = value
                continue
            for key in self._moved(relaxed, variable):
                params = relaxed.changes[key](params, variable.entry, value, base)
        if relaxed.soften is None or not self.moves_resets:
            return params
        samples = None
        if times:
            samples = jnp.stack([jnp.asarray(time) for time in times]) * self._rate_hz
        return relaxed.soften(params, samples, width)

    def _moved(self, relaxed: Relaxed, variable: Variable) -> Iterator[str]:
        """Keys that a variable changes numbers by: its own, and one that it stands for."""
        key, twin = variable.key, relaxed.follows.get(variable.key)
        if key in relaxed.changes:
            yield key
        if twin is not None and twin in relaxed.changes and twin in self._left_out:
            yield twin


def _refuse(study: Study, what: str) -> NoReturn:
    text = "has no gradient (use 'sobol' instead of 'gradient')"
    raise InputError(f"{study.name}: {what}: {text}")

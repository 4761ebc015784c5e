"""Differentiable dependence of a method's parameters on the tuning variables.

Each variable changes its method's parameters by the ratio of its value to that at a base point, see
`methods.base.Relaxed`. Where a variable moves resets, these become smooth windows.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.engine.build import Scenario
from sinsjax.errors import InputError
from sinsjax.methods.base import Change, Relaxed
from sinsjax.methods.guarding import defined, place
from sinsjax.methods.registry import METHODS, PACKAGES, from_package
from sinsjax.records.reference import StoredRecord
from sinsjax.study.keys import SECTION_OF, TomlTable
from sinsjax.study.load import with_point
from sinsjax.study.rules import has_covariance_model
from sinsjax.study.search_space import SearchSpace, Variable
from sinsjax.study.study import Study
from sinsjax.study.sweep import COUNT, TIMES
from sinsjax.tuning import search
from sinsjax.types import Array, Scalar

_ROUNDING = 1e-6
"""Relative difference of numbers that are equal but for rounding."""


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
        self._study = study
        self._variables = {i: space.variables[i] for i in space.used_variables(combination)}
        self.point = space.make_point(space.to_values([0.5] * len(space.variables)), combination)
        based = with_point(study, self.point)
        methods = {point["method"] for point in based.combinations("method")}
        self._methods = sorted(methods)
        relaxed = [METHODS[name].implementation.relaxed or Relaxed({}) for name in self._methods]
        for variable in self._variables.values():
            if all(variable.key not in (r.times, *r.changes) for r in relaxed):
                _refuse(study, f"[tune.variables] {variable.key}")
        keys = {variable.key for variable in self._variables.values()}
        self.moves_resets = any(
            one.soften and not keys.isdisjoint({one.times, *one.moves}) for one in relaxed
        )
        self.by_covariance = not self.moves_resets and has_covariance_model(based)
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

    def check_changes(self, stored: StoredRecord | None = None) -> None:
        """Trace how the numbers of methods of other packages follow the variables.

        At its base value a key leaves the numbers as they were made from it, and somewhere in its
        range they follow it.

        Args:
            stored: the record of a recorded study.

        Raises:
            InputError: a function fails, or gives other numbers; names its package.
        """
        if PACKAGES.keys().isdisjoint(self._methods):
            return
        derived = search.derive(self._study, {"base": self.point}, name=self._study.name)
        scenario = Scenario(derived, stored, curves=False)
        for number, program in enumerate(scenario.programs):
            if program.method in PACKAGES:
                group = scenario.part(number, range(1), blank=stored is None).group
                self._check_of(program.method, jax.tree.map(jnp.asarray, group.variants.method))

    def _check_of(self, method: str, params: Any) -> None:
        """Check the changes of a method; its numbers at the base point, leaves (variants, ...)."""
        relaxed = METHODS[method].implementation.relaxed or Relaxed({})
        for variable in self._variables.values():
            for key in self._moved(relaxed, variable) if variable.key != TIMES else ():
                change = relaxed.changes[key]
                acts = key == variable.key  # what follows it may have nothing to change
                if wrong := _not_following(change, variable, params, acts=acts):
                    what = f"relaxed.changes[{key!r}]: {wrong}{defined(change)}"
                    raise InputError(f"{from_package(method)}: {what}")
        middle = jnp.full(len(self._variables), 0.5)
        jax.eval_shape(
            jax.vmap(partial(self, method), in_axes=(0, None, None)), params, middle, 1.0
        )

    def _moved(self, relaxed: Relaxed, variable: Variable) -> Iterator[str]:
        """Keys that a variable changes numbers by: its own, and one that it stands for."""
        key, twin = variable.key, relaxed.follows.get(variable.key)
        if key in relaxed.changes:
            yield key
        if twin is not None and twin in relaxed.changes and twin in self._left_out:
            yield twin


def _not_following(change: Change, variable: Variable, params: Any, *, acts: bool) -> str | None:
    """What is wrong with the numbers that a change gives, in words; None if nothing is.

    Args:
        change: of the numbers of one run.
        variable: that they follow.
        params: numbers at the base point, leaves (variants, ...).
        acts: whether some number has to follow it.
    """
    base = variable.value(0.5)

    def one_run(params: Any, value: Scalar) -> tuple[Any, Any]:
        def changed(value: Scalar) -> Any:
            return change(params, variable.entry, value, base)

        found, slopes = jax.jvp(changed, (value,), (jnp.ones_like(value),))
        real = [a for a in jax.tree.leaves(slopes) if a.dtype != jax.dtypes.float0]
        return found, jnp.array([jnp.any(a != 0) for a in real]).any()

    at = jax.jit(jax.vmap(one_run, in_axes=(0, None)))
    found, _ = at(params, jnp.asarray(base))
    made, have = jax.tree_util.tree_leaves_with_path(params), jax.tree.leaves(found)
    for (path, number), other in zip(made, have, strict=True):
        if not np.allclose(other, number, rtol=_ROUNDING, atol=0, equal_nan=True):
            text = f"gives {place('numbers', path)} = {np.ravel(other)[0]:.6g}"
            made_from = f"at the value {base:.6g} that the numbers were made from"
            return f"{text}, not {np.ravel(number)[0]:.6g}, {made_from}"
    if not acts or any(
        np.any(at(params, jnp.asarray(variable.value(end)))[1]) for end in (0.0, 0.5, 1.0)
    ):
        return None
    low, high = variable.low, variable.high
    return f"no number changes with it at {low:.6g}, {base:.6g} and {high:.6g}"


def _refuse(study: Study, what: str) -> NoReturn:
    text = "has no gradient (use 'sobol' instead of 'gradient')"
    raise InputError(f"{study.name}: {what}: {text}")

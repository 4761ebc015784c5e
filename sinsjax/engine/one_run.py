"""One run of a study as a function of its numbers, to map over and to differentiate.

run = sinsjax.one_run(study)
outcome = run(run.params, run.draw(0))
outcomes = jax.vmap(run, in_axes=(None, 0))(run.params, run.draws)
"""

import warnings
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.engine.batch import Batch, Chunks
from sinsjax.engine.inputs import Draw, RunParams, Tiles
from sinsjax.engine.metrics import Outcome
from sinsjax.engine.run import run_tile
from sinsjax.engine.scenario import Scenario, StudySource
from sinsjax.errors import InputError
from sinsjax.methods.filters.keys import reset_key_without_gradient
from sinsjax.methods.schedules import FeedbackSchedule, PiecewiseConstant, Resets, smooth_resets
from sinsjax.records.reference import StoredRecord
from sinsjax.types import Array


class OneRun:
    """One run of a study: ``run(params, draw) -> Outcome``, a pure function.

    With plain arrays it gives what the engine gives for that run, to the last bit, by a program
    that is compiled once. Under `jax.jit`, `jax.vmap`, `jax.grad` and the like it is the same
    function to rounding (1e-9), traced into theirs.

    The final errors and sigmas of an outcome can be differentiated by all numbers that do not count
    samples; a gradient by one that does (reset times, feedback intervals) would be zero, and a
    warning says so. Settling times are times of records, whose gradient is zero without
    ``sharpness``.

    Attributes:
        params: numbers of the variant, leaves (...): what to change, map over or differentiate by.
            ``params.method`` are those of the method, in SI units: for a filter ``r`` is the
            variance of the measured velocity, m^2/s^2.
    """

    def __init__(self, batch: Batch, params: RunParams) -> None:
        """Take a batch of one variant, and the params of that, leaves (...)."""
        self._batch, self.params = batch, params
        self._traced = jax.jit(self._trace)  # a gradient is compiled once

    def __call__(self, params: RunParams, draw: Draw) -> Outcome:
        """Return the outcome of one run, SI units, angles in rad, leaves (...).

        Args:
            params: as `params`, or changed.
            draw: from `draw` or `draws`.
        """
        given: tuple[RunParams, Draw] = jax.tree.map(_as_double, (params, draw))
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(given)):
            return self._traced(*given)
        # The smallest compiled call: its bits depend on no other run.
        params, drawn = jax.tree.map(lambda a: a[None], given)
        alone = self._batch._replace(draws=drawn, params=params)
        chunk = Chunks(alone, tiles_per_chunk=1).compute(0)
        return jax.tree.map(lambda a: a[0], chunk.outcome)

    def draw(self, number: int) -> Draw:
        """Return one of the draws by its number; in a recorded study, that of a start time."""
        if not 0 <= number < self._batch.n_draws:
            text = f"the study has {self._batch.n_draws} draws, from 0"
            raise InputError(f"draw {number}: {text}")
        one: Draw = jax.tree.map(lambda a: a[number], self.draws)
        return one

    @cached_property
    def draws(self) -> Draw:
        """All draws of the study, leaves (draws, ...), to map over."""
        count = self._batch.n_draws
        all_: Draw = jax.tree.map(
            lambda a: a if np.ndim(a) else np.full(count, a), self._batch.draws
        )
        return all_

    def _trace(self, params: RunParams, draw: Draw) -> Outcome:
        """Return the outcome of a tile of one lane, traced with a loop that has all derivatives."""
        params = params._replace(method=_warn_if_differentiated_by_counts(params.method))
        draws, lanes = jax.tree.map(lambda a: jnp.asarray(a)[None], (draw, params))
        spec, tile = self._batch.spec, Tiles(draws, np.zeros(1, np.int32), lanes)
        outcome, _ = run_tile(spec, self._batch.environment, tile, by_event=False)
        only: Outcome = jax.tree.map(lambda a: a[0], outcome)
        return only


def one_run(
    study: StudySource,
    record: StoredRecord | None = None,
    *,
    variant_id: int = 0,
    window_s: float | None = None,
    sharpness: float | None = None,
) -> OneRun:
    """Return one run of a study as a function of its numbers, see `OneRun`.

    Args:
        study: study, its file, or the name of a shipped study.
        record: the record of a recorded study.
        variant_id: which variant of the study.
        window_s: None for resets at their times; else each is spread over a smooth window of this
            half width, some tens of samples or more, so that the times have a gradient.
        sharpness: None for bands with a hard edge; else how sharp they are, 8 or so, so that
            settling times have a gradient.

    Raises:
        InputError: the study has no such variant, the record does not fit, or the resets cannot be
            spread.

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.draws": 2, "study.rate_hz": 10.0})
        >>> run = sinsjax.one_run(study, variant_id=2)
        >>> outcome = run(run.params, run.draw(0))
        >>> bool(abs(outcome.last.phi.z) < 0.01)  # rad
        True
    """
    scenario = Scenario(study, record, curves=False)
    number, place = scenario.find(variant_id)
    batch = scenario.batch(number, variants=[place])
    params: RunParams = jax.tree.map(lambda a: np.asarray(a)[0], batch.params)
    if window_s is not None:
        source = f"{scenario.study.name}: window_s"
        soft = smooth_resets(params.method, np.float64(window_s * scenario.study.rate_hz))
        if soft is params.method:
            raise InputError(f"{source}: {batch.spec.method!r} has no resets to spread")
        if key := reset_key_without_gradient(scenario.keys(number), smoothed=True):
            raise InputError(f"{source}: {key} cannot be spread over windows")
        if not window_s * scenario.study.rate_hz >= 1:
            raise InputError(f"{source}: must be a sample or more, not {window_s:g}")
        params = params._replace(method=jax.tree.map(np.asarray, soft))
    if sharpness is not None:
        criteria = batch.environment.criteria._replace(sharpness=np.float64(sharpness))
        batch = batch._replace(environment=batch.environment._replace(criteria=criteria))
    return OneRun(batch, params)


def _as_double(leaf: Any) -> Any:
    """Return a number as an array; a tracer is returned unchanged."""
    return leaf if isinstance(leaf, jax.core.Tracer) else np.asarray(leaf)


_COUNTS: dict[type, tuple[str, str]] = {
    Resets: ("samples", "hard reset times"),
    FeedbackSchedule: ("every", "feedback intervals"),
    PiecewiseConstant: ("samples", "times at which gains change"),
}
"""Fields of schedules that count samples, and what they are in words."""


def _warn_if_differentiated_by_counts(params: Any) -> Any:
    """Return a method's params that warn if they are differentiated by counts of samples."""

    def wrap(part: Any) -> Any:
        if type(part) not in _COUNTS or getattr(part, "width", None) is not None:
            return part
        field, what = _COUNTS[type(part)]
        return part._replace(**{field: _constant_count(what, getattr(part, field))})

    return jax.tree.map(wrap, params, is_leaf=lambda part: type(part) in _COUNTS)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _constant_count(what: str, counts: Array) -> Array:
    """Return counts of samples unchanged; warn if they are differentiated by."""
    return jnp.asarray(counts)


def _warn_if_differentiated(what: str, primals: Any, tangents: Any) -> tuple[Array, Array]:
    (counts,), (slope,) = primals, tangents
    if counts.size and not isinstance(slope, jax.custom_derivatives.SymbolicZero):
        text = f"the gradient by {what} is zero, whatever a change of them would do"
        if what == _COUNTS[Resets][1]:
            text += " (one_run(study, window_s=...) spreads each reset over a smooth window)"
        warnings.warn(f"sinsjax.one_run: {text}", stacklevel=2)
    return jnp.asarray(counts), jnp.zeros_like(counts)


_constant_count.defjvp(_warn_if_differentiated, symbolic_zeros=True)

"""One run of a study as a function of its numbers, to map over and to differentiate.

run = sinsjax.one_run(study)
outcome = run(run.params, run.draw(0))
outcomes = jax.vmap(run, in_axes=(None, 0))(run.params, run.draws)
"""

import warnings
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.engine import batch
from sinsjax.engine.build import Scenario
from sinsjax.engine.environment import Draw, RunParams
from sinsjax.engine.lanes import Group, Tiles
from sinsjax.engine.metrics import Outcome
from sinsjax.engine.run import run_tile
from sinsjax.errors import InputError
from sinsjax.methods.filters.keys import find_without_gradient
from sinsjax.methods.schedules import FeedbackSchedule, PiecewiseConstant, Resets, smooth_resets
from sinsjax.platform import runtime
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import load_study, with_rate
from sinsjax.study.study import Study
from sinsjax.study.variants import Variants
from sinsjax.types import Array, Quat


class Realisation(NamedTuple):
    """The part of a run that its draw decides.

    Attributes:
        draw: noise, and whatever else a study draws or a start time decides.
        q: attitude before the initial misalignment is added: true, or coarsely aligned.
    """

    draw: Draw
    q: Quat


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

    def __init__(self, group: Group, params: RunParams) -> None:
        """Store a variant of a group.

        Args:
            group: with one variant.
            params: of that variant, leaves (...).
        """
        self._group, self.params = group, params

    def __call__(self, params: RunParams, draw: Realisation) -> Outcome:
        """Return the outcome of one run, SI units, angles in rad, leaves (...).

        Args:
            params: as `params`, or changed.
            draw: from `draw` or `draws`.
        """
        given: tuple[RunParams, Realisation] = jax.tree.map(_as_double, (params, draw))
        params, draw = given
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(given)):
            params = params._replace(q=draw.q, method=_warn_of_zero_gradients(params.method))
            return self._trace(params, draw.draw)
        return self._run_compiled(params, draw)

    def draw(self, number: int) -> Realisation:
        """Return one of the draws by its number; in a recorded study, that of a start time."""
        count = len(self._group.draws.draw_id)
        if not 0 <= number < count:
            raise InputError(f"draw {number}: the study has {count} draws, from 0")
        one: Realisation = jax.tree.map(lambda a: a[number], self.draws)
        return one

    @cached_property
    def draws(self) -> Realisation:
        """All draws of the study, leaves (draws, ...), to map over."""
        count = len(self._group.draws.draw_id)
        all_: Draw = jax.tree.map(
            lambda a: a if np.ndim(a) else np.full(count, a), self._group.draws
        )
        return Realisation(all_, Quat(*np.asarray(self._group.q).T))

    def _trace(self, params: RunParams, draw: Draw) -> Outcome:
        """Return the outcome of a tile of one lane, traced with a loop that has all derivatives."""
        draws, lanes = jax.tree.map(lambda a: jnp.asarray(a)[None], (draw, params))
        tile = Tiles(draws, np.zeros(1, np.int32), lanes)
        static = self._group.static._replace(curves=False)
        outcome, _ = run_tile(static, self._group.environment, tile, by_event=False)
        only: Outcome = jax.tree.map(lambda a: a[0], outcome)
        return only

    def _run_compiled(self, params: RunParams, draw: Realisation) -> Outcome:
        """Return the outcome of the smallest compiled call, whose bits depend on no other run."""
        first = partial(jax.tree.map, lambda a: np.asarray(a)[None])
        group = self._group._replace(
            draws=first(draw.draw), q=np.stack(draw.q)[None], variants=first(params)
        )
        chunk = batch.Calls(group, tiles_per_chunk=1).chunk(0)
        outcome: Outcome = jax.tree.map(lambda a: a[0], chunk.outcome)
        return outcome


def one_run(
    study: Study | str | Path,
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
            half width, some tens of samples or more, so that outcomes have a gradient by the times.
        sharpness: None for bands with a hard edge; else how sharp they are, 8 or so, so that
            settling times have a gradient.

    Raises:
        InputError: the study has no such variant, the record does not fit, or resets that cannot be
            spread.

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.draws": 2, "study.rate_hz": 10.0})
        >>> run = sinsjax.one_run(study, variant_id=2)
        >>> outcome = run(run.params, run.draw(0))
        >>> bool(abs(outcome.last.phi.z) < 0.01)  # rad
        True
    """
    runtime.ensure_configured()
    study = load_study(study)
    if record is not None and study.is_recorded:
        study = with_rate(study, record.record.rate_hz)
    if not 0 <= variant_id < study.n_variants:
        raise InputError(f"{study.name}: has no variant {variant_id}, of {study.n_variants}")
    scenario = Scenario(study, record, curves=False)
    number, place = next(
        (number, int(np.flatnonzero(ids == variant_id)[0]))
        for number, ids in enumerate(scenario.variant_ids)
        if variant_id in ids
    )
    group = scenario.part(number, variants=np.asarray([place])).group
    params: RunParams = jax.tree.map(lambda a: np.asarray(a)[0], group.variants)
    if window_s is not None:
        params = params._replace(method=_smooth_resets(study, group, params.method, window_s))
    if sharpness is not None:
        soft = group.environment.criteria._replace(sharpness=np.float64(sharpness))
        group = group._replace(environment=group.environment._replace(criteria=soft))
    return OneRun(group, params)


def _smooth_resets(study: Study, group: Group, method: Any, window_s: float) -> Any:
    """Return the params of a method with each reset spread over a smooth window."""
    soft = smooth_resets(method, np.float64(window_s * study.rate_hz))
    if soft is method:
        raise InputError(f"{study.name}: window_s: {group.static.method!r} has no resets to spread")
    if key := find_without_gradient(Variants.all_of(study), smoothed=True):
        raise InputError(f"{study.name}: window_s: {key} cannot be spread over windows")
    if not window_s * study.rate_hz >= 1:
        raise InputError(f"{study.name}: window_s: must be a sample or more, not {window_s:g}")
    return jax.tree.map(np.asarray, soft)


def _as_double(leaf: Any) -> Any:
    """Return a number as an array; a tracer is returned unchanged."""
    return leaf if isinstance(leaf, jax.core.Tracer) else np.asarray(leaf)


_COUNTS: dict[type, tuple[str, str]] = {
    Resets: (
        "samples",
        "hard reset times is zero, whatever a change of them would do"
        " (one_run(study, window_s=...) spreads each reset over a smooth window)",
    ),
    FeedbackSchedule: ("every", "feedback intervals is zero, whatever a change of them would do"),
    PiecewiseConstant: (
        "samples",
        "times at which gains change is zero, whatever a change of them would do",
    ),
}
"""Fields of schedules that count samples, and the warning about the gradient by them."""


def _warn_of_zero_gradients(method: Any) -> Any:
    """Return a method's params that warn if they are differentiated by counts of samples."""

    def wrap(part: Any) -> Any:
        if type(part) not in _COUNTS:
            return part
        field, text = _COUNTS[type(part)]
        return part._replace(**{field: _constant_count(text, getattr(part, field))})

    return jax.tree.map(wrap, method, is_leaf=lambda part: type(part) in _COUNTS)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _constant_count(text: str, counts: Array) -> Array:
    """Return counts of samples unchanged; warn if they are differentiated by."""
    return jnp.asarray(counts)


def _warn_if_differentiated(
    text: str, primals: tuple[Array], tangents: tuple[Any]
) -> tuple[Array, Array]:
    (counts,), (slope,) = primals, tangents
    if counts.size and not isinstance(slope, jax.custom_derivatives.SymbolicZero):
        warnings.warn(f"sinsjax.one_run: the gradient by {text}", stacklevel=2)
    return jnp.asarray(counts), jnp.zeros_like(counts)


_constant_count.defjvp(_warn_if_differentiated, symbolic_zeros=True)

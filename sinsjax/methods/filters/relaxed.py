"""How a filter's numbers follow the keys of a study, to be differentiated by them."""

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp

from sinsjax.methods.base import Change, Relaxed
from sinsjax.methods.description import StudyView
from sinsjax.methods.filters.section import Q_DENSITIES
from sinsjax.methods.filters.stages import FilterParams
from sinsjax.methods.filters.states import STATES, StateKind
from sinsjax.methods.schedules import Windows
from sinsjax.methods.triggers.section import any_trigger
from sinsjax.types import Array, Scalar

_NEVER = 1e15
"""Sample of a reset that there is not, instead of infinity."""


def _scaled(values: tuple[Scalar, ...], states: Sequence[int], factor: Scalar) -> tuple:
    return tuple(factor * v if i in states else v for i, v in enumerate(values))


def _p0(states: Sequence[int]) -> Change:
    def change(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
        return params._replace(p0=_scaled(params.p0, states, (value / base) ** 2))

    return change


def _reset_to(states: Sequence[int]) -> Change:
    def change(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
        return params._replace(reset_to=_scaled(params.reset_to, states, (value / base) ** 2))

    return change


def _q(states: Sequence[int], power: int) -> Change:
    def change(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
        return params._replace(q=_scaled(params.q, states, (value / base) ** power))

    return change


def _r(power: int) -> Change:
    def change(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
        return params._replace(r=params.r * (value / base) ** power)

    return change


def _feedback(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
    # 1 - gain = exp(-interval / constant).
    gain = -jnp.expm1(jnp.log1p(-params.feedback.gain) * base / value)
    return params._replace(feedback=params.feedback._replace(gain=gain))


def _first(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
    samples = params.resets.samples
    return _with_samples(params, samples + samples[:1] * (value / base - 1))


def _cycle(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
    samples = params.resets.samples
    return _with_samples(params, samples[:1] + (samples - samples[:1]) * (value / base))


def _with_samples(params: FilterParams, samples: Array) -> FilterParams:
    return params._replace(resets=params.resets._replace(samples=samples))


_CHANGES: dict[str, Change] = {
    "reset_first_s": _first,
    "reset_cycle_s": _cycle,
    "r_scale": _r(1),
    "r_velocity_m_per_s": _r(2),
    "feedback_time_constant_s": _feedback,
}
"""Of the keys that concern no state."""


def _changes(states: Sequence[str]) -> dict[str, Change]:
    kinds = [STATES[state] for state in states]

    def places(of: Callable[[StateKind], str | None], key: str) -> list[int]:
        return [place for place, kind in enumerate(kinds) if of(kind) == key]

    changes = dict(_CHANGES)
    for kind in dict.fromkeys(kinds):
        if kind.p0 is not None and kind.reset_to is not None:
            at = places(lambda kind: kind.p0, kind.p0)
            changes |= {kind.p0: _p0(at), kind.reset_to: _reset_to(at)}
    noisy = [place for place, kind in enumerate(kinds) if kind.q is not None]
    changes["q_scale"] = _q(noisy, 1)
    for key, densities in Q_DENSITIES.items():
        of_key = _q(places(lambda kind: kind.q, key), 2)
        changes |= dict.fromkeys((key, *densities), of_key)
    return changes


def _soften(params: FilterParams, times: Array | None, width: Scalar) -> FilterParams:
    resets = params.resets
    # An infinity has no slope.
    samples = jnp.where(jnp.isfinite(resets.samples), resets.samples, _NEVER)
    if times is not None:
        samples = times
    return params._replace(resets=Windows(samples, width, resets.covariance_reset))


def _refused(study: StudyView, spread: bool) -> str | None:
    if not study.has("resets"):
        return None
    if any_trigger(study):
        return "[resets] reset_trigger"
    if not spread:
        return None
    if any(point["reset_kind"] == "scale" for point in study.combinations("reset_kind")):
        return "[resets] reset_kind = 'scale'"
    for key in ("reset_at_feedback", "reset_restarts_feedback"):
        if any(point[key] for point in study.combinations(key)):
            return f"[resets] {key}"
    return None


def relaxed(states: Sequence[str]) -> Relaxed:
    """How the numbers of a filter follow the keys of a study; its states by name in `STATES`."""
    changes = _changes(states)
    # What P is reset to is what it is at the start; the first reset comes after a cycle.
    follows = {key: key.replace("p0_", "reset_") for key in changes if key.startswith("p0_")}
    follows["reset_cycle_s"] = "reset_first_s"
    moves = ("reset_first_s", "reset_cycle_s")
    return Relaxed(changes, follows, "reset_times_s", moves, _soften, _refused)

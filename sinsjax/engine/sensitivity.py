"""What draws begin with and the biases they have for themselves, as parts of the linear error.

A start that is off by more than the mean is an error d before the first sample. A bias is an error
of every increment, always the same, and it moves the bias floor that a heading is judged from.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.engine import simulate
from sinsjax.engine.realisations import (
    Draw,
    DrawnNormally,
    Environment,
    InitialErrors,
    Static,
    method_of,
)
from sinsjax.engine.simulate import RunParams
from sinsjax.maths import rotations
from sinsjax.maths.algebra import scale
from sinsjax.methods.base import Site, StartChange
from sinsjax.methods.floors import mean_biases
from sinsjax.types import Array, Scalar, Vec3


class Sensitivity(NamedTuple):
    """Derivatives of the runs of a tile, about the means of what is drawn.

    Attributes:
        start: (lanes, n, 5) of d before the first sample by what a draw begins with, see
            `DrawnNormally.begins_sigma`.
        limit: (lanes, 6) of the bias floor of phi_u by the biases of gyros and accelerometers in b,
            rad/(rad/s) and rad/(m/s^2); None where no bias is drawn.
    """

    start: Array
    limit: Array | None


def sensitivity(
    static: Static, environment: Environment, params: RunParams, site: Site, site_axis: int | None
) -> Sensitivity | None:
    """The derivatives where something is drawn normally, else None.

    Args:
        static: program.
        environment: shared by all.
        params: of the runs before `simulate.starting`, leaves (lanes, ...).
        site: leaves (lanes,), or () with ``site_axis`` None.
        site_axis: axis of the site.
    """
    drawn = environment.drawn
    if drawn is None:
        return None
    start = jax.vmap(partial(_of_start, static, drawn), in_axes=(0, site_axis))(params, site)
    if drawn.errors is None:
        return Sensitivity(start, None)
    of_limit = partial(_of_limit, static, environment)
    return Sensitivity(start, jax.vmap(of_limit, in_axes=(0, site_axis))(params, site))


def _of_start(static: Static, drawn: DrawnNormally, params: RunParams, site: Site) -> Array:
    """(n, 5) of one run."""
    method = method_of(static)
    begins = _numbers(drawn.begins, params)

    def navigation(numbers: tuple[Scalar, ...]) -> Any:
        own = InitialErrors(numbers[:3], *numbers[3:])
        begun = simulate.starting(params, own, None)
        return simulate.solution(site, rotations.misalign(begun.phi, begun.q), begun.ve, begun.vn)

    def column(place: int) -> Array:
        unit = tuple(jnp.full_like(a, float(i == place)) for i, a in enumerate(begins))
        nav, rate = jax.jvp(navigation, (begins,), (unit,))
        back = rotations.conjugate(nav.q)
        turn = rotations.multiply(rate.q, back)  # of exp(-d phi) q
        change = StartChange(
            rotations.multiply(params.q, back),
            scale(-2.0, Vec3(turn.x, turn.y, turn.z)),
            rate.ve,
            rate.vn,
        )
        assert method.error_model is not None
        return jnp.stack(method.error_model.start(method.init(params.method, nav), change))

    return jnp.stack([column(place) for place in range(len(begins))], axis=1)


def _numbers(begins: InitialErrors, params: RunParams) -> tuple[Scalar, ...]:
    """The five numbers of a start: those drawn, or else those of the run."""
    own, others = (*begins.phi, *begins[1:]), (*params.phi, params.ve, params.vn)
    return tuple(b if a is None else jnp.asarray(a) for a, b in zip(own, others, strict=True))


def _of_limit(static: Static, environment: Environment, params: RunParams, site: Site) -> Array:
    """(6,) of one run."""
    assert environment.drawn is not None and environment.motion is not None
    errors, motion = environment.drawn.errors, environment.motion
    assert errors is not None

    def limit(biases: Array) -> Scalar:
        own = errors._replace(gyro_bias=biases[:3], accel_bias=biases[3:])
        biases_n = mean_biases(own, motion)
        return simulate.limit(static, environment.pass_records, params, site, biases_n).phi.z

    return jax.jacfwd(limit)(jnp.concatenate([errors.gyro_bias, errors.accel_bias]))


def starts_beyond(drawn: DrawnNormally, draws: Draw) -> Array:
    """(5, draws) what draws begin with beyond the means."""
    means = (*drawn.begins.phi, *drawn.begins[1:])
    own = (*draws.begins.phi, *draws.begins[1:])
    pairs = zip(own, means, strict=True)
    none = jnp.zeros(draws.draw_id.size)
    return jnp.stack([none if a is None or b is None else a - b for a, b in pairs])


def limit_by_states(found: Sensitivity, drawn: DrawnNormally, states: int) -> Array | None:
    """(lanes, states) of the bias floor by the processes' states, drawn biases last; or None."""
    if found.limit is None:
        return None
    gyro, accel = found.limit[:, :3], found.limit[:, 3:]
    pairs = ((gyro, drawn.gyro_bias_sigma), (accel, drawn.accel_bias_sigma))
    by_bias = [by * sigma[None] for by, sigma in pairs if sigma is not None]
    others = states - 3 * len(by_bias)
    return jnp.concatenate([jnp.zeros((len(found.limit), others)), *by_bias], axis=1)

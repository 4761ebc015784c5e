"""Derivatives by drawn initial errors and biases, as parts of the linear error.

A start that deviates from the mean is an error d before the first sample. A bias is a constant
error of every increment, and it moves the bias floor that a heading is judged from.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.engine.environment import Draw, InitialErrors, NormalDistributions, RunParams
from sinsjax.engine.run import TileRuns, end_of_run, initial_solution, with_initial_errors
from sinsjax.maths import rotations
from sinsjax.maths.algebra import scale
from sinsjax.methods.base import Method, Site, StartChange
from sinsjax.methods.floors import mean_biases
from sinsjax.types import Array, Scalar, Vec3


class Sensitivity(NamedTuple):
    """Derivatives of the runs of a tile at the means of the drawn numbers.

    Attributes:
        start: (lanes, n, 5) of d before the first sample by the initial errors, see
            `NormalDistributions.initial_sigma`.
        floor: (lanes, 6) of the bias floor of phi_u by the biases of gyros and accelerometers in b,
            rad/(rad/s) and rad/(m/s^2); None if no bias is drawn.
    """

    start: Array
    floor: Array | None


def derive_sensitivity(
    runs: TileRuns, params: RunParams, drawn: NormalDistributions | None
) -> Sensitivity | None:
    """Return the derivatives if numbers are drawn, else None.

    Args:
        runs: of the tile.
        params: of the runs without initial errors of a draw, leaves (lanes, ...).
        drawn: distributions of the drawn numbers.
    """
    if drawn is None:
        return None
    by_start = partial(_derive_by_start, runs.method, drawn)
    start = jax.vmap(by_start, in_axes=(0, runs.site_axis))(params, runs.site)
    if drawn.errors is None:
        return Sensitivity(start, None)
    by_biases = partial(_derive_floor_by_biases, runs, drawn)
    return Sensitivity(start, jax.vmap(by_biases, in_axes=(0, runs.site_axis))(params, runs.site))


def _derive_by_start(
    method: Method, drawn: NormalDistributions, params: RunParams, site: Site
) -> Array:
    """Return the derivative of d by the initial errors of one run, (n, 5)."""
    numbers = _initial_numbers(drawn.initial, params)

    def navigation(numbers: tuple[Scalar, ...]) -> Any:
        initial = InitialErrors(numbers[:3], *numbers[3:])
        start = with_initial_errors(params, initial, None)
        q = rotations.misalign(start.phi, start.q)
        return initial_solution(site, q, start.ve, start.vn)

    def column(place: int) -> Array:
        unit = tuple(jnp.full_like(a, float(i == place)) for i, a in enumerate(numbers))
        nav, rate = jax.jvp(navigation, (numbers,), (unit,))
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

    return jnp.stack([column(place) for place in range(len(numbers))], axis=1)


def _initial_numbers(initial: InitialErrors, params: RunParams) -> tuple[Scalar, ...]:
    """Return the five numbers of a start: those drawn, or else those of the run."""
    drawn, given = (*initial.phi, *initial[1:]), (*params.phi, params.ve, params.vn)
    return tuple(b if a is None else jnp.asarray(a) for a, b in zip(drawn, given, strict=True))


def _derive_floor_by_biases(
    runs: TileRuns, drawn: NormalDistributions, params: RunParams, site: Site
) -> Array:
    """Return the derivative of the bias floor of one run by its biases, (6,)."""
    errors, motion = drawn.errors, runs.environment.sensors.motion
    assert errors is not None and motion is not None
    end = end_of_run(runs.static, runs.environment.pass_records)

    def floor_of(biases: Array) -> Scalar:
        biased = errors._replace(gyro_bias=biases[:3], accel_bias=biases[3:])
        in_n = mean_biases(biased, motion)
        return runs.method.floor(params.method, site.place, in_n, end).phi.z

    return jax.jacfwd(floor_of)(jnp.concatenate([errors.gyro_bias, errors.accel_bias]))


def start_deviations(drawn: NormalDistributions, draws: Draw) -> Array:
    """Return the deviations of the draws' initial errors from their means, (5, draws)."""
    means = (*drawn.initial.phi, *drawn.initial[1:])
    values = (*draws.initial.phi, *draws.initial[1:])
    none = jnp.zeros(draws.draw_id.size)
    return jnp.stack(
        [
            none if value is None or mean is None else value - mean
            for value, mean in zip(values, means, strict=True)
        ]
    )


def floor_by_states(
    derivatives: Sensitivity, drawn: NormalDistributions, states: int
) -> Array | None:
    """Return the derivative of the bias floor by the states of coloured inputs, (lanes, states).

    The drawn biases are the last of these states; None if no bias is drawn.
    """
    if derivatives.floor is None:
        return None
    gyro, accel = derivatives.floor[:, :3], derivatives.floor[:, 3:]
    pairs = ((gyro, drawn.gyro_bias_sigma), (accel, drawn.accel_bias_sigma))
    by_bias = [slope * sigma[None] for slope, sigma in pairs if sigma is not None]
    others = states - 3 * len(by_bias)
    return jnp.concatenate([jnp.zeros((len(derivatives.floor), others)), *by_bias], axis=1)

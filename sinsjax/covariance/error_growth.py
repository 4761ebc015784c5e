"""The growth of the true error over a record interval, to first order and in closed loop.

Along with the noise-free run of a method, the error d of its corrected solution follows
`base.ErrorStep`: over an interval d <- F d + noise of covariance W. The gains are those of the
filter, the noise is that of the sensors, whatever the filter assumes of it.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.covariance import coloured_noise
from sinsjax.covariance.coloured_noise import ColouredInputs, ProcessGrowth
from sinsjax.maths import rotations
from sinsjax.maths.algebra import (
    Entries,
    Minus,
    Triangle,
    congruence,
    dot,
    times_plus_identity,
    triangle_index,
)
from sinsjax.methods.base import ErrorModel, ErrorStep, Site
from sinsjax.types import Increments, Quat, Sample, Scalar


class IncrementNoise(NamedTuple):
    """Variances of the white noise of a sample's increments about the body's axes.

    Attributes:
        velocity: of x, y, z, or one for all axes, (m/s)^2.
        angle: likewise, rad^2.
    """

    velocity: tuple[Scalar, ...]
    angle: tuple[Scalar, ...]


class ErrorInputs(NamedTuple):
    """Inputs of the error: noise of the sensors and disturbances of the base.

    Attributes:
        noise: white noise of the sensors.
        coloured: errors of the increments that are not white.
    """

    noise: IncrementNoise
    coloured: ColouredInputs = ColouredInputs()

    @property
    def are_white(self) -> bool:
        """Return whether all inputs are white."""
        return self.coloured == ColouredInputs()


class ErrorGrowth(NamedTuple):
    """The growth of the error since the record interval began.

    Attributes:
        columns: columns of F, n of n entries.
        noise: W.
        coloured: growth by each process that is not white.
    """

    columns: tuple[tuple[Scalar, ...], ...]
    noise: Triangle
    coloured: tuple[ProcessGrowth, ...] = ()


def initial_growth(inputs: ErrorInputs, n: int, like: Scalar) -> ErrorGrowth:
    """Return F = I and W = 0 for n states, in numbers like the one given.

    If all inputs are white, F and W are in single precision, since they are most of what a step
    reads and writes: sigma, summed over the records in double precision, is off by 2e-4 of itself
    after ten minutes. Other processes leave small differences of large numbers.
    """
    zero = jnp.zeros_like(like)
    zero = _to_single(zero) if inputs.are_white else zero
    columns = tuple(tuple(zero + float(i == j) for i in range(n)) for j in range(n))
    processes = coloured_noise.present_processes(inputs.coloured)
    by_process = (
        coloured_noise.initial_process_growth(process, n, zero) for process, _ in processes
    )
    return ErrorGrowth(columns, (zero,) * (n * (n + 1) // 2), tuple(by_process))


def advance_growth(
    model: ErrorModel,
    params: Any,
    inputs: ErrorInputs,
    site: Site,
    growth: ErrorGrowth,
    state: Any,
    sample: Sample,
    n: Scalar,
) -> ErrorGrowth:
    """Return the growth after the n-th sample.

    Args:
        model: of the method.
        params: of the method.
        inputs: of the error.
        site: Earth and place.
        growth: before the sample.
        state: of the method before the sample.
        sample: noise-free.
        n: number of the sample.
    """
    step = model.step(params, site, state, sample, n), state.nav.q, inputs.noise
    if inputs.are_white:
        step = _to_single(step)
    return apply_step(growth, *step, inputs.coloured)


def apply_step(
    growth: ErrorGrowth,
    step: ErrorStep,
    q: Quat,
    noise: IncrementNoise,
    coloured: ColouredInputs,
) -> ErrorGrowth:
    """Return the growth one sample later.

    Args:
        growth: so far.
        step: of the sample.
        q: attitude of the navigation solution, body to n.
        noise: white noise of the sample's increments.
        coloured: errors of the increments that are not white.
    """
    n, q = len(growth.columns), step.input_axes(q)
    columns = tuple(times_plus_identity(step.transition, column) for column in growth.columns)
    w = congruence(step.transition, growth.noise, n)
    w = _add_inputs(step.inputs, w, _covariance_in_n(q, noise), n)
    later = []
    processes = coloured_noise.present_processes(coloured)
    for before, (process, where) in zip(growth.coloured, processes, strict=True):
        effect = coloured_noise.unit_effect(step, q, n, *where)
        after, w = coloured_noise.advance_process_growth(before, process, step, effect, w)
        later.append(after)
    columns = tuple(step.apply_gains(column) for column in columns)
    for k, m in zip(step.gains, step.measured, strict=True):
        w = _apply_gain_to_covariance(w, k, m)
    return ErrorGrowth(columns, w, tuple(later))


def propagate_error(
    step: ErrorStep, q: Quat, excess: Increments, d: tuple[Scalar, ...]
) -> tuple[Scalar, ...]:
    """Return the error d one sample later.

    Args:
        step: of the sample.
        q: attitude of the navigation solution, body to n.
        excess: error of the increments in b, rad and m/s.
        d: error before the sample.
    """
    rows = rotations.matrix(step.input_axes(q))
    in_n = [dot(row, excess.dv) for row in rows] + [dot(row, excess.dtheta) for row in rows]
    out = list(times_plus_identity(step.transition, d))
    for (i, axis), by in step.inputs.items():
        entry = in_n[axis]
        out[i] = out[i] - by.of * entry if isinstance(by, Minus) else out[i] + by * entry
    return step.apply_gains(tuple(out))


def _covariance_in_n(q: Quat, noise: IncrementNoise) -> dict[tuple[int, int], Scalar]:
    """Return the non-zero entries (i, j), i <= j, of C diag(variances) C' of both sensors."""
    c, out = rotations.matrix(q), dict[tuple[int, int], Scalar]()
    for first, variances in ((0, noise.velocity), (3, noise.angle)):
        if len(variances) == 1:  # the same for any attitude
            out |= {(first + i, first + i): variances[0] for i in range(3)}
            continue
        for i in range(3):
            for j in range(i, 3):
                terms = (c[i][a] * c[j][a] * variances[a] for a in range(3))
                out[first + i, first + j] = sum(terms)
    return out


def _add_inputs(
    inputs: Entries, w: Triangle, noise: dict[tuple[int, int], Scalar], n: int
) -> Triangle:
    """Return W + G N G' for the entries of G and of N, in n."""
    out, at = list(w), triangle_index(n)
    for (i, a), by_a in inputs.items():
        for (j, b), by_b in inputs.items():
            if i <= j and (min(a, b), max(a, b)) in noise:
                term = noise[min(a, b), max(a, b)]
                out[at[i, j]] = out[at[i, j]] + _to_number(by_a) * _to_number(by_b) * term
    return tuple(out)


def _to_number(entry: Scalar | Minus) -> Scalar:
    return -entry.of if isinstance(entry, Minus) else entry


def _apply_gain_to_covariance(w: Triangle, k: tuple[Scalar, ...], m: int) -> Triangle:
    """Return (I - k h) W (I - k h)' for the gain k of a measurement of state m."""
    n = len(k)
    at = triangle_index(n)
    column = [w[at[i, m]] for i in range(n)]
    left = [c - 0.5 * g * column[m] for c, g in zip(column, k, strict=True)]
    return tuple(
        w[at[i, j]] - (k[i] * left[j] + left[i] * k[j]) for i in range(n) for j in range(i, n)
    )


def _to_single(tree: Any) -> Any:
    return jax.tree.map(lambda a: a if isinstance(a, (int, float)) else a.astype(jnp.float32), tree)

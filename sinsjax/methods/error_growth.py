"""How the true error of a run grows and shrinks over a record interval: linear covariance analysis.

Beside the noise-free run of a method goes the error d of its corrected solution, to first order
and in closed loop (`base.ErrorStep`): over an interval d <- F d + noise of covariance W. The gains
are those the filter has, the noise is that of the sensors, whatever the filter believes of it.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

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
from sinsjax.methods import coloured_growth
from sinsjax.methods.base import ErrorModel, ErrorStep, Feedback, Method, Site, apply_gain
from sinsjax.methods.coloured_growth import Coloured
from sinsjax.types import Increments, Navigation, Quat, Sample, Scalar

WHITE_ALONE = Coloured()
"""Of inputs that are white: no processes."""


class IncrementNoise(NamedTuple):
    """Variances of the noise of a sample's increments, white, about the body's axes.

    Attributes:
        velocity: of x, y, z, or one of all axes, (m/s)^2.
        angle: likewise, rad^2.
    """

    velocity: tuple[Scalar, ...]
    angle: tuple[Scalar, ...]


class ErrorGrowth(NamedTuple):
    """What has become of the error since a record interval began.

    Attributes:
        columns: of F, n of n entries.
        noise: W, upper triangle.
        coloured: by each process that is not white.
    """

    columns: tuple[tuple[Scalar, ...], ...]
    noise: Triangle
    coloured: tuple[coloured_growth.Growth, ...] = ()


class Watched(NamedTuple):
    """A method's state, and how its error has grown.

    Attributes:
        inner: the method's own state.
        growth: since the record interval began.
    """

    inner: Any
    growth: ErrorGrowth

    @property
    def nav(self) -> Navigation:
        """The method's navigation solution."""
        nav: Navigation = self.inner.nav
        return nav


class ErrorParams(NamedTuple):
    """Numbers of a method whose error is watched.

    Attributes:
        inner: the method's own.
        noise: of the sensors, white.
        coloured: errors of the increments that are not, see `coloured_growth.increments`.
    """

    inner: Any
    noise: IncrementNoise
    coloured: Coloured = Coloured()


def no_growth(n: int, zero: Scalar, coloured: Coloured = WHITE_ALONE) -> ErrorGrowth:
    """At the beginning of an interval: F = I and W = 0, for n states."""
    columns = tuple(tuple(zero + float(i == j) for i in range(n)) for j in range(n))
    by_process = (coloured_growth.begin(one, n, zero) for one, _ in coloured_growth.each(coloured))
    return ErrorGrowth(columns, (zero,) * (n * (n + 1) // 2), tuple(by_process))


def advance(
    growth: ErrorGrowth,
    step: ErrorStep,
    q: Quat,
    noise: IncrementNoise,
    coloured: Coloured = WHITE_ALONE,
) -> ErrorGrowth:
    """The growth a sample later.

    Args:
        growth: so far.
        step: of the sample.
        q: attitude of the navigation solution, body to n.
        noise: of the sample's increments, white.
        coloured: errors of the increments that are not.
    """
    n, q = len(growth.columns), step.input_axes(q)
    columns = tuple(times_plus_identity(step.transition, column) for column in growth.columns)
    w = congruence(step.transition, growth.noise, n)
    w = _with_inputs(step.inputs, w, _in_n(q, noise), n)
    later = []
    for own, (process, where) in zip(growth.coloured, coloured_growth.each(coloured), strict=True):
        enters = coloured_growth.entering(step, q, n, *where)
        grown, w = coloured_growth.advance(own, process, step, enters, w)
        later.append(grown)
    for k, m in zip(step.gains, step.measured, strict=True):
        columns = tuple(apply_gain(column, k, m) for column in columns)
        w = _apply_gain(w, k, m)
    return ErrorGrowth(columns, w, tuple(later))


def driven(
    step: ErrorStep, q: Quat, excess: Increments, d: tuple[Scalar, ...]
) -> tuple[Scalar, ...]:
    """The error a sample later.

    Args:
        step: of the sample.
        q: attitude of the navigation solution, body to n.
        excess: error of the increments in b, rad and m/s.
        d: error so far.
    """
    rows = rotations.matrix(step.input_axes(q))
    in_n = [dot(row, excess.dv) for row in rows] + [dot(row, excess.dtheta) for row in rows]
    out = list(times_plus_identity(step.transition, d))
    for (i, axis), by in step.inputs.items():
        entry = in_n[axis]
        out[i] = out[i] - by.of * entry if isinstance(by, Minus) else out[i] + by * entry
    d = tuple(out)
    for k, m in zip(step.gains, step.measured, strict=True):
        d = apply_gain(d, k, m)
    return d


def _in_n(q: Quat, noise: IncrementNoise) -> dict[tuple[int, int], Scalar]:
    """C diag(variances) C' of both sensors, its non-zero entries (i, j) with i <= j."""
    c, out = rotations.matrix(q), dict[tuple[int, int], Scalar]()
    for first, variances in ((0, noise.velocity), (3, noise.angle)):
        if len(variances) == 1:  # the same from any attitude
            out |= {(first + i, first + i): variances[0] for i in range(3)}
            continue
        for i in range(3):
            for j in range(i, 3):
                terms = (c[i][a] * c[j][a] * variances[a] for a in range(3))
                out[first + i, first + j] = sum(terms)
    return out


def _with_inputs(
    inputs: Entries, w: Triangle, noise: dict[tuple[int, int], Scalar], n: int
) -> Triangle:
    """W + G N G' for the entries of G and of N, in n."""
    out, at = list(w), triangle_index(n)
    for (i, a), by_a in inputs.items():
        for (j, b), by_b in inputs.items():
            if i <= j and (min(a, b), max(a, b)) in noise:
                term = noise[min(a, b), max(a, b)]
                out[at[i, j]] = out[at[i, j]] + _number(by_a) * _number(by_b) * term
    return tuple(out)


def _number(entry: Scalar | Minus) -> Scalar:
    return -entry.of if isinstance(entry, Minus) else entry


def _apply_gain(w: Triangle, k: tuple[Scalar, ...], m: int) -> Triangle:
    """(I - k h) W (I - k h)', h the row that measures state m."""
    n = len(k)
    at = triangle_index(n)
    column = [w[at[i, m]] for i in range(n)]
    left = [c - 0.5 * g * column[m] for c, g in zip(column, k, strict=True)]
    return tuple(
        w[at[i, j]] - (k[i] * left[j] + left[i] * k[j]) for i in range(n) for j in range(i, n)
    )


def _single(tree: Any) -> Any:
    """Numbers in single precision: most of what a step reads and writes is F and W.

    S, summed up record by record in double precision, is off by 2e-4 of a sigma after ten minutes.
    """
    return jax.tree.map(lambda a: a if isinstance(a, (int, float)) else a.astype(jnp.float32), tree)


def with_growth(method: Method) -> Method:
    """A method that also tells, at record times, how its error has grown since the last one.

    Its params are `ErrorParams`. `Method.per_record` gives the rows of F, then W, then the rows of
    phi by the states of d, then what `coloured_growth.told` has of each process.

    Where all noise is white, F and W are in single precision from one record to the next. Beside
    other processes they are not: these leave small differences of large numbers.

    Args:
        method: with an `error_step`, read forward once.
    """
    assert method.error_model is not None
    error_step, error_angles, start_error, _ = method.error_model
    feedback, results = method.feedback, method.results
    called = feedback and feedback.called

    def init(params: ErrorParams, nav: Navigation) -> Watched:
        inner = method.init(params.inner, nav)
        zero = jnp.zeros_like(nav.ve)
        zero = _single(zero) if params.coloured == WHITE_ALONE else zero
        return Watched(inner, no_growth(len(error_angles(inner)[0]), zero, params.coloured))

    def step(params: ErrorParams, site: Site, state: Watched, sample: Sample, n: Scalar) -> Watched:
        given = params.inner, site, state.inner, sample, n
        of_sample = error_step(*given), state.nav.q, params.noise
        if params.coloured == WHITE_ALONE:
            of_sample = _single(of_sample)
        growth = advance(state.growth, *of_sample, params.coloured)
        return Watched(method.step(*given), growth)

    def per_record(state: Watched) -> tuple[Watched, tuple[Scalar, ...]]:
        columns, w, coloured = state.growth
        angles = [entry for row in error_angles(state.inner) for entry in row]
        rows = [
            entry.astype(angles[0].dtype) for row in zip(*columns, strict=True) for entry in row
        ]
        told_w = (entry.astype(angles[0].dtype) for entry in w)
        anew = no_growth(len(columns), jnp.zeros_like(w[0]))
        begun = tuple(map(coloured_growth.anew, coloured))
        more = (number for one in coloured for number in coloured_growth.told(one))
        growth = anew._replace(coloured=begun)
        return state._replace(growth=growth), (*rows, *told_w, *angles, *more)

    return Method(
        init=init,
        step=step,
        attitude=lambda state: method.attitude(state.inner),
        covariance=lambda state: method.covariance(state.inner),
        normalise=lambda state: state._replace(inner=method.normalise(state.inner)),
        floor=lambda params, *given: method.floor(params.inner, *given),
        results=results and (lambda site, state: results(site, state.inner)),
        feedback=feedback
        and Feedback(
            lambda params, state, n: state._replace(
                inner=feedback.close(params.inner, state.inner, n)
            ),
            lambda params, state, n: feedback.next_event(params.inner, state.inner, n),
            called and (lambda state, n: called(state.inner, n)),
        ),
        error_model=ErrorModel(
            error_step,
            error_angles,
            lambda state, change: start_error(state.inner, change),
            per_record,
        ),
    )

"""The standard Kalman filter, [P1] eqs (8)-(12), for any number of states.

The state transition is given by its non-zero off-identity entries, by state number; sums over
zeros never enter the program. P is kept as its upper triangle, so it is symmetric by construction.
"""

from collections.abc import Sequence
from typing import NamedTuple

from sinsjax.maths import algebra
from sinsjax.maths.algebra import Entries, Triangle, triangle_index
from sinsjax.types import Scalar


class Belief(NamedTuple):
    """A filter's estimate: the mean of its states, and their covariance P."""

    x: tuple[Scalar, ...]
    p: Triangle


class Innovation(NamedTuple):
    """Measured minus predicted values, and their covariance S = H P H' + R."""

    value: tuple[Scalar, ...]
    variance: Triangle


def initial_belief(variances: Sequence[Scalar]) -> Belief:
    """Return zero means with a diagonal covariance."""
    x, n = tuple(0.0 * v for v in variances), len(variances)
    zero = 0.0 * variances[0]
    return Belief(x, tuple(variances[i] if i == j else zero for i in range(n) for j in range(i, n)))


def propagate(belief: Belief, transition: Entries) -> Belief:
    """Predict over one step without process noise, [P1] eqs (8) and (9), by Phi - I = A dt."""
    p = algebra.congruence(transition, belief.p, len(belief.x))
    return Belief(algebra.times_plus_identity(transition, belief.x), p)


def add_noise(belief: Belief, q: Sequence[Scalar]) -> Belief:
    """Add the process noise of one step, given the diagonal of its covariance."""
    p, at = list(belief.p), triangle_index(len(belief.x))
    for i in range(len(belief.x)):
        p[at[i, i]] = p[at[i, i]] + q[i]
    return Belief(belief.x, tuple(p))


def update(
    belief: Belief, measured: Sequence[int], z: Sequence[Scalar], r: Scalar
) -> tuple[Belief, Innovation]:
    """Update with direct measurements of some states, [P1] eqs (10)-(12); also the innovation.

    The measurement noise is white over the components (R = r I), so the components are taken one
    after the other: the same result as the joint update, without a matrix inverse.

    Args:
        belief: predicted mean and covariance.
        measured: numbers of the measured states (the rows of H).
        z: measured values.
        r: variance of each measurement.
    """
    (x, p), n = belief, len(belief.x)
    at = triangle_index(n)
    pairs = [(i, j) for k, i in enumerate(measured) for j in measured[k:]]
    innovation = Innovation(
        value=tuple(value - x[m] for m, value in zip(measured, z, strict=True)),
        variance=tuple(p[at[i, j]] + r if i == j else p[at[i, j]] for i, j in pairs),
    )
    for m, value in zip(measured, z, strict=True):
        column = [p[at[i, m]] for i in range(n)]
        inverse = 1 / (column[m] + r)
        gain = [c * inverse for c in column]
        p = tuple(p[at[i, j]] - gain[i] * column[j] for i in range(n) for j in range(i, n))
        scaled = (value - x[m]) * inverse
        x = tuple(x[i] + column[i] * scaled for i in range(n))
    return Belief(x, p), innovation


def normalised_innovation_squared(value: Sequence[Scalar], variance: Sequence[Scalar]) -> Scalar:
    """Return r' S^-1 r of an innovation r of two measurements."""
    (e, n), (ee, en, nn) = value, variance
    return (nn * e * e - 2 * en * e * n + ee * n * n) / (ee * nn - en * en)

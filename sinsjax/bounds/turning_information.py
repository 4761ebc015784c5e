"""Information bound of the heading on a base that turns, or whose sensor errors have priors.

On a base at rest the level gyro bias hides in the heading. A turn of the base changes the sign of a
bias in n but not that of the Earth rate, so that the data separate the two. The model is that of
`bounds.information` with constant errors of the sensors in the body frame b: of the gyros, with
biases b_g and a matrix M_g of scale factors and cross-axis errors, and of the accelerometers,

    phi' = phi x w_ie - C (b_g + M_g w + drifts + noise),
    u'   = f x phi + C (b_a + M_a C' f + drifts + noise) + v',       f = (0, 0, g),

with the attitude C = C_b^n and the angular rate w = w_ib^b of the true motion, and the velocity v
of a surging base. The computed velocity u is known, so the Coriolis terms are known too.

The unknowns theta are phi(0), without a prior, and the constant errors, normal with mean zero and
known sigmas. Noise and drifts are Gaussian with known covariance. A Kalman filter that knows theta
= 0 has innovations r with covariance S and, for each of the unknowns, a response of these
innovations: its column of d. The information on theta is

    J = diag(0, 1/sigma^2) + sum over the steps of r_d' S^-1 r_d.

The misalignment at the time t of interest is phi(t) = R theta + e, where R is the response of what
the filter leaves unexplained and e has the covariance P of the filter, so

    sigma^2(t) = P_UU + R_U J^-1 R_U'.

This is the Cramer-Rao bound of unbiased estimators of the heading at t, biases and all (with priors
on the constant errors the van Trees bound, which a linear estimator attains). Unlike the bound of
`bounds.information` it is measured from the true heading and not from a bias floor, and it is
that of the body at the end of the data and not at their beginning.

The steps are longer than a sample of the sensors. Over a step the integrals of C, C w and C' f are
those of the motion, so turns of many degrees per step are right; Earth rate is integrated to second
order; the noise of the gyros adds to u within the step.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from sinsjax.bounds.coloured_noise import IN_N, VELOCITY
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.processes import Process

AttitudeAndRate: TypeAlias = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function of times (n,), s, that returns C_b^n (n, 3, 3) and w_ib in b (n, 3), rad/s."""

IncrementErrors: TypeAlias = Sequence[tuple[Process, tuple[int, str]]]
"""Processes that are errors of the increments over a step, see `coloured_noise`."""

LONGEST_STEP_S = 0.5
"""Shorter steps lower a bound by 0.02 % at most, and by 0.3 % at 60 deg/s if the cross-axis errors
decide."""

MOTION_NODES = 8
"""Points per step at which the motion is read, by the midpoint rule."""

_CHUNK = 500  # steps whose matrices are in memory
_LEVEL, _PHI, _PHI_U = slice(0, 2), slice(2, 5), 4


class WhiteNoise(NamedTuple):
    """White noise of the sensors.

    Attributes:
        gyro: (3,) density of each axis, rad/sqrt(s).
        accel: (3,) density of each axis, m/s^1.5.
    """

    gyro: np.ndarray
    accel: np.ndarray


class ConstantErrors(NamedTuple):
    """Standard deviations of the sensors' constant errors; zero for a known error.

    Attributes:
        gyro_bias: (3,) rad/s.
        accel_bias: (3,) m/s^2.
        gyro_matrix: (3, 3) scale factor errors on the diagonal, axis misalignments (rad) off it.
        accel_matrix: (3, 3) likewise.
    """

    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    gyro_matrix: np.ndarray
    accel_matrix: np.ndarray

    @property
    def sigmas(self) -> np.ndarray:
        """All of them, (24,), row by row."""
        return np.concatenate([np.ravel(part) for part in self])


@dataclass(frozen=True)
class HeadingProblem:
    """A base and its sensors, whose heading is bounded.

    Attributes:
        motion: true attitude and rate of the base.
        place: Earth rates and gravity; not a pole.
        dt: sample time, s. Steps are of whole samples and have one length.
        noise: white noise of the sensors; that of the accelerometers not zero.
        constant: sigmas of the constant errors.
        increment_errors: function of a step, s, that returns drifts, surge and vibration.
        longest_step_s: longest step, s, unless a sample is longer.
        nodes: points per step at which the motion is read.
    """

    motion: AttitudeAndRate
    place: Place
    dt: float
    noise: WhiteNoise
    constant: ConstantErrors
    increment_errors: Callable[[float], IncrementErrors] = lambda step: ()
    longest_step_s: float = LONGEST_STEP_S
    nodes: int = MOTION_NODES

    def count_noise_sources(self) -> int:
        """Return the number of white noises, drifts and motions."""
        return 2 + len(self.increment_errors(self.dt))


def turning_heading_bound(times_s: Sequence[float], problem: HeadingProblem) -> np.ndarray:
    """Return the least 1 sigma of phi_u at the end of the data of any unbiased estimator, rad.

    Args:
        times_s: lengths of the data, s, ascending, of whole samples.
        problem: base and sensors.

    Returns:
        (times,); infinite while the heading is not observable.
    """
    one = np.ones((1, problem.count_noise_sources()))
    return np.sqrt(_heading_variances(times_s, problem, one)[0][:, 0])


def heading_budget(times_s: Sequence[float], problem: HeadingProblem) -> np.ndarray:
    """Return what each source of errors adds to the variance of the bound.

    The estimator of least variance is linear in the data and best for the sum of all sources, so
    to first order a change of one source changes that sum as if the estimator stayed as it is: the
    share of a source is the derivative of the variance by the logarithm of its own variance.
    The shares add up to the variance.

    Args:
        times_s: see `turning_heading_bound`; the heading is observable at all of them.
        problem: base and sensors.

    Returns:
        (times, sources), rad^2: white noise of gyros and accelerometers, `increment_errors` in
        their order, then bias of the gyros, bias of the accelerometers, scale factors and
        cross-axis errors of the gyros, and those of the accelerometers.
    """
    count, small = problem.count_noise_sources(), 1e-3
    scales = np.concatenate([np.ones((1, count)), 1 + small * np.eye(count)])
    variance, priors = _heading_variances(times_s, problem, scales)
    noise = (variance[:, 1:] - variance[:, :1]) / small
    constant = np.zeros((len(priors), 24))
    constant[:, problem.constant.sigmas > 0] = priors
    matrices = constant[:, 6:].reshape(-1, 2, 3, 3)
    scale = np.trace(matrices, axis1=2, axis2=3)
    cross = matrices.sum(axis=(2, 3)) - scale
    biases = constant[:, :6].reshape(-1, 2, 3).sum(axis=2)
    parts = np.concatenate([noise, biases, np.stack([scale, cross], 2).reshape(-1, 4)], axis=1)
    return parts * (variance[:, 0] / parts.sum(axis=1))[:, None]


def _heading_variances(
    times_s: Sequence[float], problem: HeadingProblem, scales: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the variance of phi_u with noise of other strengths, rad^2.

    Args:
        times_s: lengths of the data, s.
        problem: base and sensors.
        scales: (cases, noise sources) factors on the variance of each source.

    Returns:
        The variances (times, cases), and what the unknown constant errors add to those of the first
        case (times, unknown).
    """
    dt = problem.dt
    samples = [round(time / dt) for time in times_s]
    per_step = _samples_per_step(math.gcd(*samples), problem.longest_step_s / dt)
    step, present = per_step * dt, problem.increment_errors(per_step * dt)
    sigmas = problem.constant.sigmas
    unknown = sigmas > 0
    prior = np.diag(np.concatenate([np.zeros(3), 1 / np.square(sigmas[unknown])]))
    information = np.broadcast_to(prior, (len(scales), *prior.shape))
    p = np.einsum("bs,sij->bij", scales, _initial_covariances(present))
    response = np.zeros((len(scales), p.shape[-1], len(prior)))
    response[:, :3, :3] = np.eye(3)
    steps = _iter_steps(samples[-1] // per_step, step, problem, present, scales, unknown)
    done, variances, priors = 0, [], []
    for count in samples:
        rows = [np.zeros((len(scales), 0, len(prior)))]
        for f, g, noise in itertools.islice(steps, count // per_step - done):
            p = f @ p @ f.T + noise
            response = f @ response
            response[:, :5, 3:] += g
            root = _inverse_root(p[:, _LEVEL, _LEVEL])
            gain = p[:, 2:, _LEVEL] @ root.transpose(0, 2, 1)
            rows.append(root @ response[:, _LEVEL])
            response = response[:, 2:] - gain @ rows[-1]
            p = p[:, 2:, 2:] - gain @ gain.transpose(0, 2, 1)
        whitened = np.concatenate(rows, axis=1)
        information = information + whitened.transpose(0, 2, 1) @ whitened
        done = count // per_step
        cases = [_heading_variance(*case) for case in zip(p, response, information, strict=True)]
        variances.append([variance for variance, _ in cases])
        priors.append(np.square(cases[0][1][3:] / sigmas[unknown]))
    return np.array(variances), np.array(priors)


def _inverse_root(s: np.ndarray) -> np.ndarray:
    """Return the inverses of the Cholesky factors of matrices (cases, 2, 2).

    LAPACK spends longer on its checks of each call than on matrices of this size.
    """
    first = np.sqrt(s[:, 0, 0])
    below = s[:, 1, 0] / first
    second = np.sqrt(s[:, 1, 1] - below * below)
    out = np.zeros_like(s)
    out[:, 0, 0], out[:, 1, 0], out[:, 1, 1] = 1 / first, -below / (first * second), 1 / second
    return out


def _samples_per_step(samples: int, longest: float) -> int:
    """Return the largest divisor of a number of samples that is not above ``longest``, or 1."""
    most = max(1, int(longest * (1 + 1e-9)))
    return next(count for count in range(min(most, samples), 0, -1) if samples % count == 0)


def _initial_covariances(present: IncrementErrors) -> np.ndarray:
    """Return the covariance that each noise source gives phi and the processes, given phi."""
    out, at = [], 3
    size = 3 + sum(3 * len(process.drive) for process, _ in present)
    for process, _ in present:
        root = np.zeros((size, size))
        states = slice(at, at + 3 * len(process.drive))
        root[states, states] = np.kron(np.eye(3), process.begin)
        out.append(root @ root.T)
        at = states.stop
    return np.stack([np.zeros((size, size))] * 2 + out)


def _iter_steps(
    count: int,
    step: float,
    problem: HeadingProblem,
    present: IncrementErrors,
    scales: np.ndarray,
    unknown: np.ndarray,
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield F, G of unknown errors and, per case, the covariance of the noise of each step."""
    for first in range(0, count, _CHUNK):
        number = min(_CHUNK, count - first)
        f, g, by_source = _integrate_steps(problem, first * step, step, number, present)
        noise = np.tensordot(by_source, scales, (1, 1)).transpose(0, 3, 1, 2)
        yield from zip(f, g[:, :, unknown], noise, strict=True)


class Steps(NamedTuple):
    """x <- F x + G c + noise over steps, for u, phi and the states of the processes.

    Attributes:
        transition: (steps, n, n - 2) F, without the columns of u, which is known.
        constant: (steps, 5, 24) G of the constant errors, as `ConstantErrors` lists them.
        noise: (steps, sources, n, n) covariance of the noise of each source.
    """

    transition: np.ndarray
    constant: np.ndarray
    noise: np.ndarray


def _heading_variance(
    p: np.ndarray, response: np.ndarray, information: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return the variance of phi_u at the present, and J^-1 R_U'; infinite if unobservable."""
    unobservable = np.inf, np.full(len(information), np.inf)
    scale = np.sqrt(np.diag(information))
    if not scale.all():
        return unobservable
    # Scaled, since tilts are known a thousand times better than the heading.
    try:
        root = np.linalg.cholesky(information / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        return unobservable
    part = np.linalg.solve(root, response[_PHI_U - 2] / scale)
    weights = np.linalg.solve(root.T, part) / scale
    return float(p[_PHI_U - 2, _PHI_U - 2] + part @ part), weights


def _integrate_steps(
    problem: HeadingProblem, begin: float, step: float, count: int, present: IncrementErrors
) -> Steps:
    """Return the steps from a time on."""
    nodes, place = problem.nodes, problem.place
    into = (np.arange(nodes) + 0.5) / nodes * step
    times = begin + step * np.arange(count)[:, None] + into
    c, w = problem.motion(times.ravel())
    c, w = c.reshape(count, nodes, 3, 3), w.reshape(count, nodes, 3)
    weights = np.full(nodes, step / nodes)
    left = weights * (step - into)  # an error of the rate tilts the platform for what is left
    lean = place.gravity * np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])  # u' of phi
    integral, double = (np.einsum("m,kmij->kij", by, c) for by in (weights, left))

    constant = np.zeros((count, 5, 24))
    constant[:, _LEVEL, 0:3], constant[:, _PHI, 0:3] = -lean @ double, -integral
    constant[:, _LEVEL, 3:6] = integral[:, :2]
    for by, rows, effect in ((left, _LEVEL, -lean), (weights, _PHI, -np.eye(3))):
        matrix = np.einsum("m,kmai,kmj->kaij", by, c, w).reshape(count, 3, 9)
        constant[:, rows, 6:15] = effect @ matrix
    force = place.gravity * c[:, :, 2]
    matrix = np.einsum("m,kmai,kmj->kaij", weights, c[:, :, :2], force)
    constant[:, _LEVEL, 15:24] = matrix.reshape(count, 2, 9)

    n = 5 + sum(3 * len(process.drive) for process, _ in present)
    transition = np.zeros((count, n, n - 2))
    covariance = np.zeros((count, 2 + len(present), n, n))
    wn, wu = place.rate_n, place.rate_u
    turn = np.array([[0.0, wu, -wn], [-wu, 0.0, 0.0], [wn, 0.0, 0.0]])
    transition[:, _PHI, 0:3] = np.eye(3) + turn * step + turn @ turn * step**2 / 2
    transition[:, _LEVEL, 0:3] = lean @ (np.eye(3) * step + turn * step**2 / 2)
    gyro, accel = (c * np.square(density) @ np.swapaxes(c, -1, -2) for density in problem.noise)
    moments = [np.einsum("m,kmij->kij", weights * (step - into) ** k, gyro) for k in range(3)]
    covariance[:, 0, _PHI, _PHI] = moments[0]
    covariance[:, 0, _LEVEL, _PHI] = lean @ moments[1]
    covariance[:, 0, _PHI, _LEVEL] = np.swapaxes(lean @ moments[1], -1, -2)
    covariance[:, 0, _LEVEL, _LEVEL] = lean @ moments[2] @ lean.T
    covariance[:, 1, _LEVEL, _LEVEL] = np.einsum("m,kmij->kij", weights, accel[:, :, :2, :2])
    at = 5
    for source, (process, (first, axes)) in enumerate(present, start=2):
        effect = np.zeros((count, 5, 3))
        if first == VELOCITY:
            effect[:, _LEVEL] = np.eye(3)[:2] if axes == IN_N else integral[:, :2] / step
        else:
            effect[:] = constant[:, :, 0:3] / step
        effect = effect * process.scale
        states = slice(at, at + 3 * len(process.drive))
        transition[:, :5, at - 2 : states.stop - 2] = np.kron(effect, process.output)
        transition[:, states, at - 2 : states.stop - 2] = np.kron(np.eye(3), process.transition)
        driven = np.zeros((count, n, 3))
        driven[:, :5] = effect * process.direct
        driven[:, states] = np.kron(np.eye(3), process.drive[:, None])
        covariance[:, source] = driven @ np.swapaxes(driven, -1, -2)
        at = states.stop
    return Steps(transition, constant, covariance)

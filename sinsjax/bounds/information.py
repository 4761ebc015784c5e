"""The least heading error that the data allow any method: an information bound.

On a base at rest, a heading error phi_U tilts a free platform at the constant rate
-omega_N phi_U - eps_E, and the north specific force is g phi_E + nabla_N + noise. So the heading,
from its floor -eps_E/omega_N, is the slope of a ramp in the force with unknown offset and start.

White noise has a closed form, sqrt(12 q_a/(g^2 T^3) + q_g/T)/omega_N. Accelerometers with density
q_a leave the slope of the tilt the variance of a straight line's, 12 q_a/(g^2 T^3). Gyros with
density q_g turn the ramp into a random walk with a drift, whose variance is q_g/T. The least
variance of an unbiased linear estimator is superadditive in the noise covariance, since
min w'(A + B)w >= min w'A w + min w'B w over all weights w. The sum is therefore a bound, and close
if one of the two noises dominates. Repeated passes add nothing.

A turn of the base changes the sign of a bias in n but not that of the Earth rate, so that the data
separate the two. The sensors have constant errors in the body frame b, biases b_g and b_a and
matrices M_g and M_a of scale factors and cross-axis errors. The heading of a base that does not
travel shows only in its level computed velocity u, the integral of the specific force that the
gyros transform to n. To first order in the misalignment phi,

    phi' = phi x w_ie - C (b_g + M_g w + drifts + noise),
    u'   = f x phi + C (b_a + M_a C' f + drifts + noise) + v',       f = (0, 0, g), u(0) = 0,

with the attitude C = C_b^n and the angular rate w = w_ib^b of the true motion, and the velocity v
of a surging base: a process x' = A x + b w whose changes all enter u. Linear vibration and drifts
of the sensors enter likewise, and so does C (w_nb x l) of a lever arm l, a constant error in b.
Angular vibration is left out: the gyros measure it, and what it adds to the velocity at the end of
a lever arm averages out. The computed velocity u is known, and with it the Coriolis terms.

The unknowns theta are phi(0), without a prior, and the constant errors, normal with mean zero and
known sigmas. So u is d theta + e with known rows d and a Gaussian e of known covariance C_e, and no
unbiased estimator has a smaller covariance than (d' C_e^-1 d)^-1 (Gauss and Markov; Cramer and
Rao). C_e would be a full matrix of the samples. A Kalman filter that knows theta = 0 whitens e
instead: its innovations r have known covariances S, and C_e^-1 = L' S^-1 L with the filter itself
as L. It whitens the columns of d as it does u, and the information on theta is

    J = diag(0, 1/sigma^2) + sum over the steps of r_d' S^-1 r_d,

with r_d the innovations of the filter that is given d. The misalignment at the time t of interest
is phi(t) = R theta + e_t, where R is the response of what the filter leaves unexplained and e_t has
the covariance P of the filter, so

    sigma^2(t) = P_UU + R_U J^-1 R_U'.

This is the Cramer-Rao bound of unbiased estimators of the heading at t, biases and all (with priors
on the constant errors the van Trees bound, which a linear estimator attains). It is measured from
the true heading, and is that of the body at the end of the data.

The steps are longer than a sample of the sensors. Over a step the integrals of C, C w and C' f are
those of the motion, so turns of many degrees per step are right; Earth rate is integrated to second
order; the noise of the gyros adds to u within the step.

A base at rest whose sensors have fixed errors is a case of it (`HeadingProblem.still`): its
constant errors leave a floor, see `methods.floors`, from which the bound is measured, and it is
that of the heading at the beginning of the data, R_U = (0, 0, 1) and P_UU = 0. There the steps are
the samples of the methods' own models, of first order. A swing about a constant attitude is known
from the gyros, and rotates the biases by too little to matter, nor does a lever arm from its
centre.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np

from sinsjax.errors import InputError
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.processes import Process
from sinsjax.strapdown.sensors import SensorErrors

GYRO, ACCEL = 0, 1

NOISE_SOURCES = ("gyro_noise", "accel_noise")
"""Sources of white noise."""

LONGEST_STEP_S = 0.5
"""Shorter steps lower a bound by 0.02 % at most, and by 0.3 % at 60 deg/s if the cross-axis errors
decide."""

MOTION_NODES = 8
"""Points per step at which the motion is read, by the midpoint rule."""

_CHUNK = 500  # steps whose matrices are in memory
LEVEL, PHI = slice(0, 2), slice(2, 5)
HEADING = 2  # among phi, and among theta
_IN_N = np.diag([1.0, 1.0, 0.0, 0.0, 0.0])[:, :3]  # effect of a velocity along n on u and phi


class IncrementError(NamedTuple):
    """A coloured error of the increments of a step: a drift, a surging base, vibration.

    Attributes:
        process: x' = A x + b w, y = c x + d w, whose y is the error on three axes, rad or m/s.
        sensor: `GYRO` or `ACCEL`.
        in_n: whether the axes are those of n and not those of b.
        rounded: whether y is the change of x, an angle or velocity that rounding leaves in b.
    """

    process: Process
    sensor: int
    in_n: bool = False
    rounded: bool = False


IncrementErrors: TypeAlias = Mapping[str, IncrementError]
"""By name of the source."""

_COLOURED: dict[str, tuple[int, bool] | None] = {
    "surge": (ACCEL, True),
    "gyro_instability": (GYRO, False),
    "accel_instability": (ACCEL, False),
    "gyro_walk": (GYRO, False),
    "accel_walk": (ACCEL, False),
    "shaking": (ACCEL, False),
    "rocking": None,  # the gyros measure it
}
"""Sensor that has each disturbance as an error, and whether it has it in n; the others are in b."""

_KNOWN_ERRORS = {
    *("gyro_bias", "accel_bias", "gyro_matrix", "accel_matrix"),
    *("gyro_noise", "accel_noise", "gyro_quantum", "accel_quantum"),
}
"""Fields of `SensorErrors` that the bound takes into account."""

_VELOCITIES = ("surge", "shaking")
"""Processes whose changes are part of an increment; the others are rates."""


class BaseMotion(NamedTuple):
    """Motion of the base at some times.

    Attributes:
        attitude: (n, 3, 3) C_b^n.
        rate: (n, 3) w_ib in b, rad/s.
    """

    attitude: np.ndarray
    rate: np.ndarray


@dataclass(frozen=True)
class HeadingProblem:
    """A base and its sensors, whose heading is bounded.

    Attributes:
        motion: true motion of the base, a function of times (n,), s.
        place: Earth rates and gravity; not a pole.
        dt: sample time, s. Steps are of whole samples and have one length.
        errors: standard deviations of the sensors' errors: white noise of a sample's increments,
            not zero for the accelerometers, and constant errors, zero for a known one. Quanta are
            not read, see `increment_errors`.
        increment_errors: function of a step, s, that returns drifts, surge and vibration.
        still: whether the base is at rest, without constant errors, and its bound measured from its
            floor. Each sample is a step then.
        longest_step_s: longest step, s, unless a sample is longer.
        nodes: points per step at which the motion is read.
        lever_arms: (arms, 3) from the centre of the motion to the sensors, in b, m, each times an
            unknown number of variance 1; times i, its velocity is turned a quarter to the left.
    """

    motion: Callable[[np.ndarray], BaseMotion]
    place: Place
    dt: float
    errors: SensorErrors
    increment_errors: Callable[[float], IncrementErrors] = lambda step: {}
    still: bool = False
    longest_step_s: float = LONGEST_STEP_S
    nodes: int = MOTION_NODES
    lever_arms: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        """Refuse an error of the sensors that would be left out."""
        for name, sigma in self.errors._asdict().items():
            if name not in _KNOWN_ERRORS and sigma is not None and np.any(sigma):
                text = f"the information bound does not know {name} (leave its keys out)"
                raise InputError(f"[sensors]: {text}")

    @property
    def constant_sigmas(self) -> np.ndarray:
        """Standard deviations of the constant errors, (24 + arms,), matrices row by row."""
        errors = self.errors
        constant = errors.gyro_bias, errors.accel_bias, errors.gyro_matrix, errors.accel_matrix
        arms = np.ones(len(self.lever_arms))
        return np.concatenate([np.ravel(part) for part in (*constant, arms)])


def coloured_errors(disturbances: Disturbances, step: float) -> dict[str, IncrementError]:
    """Return the errors of the increments that the random processes of base and sensors make.

    Args:
        disturbances: processes from step to step, none of them drawn.
        step: s.
    """
    errors = {}
    for name, process in disturbances._asdict().items():
        if process is None or (entry := _COLOURED[name]) is None:
            continue
        sensor, in_n = entry
        if name in _VELOCITIES:
            a, c = jnp.asarray(process.transition), jnp.asarray(process.output)
            process = process._replace(output=c @ (a - jnp.eye(len(c))), direct=c @ process.drive)
        else:
            process = process._replace(scale=process.scale * step)
        errors[name] = IncrementError(process, sensor, in_n)
    return errors


def parked(attitude: np.ndarray, place: Place, times_s: np.ndarray) -> BaseMotion:
    """Return the motion of a base at rest with an attitude C_b^n (3, 3)."""
    rate = np.array([0.0, place.rate_n, place.rate_u]) @ attitude
    count = len(times_s)
    return BaseMotion(np.broadcast_to(attitude, (count, 3, 3)), np.broadcast_to(rate, (count, 3)))


def heading_bound(times_s: Sequence[float], problem: HeadingProblem) -> np.ndarray:
    """Return the least 1 sigma of phi_u of any unbiased estimator, rad.

    Args:
        times_s: lengths of the data, s, ascending, of whole samples.
        problem: base and sensors.

    Returns:
        (times,); infinite while the heading is not observable.
    """
    grid = StepGrid.of_times(times_s, problem)
    processes = stack_processes(tuple(problem.increment_errors(grid.step).values()))
    sigmas = problem.constant_sigmas
    unknown = sigmas > 0
    information = np.diag(np.concatenate([np.zeros(3), 1 / np.square(sigmas[unknown])]))
    p = np.pad(processes.begin.sum(axis=0), ((3, 0), (3, 0)))
    response = np.eye(len(p), len(information))
    response[3:] = 0.0
    steps, done, variances = iter_steps(grid, problem, processes), 0, []
    for end in grid.ends:
        rows = [np.zeros((0, len(information)))]
        for one in itertools.islice(steps, end - done):
            p = one.transition @ p @ one.transition.T + one.noise()
            response = one.transition @ response
            response[:5, 3:] += one.constant[:, unknown]
            root = inverse_root(p[LEVEL, LEVEL])
            gain = p[2:, LEVEL] @ root.T
            rows.append(root @ response[LEVEL])
            response = response[2:] - gain @ rows[-1]
            p = p[2:, 2:] - gain @ gain.T
        whitened = np.concatenate(rows)
        information = information + whitened.T @ whitened
        done = end
        if problem.still:
            variances.append(_variance_of_sum(np.eye(len(information))[HEADING], information))
        else:
            variances.append(p[HEADING, HEADING] + _variance_of_sum(response[HEADING], information))
    return np.sqrt(variances)


def _variance_of_sum(sought: np.ndarray, information: np.ndarray) -> float:
    """Return the variance R J^-1 R' of a sum R theta of the unknowns; infinite if unobservable."""
    scale = np.sqrt(np.diag(information))
    if not scale.all():
        return np.inf
    # Scaled, since tilts are known a thousand times better than the heading.
    try:
        root = np.linalg.cholesky(information / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        return np.inf
    part = np.linalg.solve(root, sought / scale)
    return float(part @ part)


def inverse_root(s: np.ndarray) -> np.ndarray:
    """Return the inverse of the Cholesky factor of a matrix (2, 2).

    LAPACK spends longer on its checks of each call than on matrices of this size.
    """
    first = math.sqrt(s[0, 0])
    below = s[1, 0] / first
    second = math.sqrt(s[1, 1] - below * below)
    return np.array([[1 / first, 0.0], [-below / (first * second), 1 / second]])


class StepGrid(NamedTuple):
    """Steps of one length, which some lengths of data are whole numbers of.

    Attributes:
        step: length of a step, s.
        ends: number of steps of each length of data.
    """

    step: float
    ends: list[int]

    @classmethod
    def of_times(cls, times_s: Sequence[float], problem: HeadingProblem) -> "StepGrid":
        """Return the longest steps that the problem allows, of whole samples."""
        samples = [round(time / problem.dt) for time in times_s]
        longest = problem.dt if problem.still else problem.longest_step_s
        shared, most = math.gcd(*samples), max(1, int(longest / problem.dt * (1 + 1e-9)))
        per_step = next(n for n in range(min(most, shared), 0, -1) if shared % n == 0)
        return cls(per_step * problem.dt, [count // per_step for count in samples])


class Processes(NamedTuple):
    """Coloured errors as one system x <- A x + b w, y = c x + d w, whose states are stacked.

    Attributes:
        errors: the sources, d among them.
        transition: (n, n) A.
        output: (sources, 3, n) c.
        drive: (sources, n, 3) b.
        begin: (sources, n, n) covariance of x before the first step.
        owner: (n,) number of the source whose state each is.
    """

    errors: Sequence[IncrementError]
    transition: np.ndarray
    output: np.ndarray
    drive: np.ndarray
    begin: np.ndarray
    owner: np.ndarray


def stack_processes(errors: Sequence[IncrementError]) -> Processes:
    """Return the processes of three axes each, one after the other."""
    count, n = len(errors), sum(3 * len(error.process.drive) for error in errors)
    out = Processes(
        errors,
        transition=np.zeros((n, n)),
        output=np.zeros((count, 3, n)),
        drive=np.zeros((count, n, 3)),
        begin=np.zeros((count, n, n)),
        owner=np.zeros(n, int),
    )
    axes, at = np.eye(3), 0
    for source, (process, *_) in enumerate(errors):
        own = slice(at, at + 3 * len(process.drive))
        out.transition[own, own] = np.kron(axes, process.transition)
        out.output[source, :, own] = np.kron(axes, process.output)
        out.drive[source, own] = np.kron(axes, process.drive[:, None])
        begin = np.kron(axes, process.begin)
        out.begin[source, own, own] = begin @ begin.T
        out.owner[own] = source
        at = own.stop
    return out


class Steps(NamedTuple):
    """x <- F x + G c + noise over steps, for u, phi and the states of the processes.

    Attributes:
        transition: (steps, n, n - 2) F, without the columns of u, which is known.
        constant: (steps, 5, 24 + arms) G of `HeadingProblem.constant_sigmas`.
        white: (steps, sources, 5, 5) covariance of the noise of each of `NOISE_SOURCES`.
        driven: (steps, n, sources, 3) factors of the noise of each process.
    """

    transition: np.ndarray
    constant: np.ndarray
    white: np.ndarray
    driven: np.ndarray

    def noise(self, sources: Any = slice(None)) -> np.ndarray:
        """Return the covariance (n, n) of a step's white noise and of some processes'."""
        driven = self.driven[:, sources].reshape(len(self.driven), -1)
        covariance: np.ndarray = driven @ driven.T
        covariance[:5, :5] += self.white.sum(axis=0)
        return covariance


def iter_steps(grid: StepGrid, problem: HeadingProblem, processes: Processes) -> Iterator[Steps]:
    """Yield each step up to the last end: its transition, effect of constant errors and noise."""
    count = grid.ends[-1]
    for first in range(0, count, _CHUNK):
        numbers = np.arange(first, min(first + _CHUNK, count))
        steps = _discretise_steps(problem, numbers, grid.step, processes)
        yield from map(Steps, *steps)


def _discretise_steps(
    problem: HeadingProblem, numbers: np.ndarray, step: float, processes: Processes
) -> Steps:
    """Return the steps with some numbers."""
    place, count, nodes = problem.place, len(numbers), 1 if problem.still else problem.nodes
    into = (np.arange(nodes) + 0.5) / nodes * step
    c, w = problem.motion((numbers[:, None] * step + into).ravel())
    c, w = c.reshape(count, nodes, 3, 3), w.reshape(count, nodes, 3)
    f = place.gravity * c[:, :, 2]
    # An error of the rate tilts the platform for what is left of the step.
    left, half = (0 * into, 0.0) if problem.still else (step - into, step**2 / 2)
    lean = place.gravity * np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])  # u' of phi
    wn, wu = place.rate_n, place.rate_u
    turn = np.array([[0.0, wu, -wn], [-wu, 0.0, 0.0], [wn, 0.0, 0.0]])  # phi' of phi

    def integrate(x: np.ndarray, power: int = 0) -> np.ndarray:
        weights = step / nodes * left**power
        return np.einsum("m,kmij->kij", weights, x)

    def effect(sensor: int, error: np.ndarray) -> np.ndarray:
        """Return what errors along n (count, nodes, 3, errors) do to u and phi."""
        out = np.zeros((count, 5, error.shape[-1]))
        if sensor == GYRO:
            out[:, LEVEL], out[:, PHI] = -lean @ integrate(error, 1), -integrate(error)
        else:
            out[:, LEVEL] = integrate(error[:, :, :2])
        return out

    c_w, c_f = (np.einsum("kmai,kmj->kmaij", c, x).reshape(*c.shape[:3], 9) for x in (w, f))
    parts = [effect(GYRO, c), effect(ACCEL, c), effect(GYRO, c_w), effect(ACCEL, c_f)]
    if len(problem.lever_arms):
        parts.append(_swing_lever_arms(problem, np.append(numbers, numbers[-1] + 1) * step))
    constant = np.concatenate(parts, axis=2)

    n = 5 + len(processes.transition)
    transition = np.zeros((count, n, n - 2))
    transition[:, LEVEL, 0:3] = lean @ (np.eye(3) * step + turn * half)
    transition[:, PHI, 0:3] = np.eye(3) + turn * step + turn @ turn * half
    transition[:, 5:, 3:] = processes.transition
    white = np.zeros((count, len(NOISE_SOURCES), 5, 5))
    driven = np.zeros((count, n, len(processes.errors), 3))
    errors, root_dt = problem.errors, np.sqrt(problem.dt)
    gyro, accel = (
        c * np.square(np.asarray(sigma) / root_dt) @ np.swapaxes(c, -1, -2)
        for sigma in (errors.gyro_noise, errors.accel_noise)
    )
    across = lean @ integrate(gyro, 1)
    white[:, GYRO, LEVEL, LEVEL] = lean @ integrate(gyro, 2) @ lean.T
    white[:, GYRO, LEVEL, PHI], white[:, GYRO, PHI, LEVEL] = across, across.swapaxes(1, 2)
    white[:, GYRO, PHI, PHI] = integrate(gyro)
    white[:, ACCEL, LEVEL, LEVEL] = integrate(accel[:, :, :2, :2])
    for source, (process, sensor, in_n, rounded) in enumerate(processes.errors):
        driven[:, 5:, source] = processes.drive[source]
        if rounded:  # in a step that turns, only what is left at its ends
            left_over = np.zeros((count + 1, 5, 3))
            ends, _ = problem.motion(np.append(numbers, numbers[-1] + 1) * step)
            rows, sign = (PHI, -1) if sensor == GYRO else (LEVEL, 1)
            left_over[:, rows] = sign * (ends * process.scale)[:, : rows.stop - rows.start]
            driven[:, :5, source] = left_over[1:]
            left_over[:, LEVEL] += step * lean @ left_over[:, PHI]
            transition[:, :5, 3:] -= left_over[:-1] @ processes.drive[source].T
            continue
        of_axes = _IN_N if in_n else constant[:, :, 3 * sensor : 3 * sensor + 3] / step
        of_axes = of_axes * process.scale
        transition[:, :5, 3:] += of_axes @ processes.output[source]
        driven[:, :5, source] = of_axes * process.direct
    return Steps(transition, constant, white, driven)


def _swing_lever_arms(problem: HeadingProblem, times_s: np.ndarray) -> np.ndarray:
    """Return what each lever arm adds to u and phi between times, (n - 1, 5, arms).

    The sensors have the velocity w_nb x l, whose changes enter u.
    """
    c, w = problem.motion(times_s)
    rate = w - np.array([0.0, problem.place.rate_n, problem.place.rate_u]) @ c
    east, north, _ = np.einsum("kij,kaj->ika", c, np.cross(rate[:, None], np.eye(3)))
    change = np.diff((east + 1j * north) @ problem.lever_arms.T, axis=0)
    return np.pad(np.stack([change.real, change.imag], axis=1), ((0, 0), (0, 3), (0, 0)))

"""The least heading error that the data allow any method: information bounds.

On a base at rest, a heading error phi_U tilts a free platform at the constant rate
-omega_N phi_U - eps_E, and the north specific force is g phi_E + nabla_N + noise. So the heading,
from its floor -eps_E/omega_N, is the slope of a ramp in the force with unknown offset and start.

White noise has a closed form, sqrt(12 q_a/(g^2 T^3) + q_g/T)/omega_N. Accelerometers with density
q_a leave the slope of the tilt the variance of a straight line's, 12 q_a/(g^2 T^3). Gyros with
density q_g turn the ramp into a random walk with a drift, whose variance is q_g/T. The least
variance of an unbiased linear estimator is superadditive in the noise covariance, since
min w'(A + B)w >= min w'A w + min w'B w over all weights w. The sum is therefore a bound, and close
if one of the two noises dominates. Repeated passes add nothing. A swing about a constant attitude
is known from the gyros and rotates the biases by too little to matter.

`heading_bound` allows coloured noise. The heading of a base that does not travel shows only in its
level computed velocity u, the integral of the specific force that the gyros transform to n. To
first order in the misalignment phi

    u'   = f x phi - 2 w_ie x u + v' + noise of the accelerometers,
    phi' = phi x w_ie + noise of the gyros,          f = (0, 0, g), u(0) = 0,

with the velocity v of the surging base: a process x' = A x + b w whose changes all enter u.
Linear vibration and drifts of the sensors enter likewise. Angular vibration is left out: the gyros
measure it, and what it adds to the velocity at the end of a lever arm averages out. Only phi(0) is
unknown, so u is d phi(0) + e with known rows d and a Gaussian e of known covariance C, and no
unbiased estimator has a smaller covariance than (d' C^-1 d)^-1 (Gauss and Markov; Cramer and Rao).
C would be a full matrix of the samples. A Kalman filter that knows phi(0) = 0 whitens e instead:
its innovations r have known covariances S, and C^-1 = L' S^-1 L with the filter itself as L. It
whitens the columns of d as it does u, so

    d' C^-1 d = sum over the samples of r_d' S^-1 r_d,

with r_d the innovations of the filter that is given d. A sway about a constant attitude is known
from the gyros and does not matter, nor does a lever arm from its centre. Constant biases leave a
floor, see `methods.floors`, from which both bounds are measured.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from sinsjax.bounds.coloured_noise import (
    ANGLE,
    IN_N,
    VELOCITY,
    increment_error_processes,
)
from sinsjax.maths.algebra import entries_as_numbers
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.error_model import PHI_E, PHI_U, VE, five_state_transition
from sinsjax.strapdown.sensors import SensorErrors
from sinsjax.types import Navigation, Quat, Vec3

Number: TypeAlias = Any
"""A float, or a NumPy array that broadcasts."""

_LEVEL = slice(VE, PHI_E)
_PHI = slice(PHI_E, PHI_U + 1)


class SampleModel(NamedTuple):
    """x <- F x + noise over a sample, for u, phi and the states of the processes.

    Attributes:
        transition: (n, n) F.
        noise: (n, n) covariance of the noise.
        initial: (n, n) covariance of x before the first sample, given phi.
    """

    transition: np.ndarray
    noise: np.ndarray
    initial: np.ndarray


def heading_bound(
    times_s: Sequence[float],
    *,
    place: Place,
    errors: SensorErrors,
    disturbances: Disturbances,
    dt: float,
    to_n: np.ndarray | None = None,
) -> np.ndarray:
    """Return the least 1 sigma of phi_u of any unbiased estimator, from the bias floor, rad.

    Args:
        times_s: lengths of the data, s, ascending, of whole samples.
        place: Earth rates and gravity; not a pole.
        errors: of the sensors, with white noise of the accelerometers.
        disturbances: of base and sensors, none of them drawn.
        dt: sample time, s.
        to_n: (3, 3) mean C_b^n, which matters if axes differ; None for a body along n.

    Returns:
        (times,); infinite while the heading is not observable.
    """
    model = sample_model(place, errors, disturbances, dt, np.eye(3) if to_n is None else to_n)
    samples = [round(time / dt) for time in times_s]
    information = dict(zip(samples, _accumulate_information(model, samples), strict=True))
    return np.array([_heading_sigma(information[count]) for count in samples])


def _heading_sigma(information: np.ndarray) -> float:
    """Return 1 sigma of the last of three unknowns; infinite without information on it."""
    scale = np.sqrt(np.diag(information))
    if not scale.all():
        return np.inf
    # Scaled, since tilts are known a thousand times better than the heading.
    root = np.linalg.cholesky(information / np.outer(scale, scale))
    return 1 / float(root[-1, -1] * scale[-1])


def _accumulate_information(model: SampleModel, samples: Sequence[int]) -> Iterator[np.ndarray]:
    """Yield the information d' C^-1 d (3, 3) on phi(0) after numbers of samples, ascending."""
    f, p = model.transition, model.initial
    response = np.zeros((len(f), 3))
    response[_PHI] = np.eye(3)
    total, done = np.zeros((3, 3)), 0
    for count in samples:
        for _ in range(done, count):
            p = f @ p @ f.T + model.noise
            response = f @ response
            innovation, s = response[_LEVEL], p[_LEVEL, _LEVEL]
            gain = np.linalg.solve(s, p[_LEVEL]).T
            total = total + innovation.T @ np.linalg.solve(s, innovation)
            response = response - gain @ innovation
            p = p - gain @ p[_LEVEL]
            p = (p + p.T) / 2
            p[_LEVEL], p[:, _LEVEL] = 0.0, 0.0  # u is known, except for rounding
        done = count
        yield total


def sample_model(
    place: Place, errors: SensorErrors, disturbances: Disturbances, dt: float, to_n: np.ndarray
) -> SampleModel:
    """Return the model of a base at rest, whose velocity has the disturbances."""
    coloured = increment_error_processes(disturbances, dt).values()
    n = PHI_U + 1 + sum(3 * len(process.drive) for process, _ in coloured)
    f, noise, initial = np.eye(n), np.zeros((n, n)), np.zeros((n, n))
    still = Navigation(Quat(1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.0)
    level = five_state_transition(still, place, Vec3(0.0, 0.0, place.gravity * dt), dt)
    for where, entry in entries_as_numbers(level).items():
        f[where] += entry
    for first, sigma in ((VELOCITY, errors.accel_noise), (ANGLE, errors.gyro_noise)):
        effect = _effect_of_increments(first, to_n)
        noise[:5, :5] += effect * np.square(sigma) @ effect.T
    at = PHI_U + 1
    for process, (first, axes) in coloured:
        effect = _effect_of_increments(first, np.eye(3) if axes == IN_N else to_n) * process.scale
        states = slice(at, at + 3 * len(process.drive))
        f[:5, states] = np.kron(effect, process.output)
        f[states, states] = np.kron(np.eye(3), process.transition)
        driven = np.zeros((n, 3))
        driven[:5] = effect * process.direct
        driven[states] = np.kron(np.eye(3), process.drive[:, None])
        noise += driven @ driven.T
        initial[states, states] = np.kron(np.eye(3), process.begin @ process.begin.T)
        at = states.stop
    return SampleModel(f, noise, initial)


def _effect_of_increments(first: int, to_n: np.ndarray) -> np.ndarray:
    """Return the change of u and phi by errors of one sensor's increments, (5, 3)."""
    out = np.zeros((5, 3))
    if first == VELOCITY:
        out[_LEVEL] = to_n[:2]
    else:
        out[_PHI] = -to_n
    return out

"""What any method could know of the heading: the information bound where not all noise is white.

All that tells the heading of a base that does not travel is its level computed velocity u, the
integral of the specific force that the gyros carry to n. To first order in the misalignment phi

    u'   = f x phi - 2 w_ie x u + v' + noise of the accelerometers,
    phi' = phi x w_ie + noise of the gyros,          f = (0, 0, g), u(0) = 0,

where v is the velocity of the surging base: a process x' = A x + b w of which u holds every change.
Vibration and drifts of the sensors enter likewise. phi(0) is unknown and nothing else is, so that u
is d phi(0) + e with known rows d and a Gaussian e of known covariance C, and no unbiased estimator
has a smaller covariance than (d' C^-1 d)^-1 (Gauss and Markov; Cramer and Rao). C would be a full
matrix of the samples. A Kalman filter that knows phi(0) = 0 whitens e instead: its innovations r
have known covariances S and the samples' C^-1 = L' S^-1 L, L being the filter itself. It whitens
the columns of d as well as it does u, so that

    d' C^-1 d = sum over the samples of r_d' S^-1 r_d,

r_d the innovations of the filter that is given d. With white noise alone this is close to
`bounds.record_bound`. A sway about a constant attitude is known from the gyros and counts for
nothing, and so does a lever arm from its centre, which moves the sensors as the sway says. Constant
biases leave a floor, see `limits`, from which the bound is told.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from sinsjax.maths.algebra import numbers_of
from sinsjax.methods import coloured_growth
from sinsjax.methods.coloured_growth import ANGLE, IN_N, VELOCITY
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.error_model import PHI_E, PHI_U, VE, five_state
from sinsjax.strapdown.sensors import SensorErrors
from sinsjax.types import Navigation, Quat, Vec3

_LEVEL = slice(VE, PHI_E)
_PHI = slice(PHI_E, PHI_U + 1)


class Model(NamedTuple):
    """x <- F x + noise, over a sample; u, phi, then the states of the processes.

    Attributes:
        transition: (n, n) F.
        noise: (n, n) covariance of the noise.
        begin: (n, n) covariance of x before the first sample, phi being known.
    """

    transition: np.ndarray
    noise: np.ndarray
    begin: np.ndarray


def heading_bound(
    times_s: Sequence[float],
    *,
    place: Place,
    errors: SensorErrors,
    disturbances: Disturbances,
    dt: float,
    to_n: np.ndarray | None = None,
) -> np.ndarray:
    """Least 1 sigma of phi_u of any unbiased estimator, told from the biases' floor, rad.

    Args:
        times_s: lengths of the data, s, ascending, of whole samples.
        place: Earth rates and gravity; not a pole.
        errors: of the sensors: their white noise counts, and the accelerometers must have some.
        disturbances: of base and sensors, without draws of their own.
        dt: sample time, s.
        to_n: (3, 3) mean C_b^n, which matters where axes differ; None for a body along n.

    Returns:
        (times,); infinite before the heading is told at all.
    """
    model = model_of(place, errors, disturbances, dt, np.eye(3) if to_n is None else to_n)
    samples = [round(time / dt) for time in times_s]
    told = dict(zip(samples, _information(model, samples), strict=True))
    return np.array([_sigma(told[count]) for count in samples])


def _sigma(information: np.ndarray) -> float:
    """1 sigma of the last of three unknowns; infinite where it is not told."""
    scale = np.sqrt(np.diag(information))
    if not scale.all():
        return np.inf
    # Scaled, since tilts are told a thousand times better than the heading.
    root = np.linalg.cholesky(information / np.outer(scale, scale))
    return 1 / float(root[-1, -1] * scale[-1])


def _information(model: Model, samples: Sequence[int]) -> Iterator[np.ndarray]:
    """Information d' C^-1 d (3, 3) of phi(0) after so many samples, ascending."""
    f, p = model.transition, model.begin
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
            p[_LEVEL], p[:, _LEVEL] = 0.0, 0.0  # u is known; rounding would leave some
        done = count
        yield total


def model_of(
    place: Place, errors: SensorErrors, disturbances: Disturbances, dt: float, to_n: np.ndarray
) -> Model:
    """The model of a base at rest in whose velocity the disturbances stand; see `heading_bound`."""
    coloured = list(coloured_growth.each(coloured_growth.increments(disturbances, dt)))
    n = PHI_U + 1 + sum(3 * len(process.drive) for process, _ in coloured)
    f, noise, begin = np.eye(n), np.zeros((n, n)), np.zeros((n, n))
    still = Navigation(Quat(1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.0)
    level = five_state(still, place, Vec3(0.0, 0.0, place.gravity * dt), dt)
    for where, entry in numbers_of(level).items():
        f[where] += entry
    for first, sigma in ((VELOCITY, errors.accel_noise), (ANGLE, errors.gyro_noise)):
        enters = _enters(first, to_n)
        noise[:5, :5] += enters * np.square(sigma) @ enters.T
    at = PHI_U + 1
    for process, (first, axes) in coloured:
        enters = _enters(first, np.eye(3) if axes == IN_N else to_n) * process.scale
        states = slice(at, at + 3 * len(process.drive))
        f[:5, states] = np.kron(enters, process.output)
        f[states, states] = np.kron(np.eye(3), process.transition)
        driven = np.zeros((n, 3))
        driven[:5] = enters * process.direct
        driven[states] = np.kron(np.eye(3), process.drive[:, None])
        noise += driven @ driven.T
        begin[states, states] = np.kron(np.eye(3), process.begin @ process.begin.T)
        at = states.stop
    return Model(f, noise, begin)


def _enters(first: int, to_n: np.ndarray) -> np.ndarray:
    """What u and phi gain by errors of the increments of one sensor, (5, 3)."""
    out = np.zeros((5, 3))
    if first == VELOCITY:
        out[_LEVEL] = to_n[:2]
    else:
        out[_PHI] = -to_n
    return out

"""The compass loops as linear systems, [P2] eqs (1), (2) and (16)-(23): gains, roots, matrices.

Gains are designed from a decay rate sigma (> 0, 1/s) and a damping ratio xi (0 < xi <= 1): the
complex roots are -sigma +- j omega_d with xi = sigma / sqrt(sigma^2 + omega_d^2). The transport
rate belongs to the mechanisation, so the platform is rotated by K2/R dV and the loop sees
(1 + K2)/R dV.

The states are errors: velocity (m/s), tilt and heading (rad), rate of the azimuth control (rad/s).
In the north channel the tilt is phi_E, dV_N' = g phi_E - K1 dV_N. The east channel has the same
loop with -phi_N in the place of phi_E.

Throughout, ``gravity`` is g in m/s^2 and ``radius`` the R of the transport rate in m. All numbers
broadcast; where only gains are designed, they may be traced. Matrices are arrays with the shape of
the gains first.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

Number: TypeAlias = Any
"""A float, a NumPy array, or a traced number."""

PAPER_DAMPING = math.sqrt(0.5)
"""The damping ratio of [P2] section 3.1."""


class LevelGains(NamedTuple):
    """Gains of a levelling loop, [P2] Fig. 1: w_c = K2/R dV + K3 (integral of dV).

    Attributes:
        k1: velocity damping, 1/s.
        k2: of the platform rate from the velocity, in units of the transport rate 1/R.
        k3: of the platform rate from the integral of the velocity, rad/(m s).
    """

    k1: Number
    k2: Number
    k3: Number


class AzimuthGains(NamedTuple):
    """Gains of the azimuth loop, [P2] Fig. 2: w_cU = K(s) dV_N, K(s) = K3 / (omega_N (s + K4)).

    Attributes:
        k1: as of `LevelGains`, likewise ``k2``.
        k3: of the azimuth acceleration from the velocity, times omega_N, 1/(m s^2).
        k4: of the lag in K(s), 1/s.
    """

    k1: Number
    k2: Number
    k3: Number
    k4: Number


def level_gains(sigma: Number, damping: Number, *, gravity: Number, radius: Number) -> LevelGains:
    """Return the gains that put the roots at -sigma and -sigma +- j omega_d, [P2] eqs (17), (18).

    K1 = 3 sigma, K2 = sigma^2 (2 + 1/xi^2) R/g - 1, K3 = sigma^3 / (g xi^2).
    """
    inverse_square = damping**-2
    k2 = sigma**2 * (2 + inverse_square) * radius / gravity - 1
    return LevelGains(3 * sigma, k2, sigma**3 * inverse_square / gravity)


def azimuth_gains(
    sigma: Number, damping: Number, *, gravity: Number, radius: Number
) -> AzimuthGains:
    """Return gains with K1 = K4 and double roots at -sigma +- j omega_d, [P2] eqs (22) and (23).

    K1 = K4 = 2 sigma, K2 = 2 W R/g - 1, K3 = W^2/g with W = sigma^2/xi^2. The paper has only
    xi = sqrt(1/2): K2 = 4 sigma^2 R/g - 1, K3 = 4 sigma^4/g.
    """
    square = (sigma / damping) ** 2
    k2 = 2 * square * radius / gravity - 1
    return AzimuthGains(2 * sigma, k2, square**2 / gravity, 2 * sigma)


def scale_azimuth_gains(gains: AzimuthGains, pace: Number) -> AzimuthGains:
    """Return gains whose roots lie a factor > 0 further out: sigma times the pace, xi kept."""
    k1, k2, k3, k4 = gains
    return AzimuthGains(pace * k1, pace**2 * (1 + k2) - 1, pace**4 * k3, pace * k4)


def sigma_from_period(time_s: Number, damping: Number) -> Number:
    """Return the decay rate (1/s) whose damped period is the adjustment time, [P2] eq. (18).

    sigma = 2 pi xi / (T sqrt(1 - xi^2)), that is T = 2 pi / omega_d; xi = 1 has no period.
    """
    return 2 * math.pi * damping / (time_s * (1 - damping**2) ** 0.5)


def sigma_from_settling(time_s: Number, remainder: Number, xp: Any = np) -> Number:
    """Return the decay rate (1/s) whose envelope exp(-sigma t) falls to a remainder in the time.

    The printed gains of [P2] read its adjustment times so: exp(-3) after 150 s and exp(-4.5) after
    450 s.
    """
    return -xp.log(remainder) / time_s


def roots(matrix: np.ndarray) -> np.ndarray:
    """Return the complex roots of a loop from its matrix, the slowest (largest real part) first.

    Double roots, as designed in azimuth, are found to half of the digits.
    """
    found = np.linalg.eigvals(matrix).astype(complex)
    return np.take_along_axis(found, np.lexsort((-found.imag, -found.real)), -1)


def level_matrix(gains: LevelGains, *, gravity: Number, radius: Number) -> np.ndarray:
    """Return A of the levelling loop, x' = A x, x = [dV, phi, I], [P2] Fig. 1.

    I (rad/s) is K3 times the integral of dV. The coupling with the heading is left out. Its
    characteristic polynomial is [P2] eq. (16), s^3 + K1 s^2 + (1 + K2) (g/R) s + g K3.
    """
    k1, k2, k3 = gains
    return _matrix([-k1, gravity, 0.0], [-(1 + k2) / radius, 0.0, -1.0], [k3, 0.0, 0.0])


def azimuth_matrix(gains: AzimuthGains, *, gravity: Number, radius: Number) -> np.ndarray:
    """Return A of the north channel, x' = A x, x = [dV_N, phi_E, omega_N phi_U, omega_N w_cU].

    [P2] Fig. 2; omega_N phi_E in phi_U' is dropped, as in the characteristic polynomial, [P2] eq.
    (21), s (s + K4) (s^2 + K1 s + (1 + K2) g/R) + g K3. A backward pass, with -omega_N, has the
    same.
    """
    k1, k2, k3, k4 = gains
    return _matrix(
        [-k1, gravity, 0.0, 0.0],
        [-(1 + k2) / radius, 0.0, -1.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
        [k3, 0.0, 0.0, -k4],
    )


def is_stable(matrix: np.ndarray, dt: float) -> np.ndarray:
    """Return whether a loop is stable when stepped with a sample time.

    A step is forward Euler, but the velocity sees the mean tilt of the step:
    dV += g (phi + phi' dt/2) dt - K1 dV dt. It is stable where every eigenvalue of the discrete
    matrix (of `level_matrix` or `azimuth_matrix`, dt in s) lies inside the unit circle.
    """
    mean_tilt = matrix[..., :1, 1:2] * matrix[..., 1:2, :] / 2
    stepped = matrix + dt * np.eye(matrix.shape[-1])[:, :1] * mean_tilt
    # The eigenvalues of the step are 1 + dt z; from z, 1 is not rounded into them.
    z = np.linalg.eigvals(stepped)
    return np.asarray(np.all(2 * z.real + dt * np.abs(z) ** 2 < 0, -1))


def _matrix(*rows: Sequence[Number]) -> np.ndarray:
    """Return entries as a matrix on the last axes."""
    entries = np.broadcast_arrays(*(entry for row in rows for entry in row))
    return np.stack(entries, -1).astype(float).reshape(*entries[0].shape, len(rows), len(rows[0]))

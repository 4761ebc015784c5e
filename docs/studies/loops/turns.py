"""The turns between two passes over a stored record: their names, and what a cycle leaves."""

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from sinsjax.methods.compass import design as loops
from sinsjax.methods.compass.config import REVERSALS
from sinsjax.methods.compass.design import Number
from sinsjax.study.study import Study

TURNS = {
    "velocity": "paper's turn",
    "velocity_and_rate": "rate reversed too",
    "velocity_drop_rate": "rate dropped too",
    "reflect": "tilt reflected",
}
"""What is done at a turn besides reversing the velocity, by its rule."""


def cycle_radius(
    study: Study, turn: str, sigma: Number, stored_s: Number, smoothing_s: Number | None = None
) -> NDArray:
    """As `compass.design.cycle_radius`, with the turn as it is made: by a specific force that lags.

    Args:
        study: compass loops of one damping.
        turn: one of `TURNS`.
        sigma: decay rate of the azimuth loop, 1/s.
        stored_s: length of a pass, s.
        smoothing_s: delay of the low-passed specific force, two equal stages, s; the study's if
            None.

    Returns:
        Spectral radius of a cycle of two passes, of the shape that the numbers broadcast to.
    """
    delay_s = study.single_value("turn_smoothing_s") if smoothing_s is None else smoothing_s
    damping = study.single_value("azimuth_damping")
    sigma, stored_s, damping, delay_s = np.broadcast_arrays(sigma, stored_s, damping, delay_s)
    earth = {"gravity": 1.0, "radius": 1.0}
    gains = loops.azimuth_gains(sigma, damping, **earth)
    azimuth = loops.azimuth_matrix(gains, rate_n=1.0, direction=1, **earth)
    matrix = np.zeros((*azimuth.shape[:-2], 6, 6))
    matrix[..., :4, :4] = azimuth
    matrix[..., 4, 1] = matrix[..., 5, 4] = 2 / delay_s
    matrix[..., 4, 4] = matrix[..., 5, 5] = -2 / delay_s
    forward = scipy.linalg.expm(matrix * stored_s[..., None, None])
    mirror = np.diag([-1.0, -1.0, 1.0, 1.0, -1.0, -1.0])  # time reversed: velocity, tilt, force
    made = _turn(turn)
    cycle = made @ mirror @ forward @ mirror @ made @ forward
    return np.asarray(np.abs(np.linalg.eigvals(cycle)).max(-1))


def _turn(name: str) -> NDArray:
    """What a turn makes of [dV_N, phi_E, phi_U, w_cU, f_1/g, f_2/g], f the low-passed force."""
    velocity, _, rate, reflection = REVERSALS[name]
    left = 1 - 2 * reflection
    matrix = np.diag([velocity, 1.0, 1.0, rate, left, left])
    matrix[1, 5] = -2 * reflection
    return matrix

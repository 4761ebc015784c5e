"""The misalignment phi as states of a filter, [P1] eq. (3): the third to the fifth."""

from typing import Any

from sinsjax.alignment.base import AttitudeCovariance
from sinsjax.maths import rotations
from sinsjax.maths.algebra import triangle_index
from sinsjax.strapdown.error_model import PHI_E, PHI_N, PHI_U
from sinsjax.types import Quat, Vec3

_ANGLES = (PHI_E, PHI_N, PHI_U)


def estimated(state: Any) -> Vec3:
    """`Filter.misalignment`: the estimated rotation vector, rad."""
    return Vec3(*(state.belief.x[i] for i in _ANGLES))


def corrected(state: Any) -> Quat:
    """`Filter.attitude`: exp(phi x) C."""
    return rotations.correct(estimated(state), state.nav.q)


def covariance(state: Any) -> AttitudeCovariance:
    """`Filter.covariance`: that of phi, rad^2."""
    at = triangle_index(len(state.belief.x))
    return AttitudeCovariance(
        *(state.belief.p[at[i, j]] for i in _ANGLES for j in _ANGLES if i <= j)
    )

"""The misalignment phi as states of a filter, [P1] eq. (3): the third to the fifth."""

from typing import Any

import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import Entries, Minus, triangle_index
from sinsjax.methods.base import AttitudeCovariance, StartChange
from sinsjax.strapdown.error_model import PHI_E, PHI_N, PHI_U, VE, VN
from sinsjax.types import Quat, Scalar, Vec3

_ANGLES = (PHI_E, PHI_N, PHI_U)


def estimated(state: Any) -> Vec3:
    """`Filter.misalignment`: the estimated rotation vector, rad."""
    return Vec3(*(state.belief.x[i] for i in _ANGLES))


def inputs(state: Any) -> Entries:
    """`Filter.inputs`: velocities by velocity increments, phi against the angles."""
    turned = {(i, 3 + k): Minus(1.0) for k, i in enumerate(_ANGLES)}
    return {(VE, 0): 1.0, (VN, 1): 1.0, **turned}


def start_error(state: Any, change: StartChange) -> tuple[Scalar, ...]:
    """`Filter.start_error`: as it is; biases are estimated from zero all the same."""
    others = state.belief.x[PHI_U + 1 :]
    zeros = (jnp.zeros_like(change.ve),) * len(others)
    return (change.ve, change.vn, *change.phi, *zeros)


def corrected(state: Any) -> Quat:
    """`Filter.attitude`: exp(phi x) C."""
    return rotations.correct(estimated(state), state.nav.q)


def covariance(state: Any) -> AttitudeCovariance:
    """`Filter.covariance`: that of phi, rad^2."""
    at = triangle_index(len(state.belief.x))
    return AttitudeCovariance(
        *(state.belief.p[at[i, j]] for i in _ANGLES for j in _ANGLES if i <= j)
    )

"""The limit of a filter without bias states in closed form, by what it is made of."""

import math
from typing import NamedTuple

import numpy as np

from sinsjax.errors import InputError
from sinsjax.report.base import only
from sinsjax.study.study import Study
from sinsjax.units import ARCMIN, DEG, DEG_PER_H, MICRO


class Ingredients(NamedTuple):
    """What the limit accuracy is made of, arcmin.

    Attributes:
        phi_e: -nabla_N/g.
        phi_n: nabla_E/g.
        gyro: -eps_E/omega_N, the first term of the yaw limit.
        accel: (nabla_E/g) tan L, its second term.
    """

    phi_e: float
    phi_n: float
    gyro: float
    accel: float


def ingredients(study: Study, earth_rate_deg_per_h: float | None = None) -> Ingredients:
    """The closed form of the limit accuracy for a study's constant biases.

    The biases are turned to n at the centre of the swing. Valid where the filter has no bias states
    and its innovations have vanished.

    Args:
        study: simulated, with an Earth of constants.
        earth_rate_deg_per_h: instead of the study's.

    Raises:
        InputError: a study that has no such limit, or more than one.
    """
    if study.is_recorded or any(p["earth"] != "constants" for p in study.combinations("earth")):
        raise InputError(f"{study.name}: the page needs earth = 'constants'")
    angles = [only(study, f"{a}_center_deg") for a in ("yaw", "pitch", "roll")]
    from scipy.spatial.transform import Rotation  # late, as in `truth`

    turn = Rotation.from_euler("ZXY", angles, degrees=True)
    eps_e = turn.apply(np.ones(3) * only(study, "gyro_bias_deg_per_h"))[0] * DEG_PER_H
    nabla_e, nabla_n, _ = turn.apply(np.ones(3) * only(study, "accel_bias_ug")) * MICRO
    latitude = only(study, "latitude_deg") * DEG
    rate = earth_rate_deg_per_h or only(study, "earth_rate_deg_per_h")
    terms = (
        -nabla_n,
        nabla_e,
        -eps_e / (rate * DEG_PER_H * math.cos(latitude)),
        nabla_e * math.tan(latitude),
    )
    return Ingredients(*(float(term) / ARCMIN for term in terms))


def limit_accuracy(study: Study) -> dict[str, float]:
    """The limits of phi about e, n and u in arcmin, see `ingredients`."""
    parts = ingredients(study)
    return {"e": parts.phi_e, "n": parts.phi_n, "u": parts.gyro + parts.accel}

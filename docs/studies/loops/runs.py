"""What constant biases and the noise of a run's data leave of an alignment, in closed form."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax.bounds.information import Number, record_bound
from sinsjax.engine.sensor_inputs import read_errors
from sinsjax.engine.truth import read_site
from sinsjax.errors import InputError
from sinsjax.study.study import Study
from sinsjax.study.variants import Variants
from sinsjax.units import ARCMIN, DEG, MICRO


class Limits(NamedTuple):
    """What phi settles to for constant biases, arcmin; an attitude error is -phi.

    Attributes:
        e: -nabla_N/g.
        n: nabla_E/g.
        u: the sum of the last two.
        gyro: -eps_E/omega_N.
        accel: (nabla_E/g) tan L.
    """

    e: float
    n: float
    u: float
    gyro: float
    accel: float


def limits_of(study: Study, earth_rate_deg_per_h: float | None = None) -> Limits:
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
    turn = _to_n(study)
    east, north, _ = turn @ (np.ones(3) * study.single_value("accel_bias_ug")) * MICRO / ARCMIN
    drift = turn[0] @ (np.ones(3) * study.single_value("gyro_bias_deg_per_h"))
    latitude = study.single_value("latitude_deg") * DEG
    rate = earth_rate_deg_per_h or study.single_value("earth_rate_deg_per_h")
    gyro = float(-drift / (rate * math.cos(latitude))) / ARCMIN
    accel = float(east) * math.tan(latitude)
    return Limits(-float(north), float(east), gyro + accel, gyro, accel)


def bound_arcmin(study: Study, stored_s: Number) -> NDArray:
    """Information bound of tapes of a study's data: 1 sigma of the heading, arcmin.

    Args:
        study: one base, one set of sensors.
        stored_s: lengths, s.
    """
    first = Variants(study, np.array([0]))
    site, ug = read_site(study, first, None)
    rate_hz = study.rate_hz
    errors = read_errors(first.common, ug, rate_hz)
    east, north, _ = _to_n(study)
    bound = record_bound(
        stored_s,
        gyro_noise=np.linalg.norm(east * errors.gyro_noise) * rate_hz,
        accel_noise=np.linalg.norm(north * errors.accel_noise) * rate_hz,
        rate_hz=rate_hz,
        gravity=site.place.gravity,
        rate_n=site.place.rate_n,
    )
    return np.asarray(bound / ARCMIN)


def _to_n(study: Study) -> NDArray:
    """C_b^n at the centre of the swing."""
    from scipy.spatial.transform import Rotation  # late, as in `truth`

    angles = [study.single_value(f"{angle}_center_deg") for angle in ("yaw", "pitch", "roll")]
    return np.asarray(Rotation.from_euler("ZXY", angles, degrees=True).as_matrix())

"""What the pages on sweeps of compass loops share: heading errors, and the tape's bound."""

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.alignment.bounds import Number, tape_bound
from sinsjax.engine.truth import errors_of, site_of
from sinsjax.report.base import only
from sinsjax.study.study import Study
from sinsjax.study.variants import Variants
from sinsjax.units import ARCMIN


def heading_errors(rows: pa.Table) -> NDArray:
    """Heading error phi_u from its floor at the end, one a run, arcmin; NaN if unknown."""
    return analysis.numbers(rows, "phi_u_arcmin") - analysis.numbers(rows, "floor_arcmin")


def bound_arcmin(study: Study, tape_s: Number) -> NDArray:
    """Information bound of tapes of a study's data: 1 sigma of the heading, arcmin.

    Args:
        study: one base, one set of sensors.
        tape_s: lengths, s.
    """
    first = Variants(study, np.array([0]))
    site, ug = site_of(study, first, None)
    rate_hz = study.rate_hz
    errors = errors_of(first.common, ug, rate_hz)
    angles = [only(study, f"{angle}_center_deg") for angle in ("yaw", "pitch", "roll")]
    from scipy.spatial.transform import Rotation  # late, as in `truth`

    east, north, _ = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
    bound = tape_bound(
        tape_s,
        gyro_noise=np.linalg.norm(east * errors.gyro_noise) * rate_hz,
        accel_noise=np.linalg.norm(north * errors.accel_noise) * rate_hz,
        rate_hz=rate_hz,
        gravity=site.place.gravity,
        rate_n=site.place.rate_n,
    )
    return np.asarray(bound / ARCMIN)

"""The keys with which samples of a simulation have to be made in turn."""

import numpy as np

from sinsjax.study.study import Study

IN_TURN = (
    *("surge_m_per_s", "vibration_ug_rms", "vibration_deg_per_h_rms"),
    *("gyro_instability_deg_per_h", "accel_instability_ug"),
    *("gyro_rrw_deg_per_h_per_sqrt_h", "accel_rrw_ug_per_sqrt_h"),
    *("gyro_quantisation_arcsec", "accel_quantisation_um_per_s"),
)
"""The keys with which a sample hangs on those before it."""


def keys_in_turn(study: Study) -> list[str]:
    """Those of `IN_TURN` that some variant of a study has."""
    if study.is_recorded:
        return []

    def taken(key: str) -> bool:
        values = (point[key] for point in study.combinations(key))
        return any(value is None or np.any(value) for value in values)

    return [key for key in IN_TURN if taken(key)]


def runs_in_turn(study: Study) -> bool:
    """Whether a sample of some variant of a study hangs on those before it."""
    return bool(keys_in_turn(study))

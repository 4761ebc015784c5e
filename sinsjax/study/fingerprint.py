"""What tells a study's results from those of another, whatever its name, report or key order."""

import hashlib
import json
from typing import Any

from sinsjax.study.keys import SECTIONS
from sinsjax.study.study import Study

_NOT_COMPUTED: Any = {
    "tune": True,
    "study": {"name", "unchecked"},
}
_SECTIONS_OF_0_5 = "motion sensors filter resets compass passes record coarse".split()
_KEYS_OF_0_5 = frozenset(
    """
    rate_hz draws
    gravity_m_per_s2 radius_m earth_rate_deg_per_h latitude_deg height_m
    yaw_center_deg
    gyro_noise_deg_per_h gyro_arw_deg_per_sqrt_h accel_noise_ug accel_vrw_ug_per_sqrt_hz
    specific_force feedback_interval_s feedback_time_constant_s
    q_accel_ug q_gyro_deg_per_h
    reset_count reset_cycle_s reset_times_s
    level_sigma_per_s level_adjustment_s level_gains level_time_s level_passes
    azimuth_sigma_per_s azimuth_adjustment_s azimuth_gains sigma_times_s sigma_passes
    tape_s passes turn turn_smoothing_s turn_covariance turn_inflation
    quantity time_column gyro_columns accel_columns gyro_unit accel_unit
    """.split()
)
"""Keys and sections that are told even where a study leaves them out, as 0.5.0 did; no others are,
so that a study keeps its fingerprint whatever later versions add."""

_KEYS_OF_0_6 = frozenset(
    """
    estimate
    lever_arm_m surge_m_per_s surge_time_s surge_bandwidth_hz surge_model
    vibration_ug_rms vibration_deg_per_h_rms vibration_hz vibration_damping
    gyro_instability_deg_per_h gyro_instability_time_s gyro_rrw_deg_per_h_per_sqrt_h
    accel_instability_ug accel_instability_time_s accel_rrw_ug_per_sqrt_h
    gyro_quantisation_arcsec accel_quantisation_um_per_s
    reset_at_feedback reset_restarts_feedback
    """.split()
)
"""Keys with a default, told only where they have another value."""


def fingerprint(study: Study) -> str:
    """16 hex digits that tell what a study computes.

    The order of the axes, of the zips and of the drawn keys counts: it numbers the variants and
    points. What a study does not use leaves it as it was before that came.
    """
    content = study.model_dump(exclude=_NOT_COMPUTED)
    content["axes"] = list(study.axes.items())
    content["zips"] = list(study.zips.values())
    if study.drawn:
        content["drawn"] = list(study.drawn.model_dump(exclude_none=True).items())
    content = {k: v for k, v in content.items() if v or k in (*_SECTIONS_OF_0_5, "axes", "cases")}
    for name, table in content.items():
        if isinstance(table, dict):
            content[name] = {k: v for k, v in table.items() if _told(name, k, v)}
    text = json.dumps(content, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def with_draws(study: Study, draws: int) -> Study:
    """A simulated study with another number of draws and nothing else changed, not checked."""
    return study.model_copy(update={"study": study.study.model_copy(update={"draws": draws})})


def _told(section: str, key: str, value: Any) -> bool:
    if key in _KEYS_OF_0_6:
        return bool(value != SECTIONS[section].model_fields[key].default)
    return value is not None or key in _KEYS_OF_0_5

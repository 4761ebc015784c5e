"""The method that advice names, its settings and its loss against linear theory."""

import math
from typing import Any, NamedTuple

import tomli_w

from sinsjax.advice.sheet import Sheet, rms
from sinsjax.methods.filters.keys import level_surge
from sinsjax.study.schema import MotionSection

FIT, FILTER = "gravity_fit", "kalman_surge"

LEFT_OUT = {
    FIT: ("gyro_quantisation", "accel_quantisation", "shaking", "accel_scale"),
    FILTER: (
        *("gyro_quantisation", "accel_quantisation", "shaking"),
        *("gyro_instability", "accel_instability", "gyro_walk", "accel_walk"),
        *("gyro_bias", "accel_bias", "gyro_scale", "gyro_misalignment"),
        *("accel_scale", "accel_misalignment"),
    ),
}
"""Sources of errors, see `advice.heading.SOURCES`, for which a method has no unknowns."""

_MOST_LOSS, _LOSS_PER_RAD = 0.2, 0.5
"""What large errors of the heading that vary add to those of the filter, see docs/advise.md."""


class Choice(NamedTuple):
    """A method for a sheet.

    Attributes:
        method: its name.
        sections: sections of a study that choose and set it.
        reason: why this one, in a clause.
    """

    method: str
    sections: dict[str, Any]
    reason: str

    @property
    def toml(self) -> str:
        """The sections as TOML."""
        return tomli_w.dumps(self.sections).strip()

    def expected_sigma(self, sigma: float, varying: float) -> float:
        """Return the 1 sigma to expect, rad, from that of linear theory.

        Args:
            sigma: of linear theory, rad.
            varying: part of it that is not of constant biases, rad.
        """
        if self.method == FIT:
            return sigma
        more = 1 + min(_MOST_LOSS, _LOSS_PER_RAD * varying)
        return math.sqrt(sigma**2 + (more**2 - 1) * varying**2)


def choose_method(sheet: Sheet) -> Choice:
    """Return the method with the least error for a sheet."""
    if surge := level_surge(sheet.motion.get("surge_m_per_s")):
        sections = {
            "alignment": {"method": FILTER},
            "surge": {"r_surge_m_per_s": surge, "r_surge_time_s": surge_time_s(sheet)},
            "filter": {  # R, which is left out, follows the motion
                "q_reading": "psd",
                "q_gyro_arw_deg_per_sqrt_h": _round_off(sheet.sigma("gyro_arw_deg_per_sqrt_h")),
                "q_accel_ug_per_sqrt_hz": _round_off(sheet.sigma("accel_vrw_ug_per_sqrt_hz")),
            },
        }
        return Choice(FILTER, sections, "it estimates the velocity of a surging base")
    arm = _lever_arm(sheet)
    keys = (
        *("gyro_bias_deg_per_h", "gyro_arw_deg_per_sqrt_h", "accel_bias_ug"),
        *("accel_vrw_ug_per_sqrt_hz", "gyro_scale_ppm", "gyro_misalignment_arcsec"),
    )
    beliefs = {f"fit_{key}": sheet.sigma(key) for key in keys} | {"fit_lever_arm_m": arm}
    sections = {
        "alignment": {"method": FIT},
        "gravity_fit": {key: _round_off(value) for key, value in beliefs.items() if value},
    }
    reason = "it fits all the data at once and needs no initial attitude"
    return Choice(FIT, sections, reason + ", and the lever arm is one of its unknowns" * bool(arm))


def surge_time_s(sheet: Sheet) -> float:
    """Return the correlation time of the surge, s."""
    default = MotionSection.model_fields["surge_time_s"].default
    return float(sheet.motion.get("surge_time_s", default))


def _lever_arm(sheet: Sheet) -> float:
    """Return the rms of the parts of a lever arm that sways or turns, m."""
    keys = ("pitch_amplitude_deg", "roll_amplitude_deg", "yaw_amplitude_deg", "turn_times_s")
    moves = any(sheet.motion.get(key) for key in (*keys, "attitude_file"))
    return rms(sheet.motion.get("lever_arm_m", 0.0)) if moves else 0.0


def _round_off(value: float) -> float:
    """Return a number with four digits."""
    return float(f"{value:.4g}")

"""The states that filters have, by name: what keys of a study say of each."""

from typing import NamedTuple

from sinsjax.units import DEG, DEG_PER_H


class StateKind(NamedTuple):
    """What a state is, as far as the keys of [filter] and [resets] are concerned.

    Attributes:
        p0: key of its initial standard deviation; None where that is ``variance``.
        reset_to: key of what it is reset to.
        unit: of both keys in SI; None for a micro-g.
        q: key of its process noise; None of a constant.
        variance: its initial variance and what it is reset to, where no key gives them.
    """

    p0: str | None
    reset_to: str | None
    unit: float | None
    q: str | None
    variance: float = 0.0


VELOCITY = StateKind("p0_velocity_m_per_s", "reset_velocity_m_per_s", 1.0, "q_accel_ug")
LEVEL = StateKind("p0_level_deg", "reset_level_deg", DEG, "q_gyro_deg_per_h")
HEADING = StateKind("p0_yaw_deg", "reset_yaw_deg", DEG, "q_gyro_deg_per_h")
DIRECTION = StateKind(None, None, 1.0, "q_gyro_deg_per_h", variance=0.5)
"""Sine or cosine of a heading of which nothing is known: every one is equally likely."""
ACCEL_BIAS = StateKind("p0_accel_bias_ug", "reset_accel_bias_ug", None, None)
GYRO_BIAS = StateKind("p0_gyro_bias_deg_per_h", "reset_gyro_bias_deg_per_h", DEG_PER_H, None)

STATES: dict[str, StateKind] = {
    **dict.fromkeys(("dve", "dvn"), VELOCITY),
    **dict.fromkeys(("phi_e", "phi_n", "tilt_e", "tilt_n"), LEVEL),
    **dict.fromkeys(("phi_u", "heading"), HEADING),
    **dict.fromkeys(("heading_sine", "heading_versine"), DIRECTION),
    **dict.fromkeys(("nabla_x", "nabla_y"), ACCEL_BIAS),
    **dict.fromkeys(("eps_x", "eps_y", "eps_z"), GYRO_BIAS),
}

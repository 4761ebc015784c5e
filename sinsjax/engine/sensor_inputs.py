"""Motion and sensors of a simulation in SI units, from the keys of [motion] and [sensors]."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from sinsjax.strapdown import base_motion, processes, sensors
from sinsjax.strapdown.attitude_path import attitude_path
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.strapdown.processes import Process
from sinsjax.strapdown.turns import Turns
from sinsjax.study.schema import TURN_KEYS, MotionSection, SensorsSection
from sinsjax.study.turns import SampledTurns, turns_in_samples
from sinsjax.study.variants import Lookup, Variants
from sinsjax.types import Vec3
from sinsjax.units import ARCSEC, DEG, DEG_PER_H, DEG_PER_SQRT_H, HOUR, PPM

NOISE_KEYS = tuple(
    key for key in SensorsSection.model_fields if key.split("_")[1] in ("noise", "arw", "vrw")
)
"""The keys of white noise."""

DISTORTION_KEYS = tuple(
    key for key in SensorsSection.model_fields if key.split("_")[1] in ("scale", "misalignment")
)
"""The keys of scale factors and misaligned axes."""

AMPLITUDE_KEYS = tuple(key for key in MotionSection.model_fields if "amplitude" in key)
"""The keys of sway."""

DISTURBANCE_KEYS = tuple(
    key
    for section in (MotionSection, SensorsSection)
    for key in section.model_fields
    if key.split("_")[1] in ("instability", "rrw") or key.split("_")[0] in ("surge", "vibration")
)
"""The keys of random processes of base and sensors."""

_NEVER_S = 1e12
"""Beginning of a turn after every run, s."""


def _read_number(common: Lookup, key: str, factor: float = 1.0) -> np.ndarray:
    """Return a key's number (...,); the default, or zero, in place of a drawn value."""
    value = common(key)
    if value is None:
        section = MotionSection if key in MotionSection.model_fields else SensorsSection
        value = section.model_fields[key].default or 0.0
    return np.asarray(np.asarray(value, dtype=float) * factor)


def _read_vector(common: Lookup, key: str, factor: float = 1.0, count: int = 3) -> np.ndarray:
    """Return a key's numbers (..., count): one for all axes, and zero in place of a drawn value."""
    value = common(key)
    given = np.asarray(0.0 if value is None else value, dtype=float) * factor
    return np.broadcast_to(given, np.broadcast_shapes(given.shape, (count,)))


def base_motion_of(variants: Variants) -> base_motion.Motion:
    """Return the whole motion of the base of a part: sways, turns and the sensors' lever arm."""
    motion = add_turns(read_sways(variants.common), variants)
    if (given := variants.attitude) is not None:
        motion = motion._replace(path=attitude_path(given.time_s, given.attitude_deg))
    return add_lever_arm(motion, variants)


def read_sways(common: Lookup) -> base_motion.Motion:
    """Return the sways of the base of a part, from `Variants.common`."""
    number = partial(_read_number, common)

    def sway(angle: str) -> base_motion.Sway:
        return base_motion.Sway(
            center=number(f"{angle}_center_deg", DEG),
            amplitude=number(f"{angle}_amplitude_deg", DEG),
            period=number(f"{angle}_period_s"),
            phase=number(f"{angle}_phase_deg", DEG),
        )

    return base_motion.Motion(sway("pitch"), sway("roll"), sway("yaw"))


def moves(variants: Variants) -> bool:
    """Return whether the base of a part sways or is turned."""
    given = any(variants.common(key) for key in ("turn_times_s", "attitude_file"))
    return given or variants.is_active(*AMPLITUDE_KEYS)


def add_turns(motion: base_motion.Motion, variants: Variants) -> base_motion.Motion:
    """Return the motion of the base with the turns of a part, if it has any."""
    values = {key: variants.common(key) for key in TURN_KEYS}
    if not values["turn_times_s"]:
        return motion
    turns = _turns(
        turns_in_samples(variants.rate_hz, variants.data_end_s, values), variants.rate_hz
    )
    if values["turn_axis"] == "body":
        return motion._replace(table=turns)
    return motion._replace(vertical=turns)


def _turns(plan: SampledTurns, rate_hz: float) -> Turns:
    """Return turns in SI units, with turns that never begin so that few programs are compiled."""
    count = len(plan.turns)
    angles = np.array([turn.angle_deg for turn in plan.turns])
    turns = Turns(
        begin=np.array([turn.begin for turn in plan.turns]) / rate_hz,
        length=np.array([turn.length for turn in plan.turns]) / rate_hz,
        ramp=np.full(count, plan.ramp / rate_hz),
        rate=np.array([turn.rate_deg_per_s for turn in plan.turns]) * DEG,
        before=np.remainder(np.cumsum(angles) - angles, 360.0) * DEG,
    )
    unused = (0, 2 ** (count - 1).bit_length() - count)
    begin = np.pad(turns.begin, unused, constant_values=_NEVER_S)
    return Turns(*(np.pad(a, unused, mode="edge") for a in turns))._replace(begin=begin)


def add_lever_arm(motion: base_motion.Motion, variants: Variants) -> base_motion.Motion:
    """Return the motion of the base with the lever arm of the sensors, if that has an effect."""
    rotates = moves(variants) or variants.is_active("vibration_deg_per_h_rms")
    if not (rotates and variants.is_active("lever_arm_m")):
        return motion
    x, y, z = np.moveaxis(_read_vector(variants.common, "lever_arm_m"), -1, 0)
    return motion._replace(lever=Vec3(x, y, z))


def read_errors(common: Lookup, ug: float, rate_hz: float) -> sensors.SensorErrors:
    """Return the sensor errors of a part with its ug, m/s^2, and rate, Hz."""
    dt = 1 / rate_hz
    numbers = partial(_read_vector, common)

    def noise(per_sample: str, density: str, units_: tuple[float, float]) -> np.ndarray:
        # The standard deviation of a sample integrates to dt times it, a density to sqrt(dt).
        if common(density) is not None:
            return numbers(density, units_[1] * np.sqrt(dt))
        return numbers(per_sample, units_[0] * dt)

    def matrix(scale: str, cross: str) -> np.ndarray:
        scales, angles = numbers(scale, PPM), numbers(cross, ARCSEC, 6)
        out = np.zeros((*np.broadcast_shapes(scales.shape[:-1], angles.shape[:-1]), 3, 3))
        out[..., range(3), range(3)] = scales
        out[..., ~np.eye(3, dtype=bool)] = angles
        return out

    return sensors.SensorErrors(
        gyro_bias=numbers("gyro_bias_deg_per_h", DEG_PER_H),
        accel_bias=numbers("accel_bias_ug", ug),
        gyro_noise=noise(
            "gyro_noise_deg_per_h", "gyro_arw_deg_per_sqrt_h", (DEG_PER_H, DEG_PER_SQRT_H)
        ),
        accel_noise=noise("accel_noise_ug", "accel_vrw_ug_per_sqrt_hz", (ug, ug)),
        gyro_matrix=matrix("gyro_scale_ppm", "gyro_misalignment_arcsec"),
        accel_matrix=matrix("accel_scale_ppm", "accel_misalignment_arcsec"),
    )


def add_quantisation(errors: sensors.SensorErrors, variants: Variants) -> sensors.SensorErrors:
    """Return the sensor errors with quantisation, if any sensor has it."""
    if not variants.is_active("gyro_quantisation_arcsec", "accel_quantisation_um_per_s"):
        return errors
    common = variants.common
    return errors._replace(
        gyro_quantum=_read_vector(common, "gyro_quantisation_arcsec", ARCSEC),
        accel_quantum=_read_vector(common, "accel_quantisation_um_per_s", 1e-6),
    )


def read_disturbances(variants: Variants, ug: float, rate_hz: float) -> Disturbances:
    """Return the random processes of a part, with its ug, m/s^2, and rate, Hz."""
    number, vector = partial(_read_number, variants.common), partial(_read_vector, variants.common)
    dt = 1 / rate_hz

    def optional_process(
        key: str, make: Callable[..., Process], factor: float, *others: Any
    ) -> Any:
        return make(vector(key, factor), *others, dt) if variants.is_active(key) else None

    surge_s, vibration = number("surge_time_s"), number("vibration_hz")
    if variants.common("surge_model") == "gauss_markov":
        surge = optional_process("surge_m_per_s", processes.gauss_markov_process, 1.0, surge_s)
    else:
        bandwidth = number("surge_bandwidth_hz")
        surge = optional_process(
            "surge_m_per_s", processes.bounded_velocity_process, 1.0, surge_s, bandwidth
        )
    resonant = vibration, number("vibration_damping")
    drift, walk = processes.sampled_mean_of_gauss_markov, processes.sampled_mean_of_random_walk
    # A vibrating velocity or angle with rms 1 has a derivative with rms omega.
    omega = 2 * np.pi * vibration[..., None]
    shaking = optional_process("vibration_ug_rms", processes.resonance_process, ug, *resonant)
    rocking = optional_process(
        "vibration_deg_per_h_rms", processes.resonance_process, DEG_PER_H, *resonant
    )
    return Disturbances(
        surge=surge,
        gyro_instability=optional_process(
            "gyro_instability_deg_per_h", drift, DEG_PER_H, number("gyro_instability_time_s")
        ),
        accel_instability=optional_process(
            "accel_instability_ug", drift, ug, number("accel_instability_time_s")
        ),
        gyro_walk=optional_process(
            "gyro_rrw_deg_per_h_per_sqrt_h", walk, DEG_PER_H / np.sqrt(HOUR)
        ),
        accel_walk=optional_process("accel_rrw_ug_per_sqrt_h", walk, ug / np.sqrt(HOUR)),
        shaking=shaking and shaking._replace(scale=shaking.scale / omega),
        rocking=rocking and rocking._replace(scale=rocking.scale / omega),
    )

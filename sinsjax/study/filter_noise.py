"""Q and R of a filter: by their keys, or by the white noise of the sensors and the surge."""

from collections.abc import Callable
from functools import partial

from sinsjax.methods.filters.keys import (
    ACCEL_NOISE,
    GYRO_NOISE,
    ProcessNoise,
    peak_velocity_density,
)
from sinsjax.methods.registry import METHODS
from sinsjax.study.keys import reading_methods
from sinsjax.study.study import Study
from sinsjax.value_types import keys_of

_NOISES = (ACCEL_NOISE, GYRO_NOISE)


def noise_ratios_by_sensor(study: Study) -> dict[str, set[float]]:
    """Return the ratios of the noise in Q to that of the sensors, as standard deviations.

    They are the distinct ratios over all variants, for ``accelerometers`` and ``gyros``; none
    without a filter, and without white noise that all draws have.
    """
    ratios = {noise.sensors: set[float]() for noise in _NOISES}
    for noise in _NOISES if study.has("filter") else ():
        keys = ("method", "q_reading", "q_scale", *noise.forms, *noise.white)
        for point in study.combinations(*keys):
            white = noise.white_density(study.rate_hz, point)
            if white and point["method"] in reading_methods(noise.key):
                ratios[noise.sensors].add(noise.q(study.rate_hz, point) ** 0.5 / white)
    return ratios


def _check_q_unit(study: Study) -> None:
    """Refuse a Q without its unit, a density in another one, and a unit without Q."""
    keys = [key for noise in _NOISES for key in noise.forms]
    given = [key for key in keys if study.gives(key)]
    points = list(study.combinations("q_reading", *keys)) if study.has("filter") else []
    if any(p["q_reading"] is None and any(p[key] is not None for key in keys) for p in points):
        hint = "'psd' for densities, else 'per_sample' or 'per_step'"
        study.refuse("q_reading", f"required with {' and '.join(given)} ({hint})")
    others = sorted({point["q_reading"] for point in points} - {"psd", None})
    densities = [key for key in given if key not in {noise.key for noise in _NOISES}]
    if others and densities:
        study.refuse(densities[0], f"requires q_reading = 'psd', not '{others[0]}'")
    if others and not given:
        text = f"'{others[0]}' needs q_ keys (drop it: without them Q is the sensors' white noise)"
        study.refuse("q_reading", text)


def _check_q_is_determined(noise: ProcessNoise, study: Study) -> None:
    """Refuse a study in which neither keys nor the sensors determine Q."""
    sensor_keys = () if study.is_recorded else noise.white
    drawn = [key for key in sensor_keys if key in study.drawn_keys]
    points = study.combinations("method", *noise.forms, *sensor_keys)
    for point in points if study.has("filter") else ():
        given = any(point[key] is not None for key in noise.forms)
        if given or point["method"] not in reading_methods(noise.key):
            continue
        if study.is_recorded:
            reason = f"a record does not give the noise of its {noise.sensors}"
        elif drawn:
            reason = f"{drawn[0]} is drawn, but the filter has the same Q in all draws"
        elif noise.white_density(1.0, point):
            continue
        else:
            reason = f"the {noise.sensors} have no white noise in [sensors]"
        hint = f"give {[*noise.forms][-1]} from the data sheet, with q_reading = 'psd'"
        study.refuse(noise.key, f"required ({reason}; {hint})")


def _check_r_needs_no_drawn_surge(study: Study) -> None:
    """Refuse an omitted R that would follow a surge that draws vary."""
    drawn = [key for key in keys_of(peak_velocity_density) if key in study.drawn_keys]
    points = study.combinations("method", "r_velocity_m_per_s")
    for point in points if drawn and study.has("filter") else ():
        sections = METHODS[point["method"]].sections
        follows = "filter" in sections and "surge" not in sections
        if point["r_velocity_m_per_s"] is None and follows:
            text = f"required ({drawn[0]} is drawn, but the filter has the same R in all draws)"
            study.refuse("r_velocity_m_per_s", text)


NOISE_RULES: tuple[Callable[[Study], None], ...] = (
    _check_q_unit,
    *(partial(_check_q_is_determined, noise) for noise in _NOISES),
    _check_r_needs_no_drawn_surge,
)
"""The rules of Q and R."""

"""Q and R of a filter: by their keys, or by the white noise of the sensors and the surge."""

import numpy as np

from sinsjax.errors import ErrorCollector
from sinsjax.methods.filters.keys import (
    ACCEL_NOISE,
    GYRO_NOISE,
    ProcessNoise,
    q_unit_factors,
    surge_density,
)
from sinsjax.methods.registry import METHODS
from sinsjax.study.keys import reading_methods
from sinsjax.study.study import Study
from sinsjax.value_types import keys_of

_NOISES = (ACCEL_NOISE, GYRO_NOISE)


def check_filter_noise(study: Study) -> None:
    """Refuse a Q without its unit, a unit without Q, and a study that determines no Q or R.

    Raises:
        InputError: ``[section] key: what is wrong (hint)``.
    """
    errors, checks = ErrorCollector(), (_check_q_unit, _check_missing_q, _check_missing_r)
    for check in checks if study.has("filter") else ():
        with errors.collect():
            check(study)
    errors.raise_all()


def noise_ratios_by_sensor(study: Study) -> dict[str, set[float]]:
    """Return the ratios of the noise in Q to that of the sensors, as standard deviations.

    Args:
        study: checked study with simulated sensors.

    Returns:
        The distinct ratios over all variants, for ``accelerometers`` and ``gyros``; empty without a
        filter, and without white noise that all draws have.
    """
    readings, ratios = q_unit_factors(1 / study.rate_hz), {n.sensors: set[float]() for n in _NOISES}
    for noise in _NOISES if study.has("filter") else ():
        forms, sensor_keys = noise.forms, noise.white
        for point in study.combinations("method", "q_reading", "q_scale", *forms, *sensor_keys):
            white = noise.density(study.rate_hz, *(point[key] for key in sensor_keys))
            if not white or point["method"] not in reading_methods(noise.key):
                continue
            given = [point[key] * factor for key, factor in forms.items() if point[key] is not None]
            scale = 1.0 if point["q_scale"] is None else point["q_scale"]
            if given:
                scale *= readings[point["q_reading"]] * study.rate_hz
            ratios[noise.sensors].add((given[0] if given else white) / white * scale**0.5)
    return ratios


def _takes_surge_for_noise(method: str) -> bool:
    """Return whether a method is a filter without states for the surge."""
    sections = METHODS[method].sections
    return "filter" in sections and "surge" not in sections


def _check_q_unit(study: Study) -> None:
    keys = [key for noise in _NOISES for key in noise.forms]
    forms = [key for key in keys if study.gives(key)]
    given = [noise.key for noise in _NOISES if noise.key in forms]
    densities = [key for key in forms if key not in given]
    points = list(study.combinations("q_reading", *keys))
    units = {point["q_reading"] for point in points}
    has_none = [
        p for p in points if p["q_reading"] is None and any(p[key] is not None for key in keys)
    ]
    if has_none:
        reason = "give 'psd', the only one for a density"
        if not densities:
            reason = "give 'psd', 'per_sample' or 'per_step', which was the default before"
        names = " and ".join([*given, *densities])
        study.refuse("q_reading", f"required with {names} ({reason})")
    if densities and (others := units - {"psd", None}):
        study.refuse(densities[0], f"requires q_reading = 'psd', not '{min(others)}'")
    if not given and (others := units - {"psd", None}):
        reason = "drop it: without q_ keys Q is the white noise of the study's sensors"
        text = f"'{min(others)}' needs q_ keys, and none is given ({reason})"
        study.refuse("q_reading", text)


def _check_missing_q(study: Study) -> None:
    errors = ErrorCollector()
    for noise in _NOISES:
        if reason := _missing_noise_reason(study, noise):
            hint = f"give {[*noise.forms][-1]} from the data sheet, with q_reading = 'psd'"
            with errors.collect():
                study.refuse(noise.key, f"required ({reason}; {hint})")
    errors.raise_all()


def _missing_noise_reason(study: Study, noise: ProcessNoise) -> str | None:
    """Return the reason why the sensors do not determine Q, as text; None if they do."""
    sensor_keys = () if study.is_recorded else noise.white
    for point in study.combinations("method", *noise.forms, *sensor_keys):
        given = any(point[key] is not None for key in noise.forms)
        if given or point["method"] not in reading_methods(noise.key):
            continue
        if study.is_recorded:
            return f"a record does not give the noise of its {noise.sensors}"
        for key in sensor_keys:
            if key in study.drawn_keys:
                return f"{key} is drawn, but the filter has the same Q in all draws"
        if not noise.density(1.0, *(point[key] for key in sensor_keys)):
            return f"the {noise.sensors} have no white noise in [sensors]"
    return None


def _check_missing_r(study: Study) -> None:
    """Refuse an omitted R that would follow a surge that draws vary."""
    surge_keys = keys_of(surge_density)
    drawn = [key for key in surge_keys if key in study.drawn_keys]
    if not drawn or study.is_recorded:
        return
    for point in study.combinations("method", "r_velocity_m_per_s", *surge_keys):
        is_still = point["surge_m_per_s"] is not None and not np.any(point["surge_m_per_s"])
        follows = point["r_velocity_m_per_s"] is None and _takes_surge_for_noise(point["method"])
        if follows and not is_still:
            text = f"required ({drawn[0]} is drawn, but the filter has the same R in all draws)"
            study.refuse("r_velocity_m_per_s", text)

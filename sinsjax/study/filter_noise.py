"""Q and R of a filter: by their keys, or by the white noise of the sensors and the surge."""

from collections.abc import Iterator, Mapping

import numpy as np

from sinsjax.errors import InputError
from sinsjax.methods.filters.keys import (
    ACCEL_NOISE,
    GYRO_NOISE,
    ProcessNoise,
    q_unit_factors,
    surge_density,
    update_variance,
)
from sinsjax.methods.registry import METHODS
from sinsjax.study.keys import reading_methods
from sinsjax.study.study import Study
from sinsjax.value_types import keys_of

_NOISES = (ACCEL_NOISE, GYRO_NOISE)


def check_filter_noise(study: Study, key_tables: Mapping[str, str]) -> None:
    """Refuse a Q without its unit, a unit without Q, and a study that determines no Q or R.

    Args:
        study: checked study.
        key_tables: the table, in brackets, of each key that the file gives.

    Raises:
        InputError: ``[section] key: what is wrong (hint)``.
    """
    if study.has("filter"):
        errors = [
            *_iter_q_unit_errors(study, key_tables),
            *_iter_missing_q_errors(study, key_tables),
            *_iter_missing_r_errors(study, key_tables),
        ]
        if errors:
            raise InputError(
                *(f"{key_tables.get(key, '[filter]')} {key}: {text}" for key, text in errors)
            )


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
        forms, sensor_keys = noise.forms, keys_of(noise.density)
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


def surge_noise_ratios(study: Study) -> set[float]:
    """Return the ratios of R to the density of the surge, as variances.

    Args:
        study: checked study.

    Returns:
        The distinct ratios over all variants with a surge that all draws have and a filter that
        takes it for measurement noise; empty for a record.
    """
    ratios: set[float] = set()
    if not study.has("filter") or study.is_recorded:
        return ratios
    keys = keys_of(update_variance)
    for point in study.combinations("method", *keys):
        density = surge_density(*(point[key] for key in keys_of(surge_density)))
        if density and _takes_surge_for_noise(point["method"]):
            r = update_variance(study.rate_hz, *(point[key] for key in keys))
            ratios.add(r / study.rate_hz / density)
    return ratios


def _takes_surge_for_noise(method: str) -> bool:
    """Return whether a method is a filter without states for the surge."""
    sections = METHODS[method].sections
    return "filter" in sections and "surge" not in sections


def _iter_q_unit_errors(study: Study, key_tables: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    forms = [key for noise in _NOISES for key in noise.forms if key in key_tables]
    given = [noise.key for noise in _NOISES if noise.key in forms]
    densities = [key for key in forms if key not in given]
    readings = {point["q_reading"] for point in study.combinations("q_reading")}
    if forms and "q_reading" not in key_tables:
        reason = "give 'psd', the only one for a density"
        if not densities:
            reason = "give 'psd', 'per_sample' or 'per_step', which was the default before"
        yield "q_reading", f"required with {' and '.join([*given, *densities])} ({reason})"
    elif densities and (other_units := readings - {"psd"}):
        yield densities[0], f"requires q_reading = 'psd', not '{min(other_units)}'"
    elif not given and (other_units := readings - {"psd", None}):
        reason = "drop it: without q_ keys Q is the white noise of the study's sensors"
        yield "q_reading", f"'{min(other_units)}' needs q_ keys, and none is given ({reason})"


def _iter_missing_q_errors(
    study: Study, key_tables: Mapping[str, str]
) -> Iterator[tuple[str, str]]:
    for noise in _NOISES:
        if key_tables.keys().isdisjoint(noise.forms):
            if reason := _missing_noise_reason(study, noise):
                hint = f"give {[*noise.forms][-1]} from the data sheet, with q_reading = 'psd'"
                yield noise.key, f"required ({reason}; {hint})"


def _missing_noise_reason(study: Study, noise: ProcessNoise) -> str | None:
    """Return the reason why the sensors do not determine Q, as text; None if they do."""
    reading, sensor_keys = reading_methods(noise.key), keys_of(noise.density)
    if study.is_recorded:
        if {*study.methods}.isdisjoint(reading):
            return None
        return f"a record does not give the noise of its {noise.sensors}"
    for point in study.combinations("method", *sensor_keys):
        if point["method"] not in reading:
            continue
        for key in sensor_keys:
            if key in study.drawn_keys:
                return f"{key} is drawn, but the filter has the same Q in all draws"
        if not noise.density(1.0, *(point[key] for key in sensor_keys)):
            return f"the {noise.sensors} have no white noise in [sensors]"
    return None


def _iter_missing_r_errors(
    study: Study, key_tables: Mapping[str, str]
) -> Iterator[tuple[str, str]]:
    """Yield the error of an omitted R that would follow a surge that draws vary."""
    surge_keys = keys_of(surge_density)
    drawn = [key for key in surge_keys if key in study.drawn_keys]
    if not drawn or study.is_recorded or "r_velocity_m_per_s" in key_tables:
        return
    for point in study.combinations("method", *surge_keys):
        is_still = point["surge_m_per_s"] is not None and not np.any(point["surge_m_per_s"])
        if not is_still and _takes_surge_for_noise(point["method"]):
            text = f"required ({drawn[0]} is drawn, but the filter has the same R in all draws)"
            yield "r_velocity_m_per_s", text
            return

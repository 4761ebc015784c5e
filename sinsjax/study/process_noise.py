"""Q: its keys are given with q_reading, or it is the white noise of the sensors."""

from collections.abc import Iterator, Mapping

from sinsjax.errors import InputError
from sinsjax.methods.filters.keys import ACCEL_NOISE, GYRO_NOISE, ProcessNoise, q_unit_factors
from sinsjax.study.keys import reading_methods
from sinsjax.study.study import Study
from sinsjax.value_types import keys_of

_NOISES = (ACCEL_NOISE, GYRO_NOISE)


def check_process_noise(study: Study, key_tables: Mapping[str, str]) -> None:
    """Refuse a Q without its unit, a unit without Q, and a study that does not determine Q.

    Args:
        study: checked study.
        key_tables: the table, in brackets, of each key that the file gives.

    Raises:
        InputError: ``[section] key: what is wrong (hint)``.
    """
    if not study.has("filter"):
        return
    errors = [*_iter_q_unit_errors(study, key_tables), *_iter_missing_q_errors(study, key_tables)]
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
    return {noise.sensors: _noise_ratios(study, noise) for noise in _NOISES}


def _noise_ratios(study: Study, noise: ProcessNoise) -> set[float]:
    forms, reading, sensor_keys = noise.forms, reading_methods(noise.key), keys_of(noise.density)
    readings = q_unit_factors(1 / study.rate_hz)
    ratios: set[float] = set()
    if not study.has("filter"):
        return ratios
    for point in study.combinations("method", "q_reading", "q_scale", *forms, *sensor_keys):
        white = noise.density(study.rate_hz, *(point[key] for key in sensor_keys))
        given = [point[form] * factor for form, factor in forms.items() if point[form] is not None]
        if point["method"] in reading and white:
            scale = 1.0 if point["q_scale"] is None else point["q_scale"]
            if given:
                scale *= readings[point["q_reading"]] * study.rate_hz
            ratios.add((given[0] if given else white) / white * scale**0.5)
    return ratios


def _iter_q_unit_errors(study: Study, key_tables: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    forms = [key for noise in _NOISES for key in noise.forms if key in key_tables]
    given = [noise.key for noise in _NOISES if noise.key in forms]
    densities = [key for key in forms if key not in given]
    readings = {point["q_reading"] for point in study.combinations("q_reading")}
    if (given or densities) and "q_reading" not in key_tables:
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
        if not any(method in reading for method in study.methods):
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

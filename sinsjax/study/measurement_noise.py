"""R: its key is given, or it follows the surge of the base."""

from collections.abc import Mapping

import numpy as np

from sinsjax.errors import InputError
from sinsjax.methods.filters.keys import surge_density, update_variance
from sinsjax.methods.registry import METHODS
from sinsjax.study.study import Study
from sinsjax.value_types import keys_of


def check_measurement_noise(study: Study, key_tables: Mapping[str, str]) -> None:
    """Refuse an omitted R that would follow a surge that draws vary.

    Args:
        study: checked study.
        key_tables: the table, in brackets, of each key that the file gives.

    Raises:
        InputError: ``[section] key: what is wrong (hint)``.
    """
    if not study.has("filter") or study.is_recorded or "r_velocity_m_per_s" in key_tables:
        return
    surge_keys = keys_of(surge_density)
    for point in study.combinations("method", *surge_keys):
        drawn = [key for key in surge_keys if key in study.drawn_keys]
        is_still = point["surge_m_per_s"] is not None and not np.any(point["surge_m_per_s"])
        if drawn and not is_still and _takes_surge_for_noise(point["method"]):
            text = f"required ({drawn[0]} is drawn, but the filter has the same R in all draws)"
            raise InputError(f"[filter] r_velocity_m_per_s: {text}")


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


def update_variance_keys(study: Study) -> tuple[str, ...]:
    """Return the keys of `update_variance` that a study has, in its order."""
    return tuple(key for key in keys_of(update_variance) if study.is_readable(key))


def _takes_surge_for_noise(method: str) -> bool:
    """Return whether a method is a filter without states for the surge."""
    sections = METHODS[method].sections
    return "filter" in sections and "surge" not in sections

"""R: its key is given, or it follows the surge of the base."""

from collections.abc import Mapping

import numpy as np

from sinsjax.errors import InputError
from sinsjax.methods.filters.section import OF_R, OF_SURGE, surge_density, update_variance
from sinsjax.methods.registry import METHODS
from sinsjax.study.study import Study


def check_measurement_noise(study: Study, key_tables: Mapping[str, str]) -> None:
    """Refuse an omitted R that would follow a surge that draws vary.

    Args:
        study: checked study.
        key_tables: the table, in brackets, of each key that the file gives.

    Raises:
        InputError: ``[section] key: what is wrong (hint)``.
    """
    if not study.has("filter") or study.is_recorded or OF_R[0] in key_tables:
        return
    for point in study.combinations("method", *OF_SURGE):
        drawn = [key for key in OF_SURGE if key in study.drawn_keys]
        is_still = point["surge_m_per_s"] is not None and not np.any(point["surge_m_per_s"])
        if drawn and not is_still and _takes_surge_for_noise(point["method"]):
            text = f"required ({drawn[0]} is drawn, but the filter has the same R in all draws)"
            raise InputError(f"[filter] {OF_R[0]}: {text}")


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
    keys = (*OF_R, *OF_SURGE)
    for point in study.combinations("method", *keys):
        density = surge_density(*(point[key] for key in OF_SURGE))
        if density and _takes_surge_for_noise(point["method"]):
            r = update_variance(study.rate_hz, *(point[key] for key in keys))
            ratios.add(r / study.rate_hz / density)
    return ratios


def update_variance_keys(study: Study) -> tuple[str, ...]:
    """Return the keys of `update_variance` that a study has, in its order."""
    return OF_R if study.is_recorded else (*OF_R, *OF_SURGE)


def _takes_surge_for_noise(method: str) -> bool:
    """Return whether a method is a filter without states for the surge."""
    sections = METHODS[method].sections
    return "filter" in sections and "surge" not in sections

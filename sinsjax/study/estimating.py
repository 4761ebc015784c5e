"""What a study estimates without draws, and what keeps it from that."""

from collections.abc import Mapping
from typing import NoReturn

import numpy as np

from sinsjax.alignment.methods import METHODS
from sinsjax.errors import InputError
from sinsjax.study.keys import SECTION_OF
from sinsjax.study.study import Study

_SECTIONS = {
    "record": "the noise of recorded data is not known",
    "passes": "repeated passes use the same noise again",
    "drawn": "what is drawn differs between draws, of which there are none",
    "stop_when": "there are no draws to stop",
    "tune": "searches compare draws",
}
_COLOURED = "its noise is not white"
_KEYS = {
    **{f"vibration_{kind}_rms": _COLOURED for kind in ("ug", "deg_per_h")},
    "surge_m_per_s": _COLOURED,
    **{
        f"{kind}_quantisation_{u}": "quanta are no noise"
        for kind, u in (("gyro", "arcsec"), ("accel", "um_per_s"))
    },
    **{
        key: _COLOURED
        for key in (
            "gyro_instability_deg_per_h",
            "gyro_rrw_deg_per_h_per_sqrt_h",
            "accel_instability_ug",
            "accel_rrw_ug_per_sqrt_h",
        )
    },
}
"""What the covariance of the true error does not hold, and why."""


def check(study: Study, where: Mapping[str, str]) -> None:
    """Refuses what the covariance of the true error does not hold, in any variant.

    Args:
        study: checked study.
        where: the table, in brackets, of every key that the file gives.

    Raises:
        InputError: ``[section] key: what is wrong (hint)``.
    """
    if not study.is_estimated:
        if study.study.estimate_samples is not None:
            raise InputError("[study] estimate_samples: requires estimate = 'covariance'")
        return
    for section, why in _SECTIONS.items():
        if study.has(section):
            _refuse(f"[{section}]", why)
    if study.coarse_stages:
        _refuse("[coarse]", "its methods do not tell their linear part")
    if "draws" in where:
        text = "is not read beside estimate = 'covariance' (estimate_samples is)"
        raise InputError(f"[study] draws: {text}")
    if study.study.curves:
        _refuse("[study] curves", "there are no runs whose curves could be kept")
    for key, why in _KEYS.items():
        if any(np.any(point[key]) for point in study.combinations(key)):
            _refuse(f"{where.get(key, f'[{SECTION_OF[key]}]')} {key}", why)
    for name in study.methods:
        if not METHODS[name].has_error_step:
            place = where.get("method", "[alignment]")
            _refuse(f"{place} method", f"'{name}' does not tell its linear part")
    triggers = study.combinations("reset_trigger") if study.has("resets") else ()
    if any(point["reset_trigger"] not in (None, "none") for point in triggers):
        place = where.get("reset_trigger", "[resets]")
        _refuse(f"{place} reset_trigger", "triggered resets move with the noise")


def _refuse(place: str, why: str) -> NoReturn:
    raise InputError(f"{place}: does not go with estimate = 'covariance': {why}")

"""The methods in the inertial frame as studies know them; they have no keys."""

from functools import partial

from sinsjax.methods.description import (
    COMMON_KEYS,
    INITIAL_KEYS,
    CheckedStudy,
    Description,
    Implementation,
)


def _load(build: str) -> Implementation:
    from sinsjax.methods.inertial_frame import method

    # These methods have no params.
    return Implementation(getattr(method, build), lambda columns, site, ug: ())


_NAMES = ("optimisation", "optimisation_position", "inertial")


def check_passes(study: CheckedStudy) -> None:
    """Refuse repeated passes, which add no information."""
    if not study.has("passes"):
        return
    for point in study.combinations("method", "stored_s"):
        if point["method"] in _NAMES and point["stored_s"] is not None:
            text = (
                f"does not apply to method {point['method']}, which reads a record once (drop it)"
            )
            study.refuse("stored_s", text)


def check_coarse(study: CheckedStudy) -> None:
    """Refuse coarse alignment before a method that needs no initial attitude."""
    if study.is_recorded or not study.has("coarse"):
        return
    for point in study.combinations("method", "coarse_method"):
        if point["method"] in _NAMES and point["coarse_method"] != "none":
            text = f"method {point['method']} needs no coarse alignment (give 'none')"
            study.refuse("coarse_method", text)


_describe = partial(
    Description,
    sections={},
    reads=INITIAL_KEYS,
    without_effect=(*INITIAL_KEYS, *COMMON_KEYS),
    refuses=("coarse_method", "coarse_duration_s", "coarse_then"),
    has_covariance=False,
    rules=(check_passes, check_coarse),
)

OPTIMISATION = _describe(
    name="optimisation",
    summary="attitude that takes all integrated velocities closest to gravity's in inertial space",
    source="Wu et al. (2011), Wu and Pan (2013)",
    load=partial(_load, "build_optimisation"),
    has_error_model=True,
    step_s=3e-9,
    estimate_runs=12.0,
)

OPTIMISATION_POSITION = _describe(
    name="optimisation_position",
    summary="the same of integrated positions, from an unknown velocity: for a base that surges",
    source="`methods.inertial_frame.least_squares`",
    load=partial(_load, "build_optimisation_position"),
    step_s=4e-9,
)

INERTIAL = _describe(
    name="inertial",
    summary="attitude from two weighted means of the specific force, as coarse alignment does",
    source="weighted TRIAD, see methods.coarse",
    load=partial(_load, "build_inertial"),
    step_s=5e-9,
)

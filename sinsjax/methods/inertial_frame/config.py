"""The methods in the inertial frame as studies know them; they have no keys."""

from functools import partial

from sinsjax.methods.description import Implementation
from sinsjax.methods.without_start import describe_without_start


def _load(build: str) -> Implementation:
    from sinsjax.methods.inertial_frame import method

    # These methods have no params.
    return Implementation(getattr(method, build), lambda columns, site, ug: ())


_describe = partial(describe_without_start, sections={}, turning="many", has_covariance=False)

OPTIMISATION = _describe(
    name="optimisation",
    summary="attitude that takes all integrated velocities closest to gravity's in inertial space",
    source="Wu et al. (2011), Wu and Pan (2013)",
    load=partial(_load, "build_optimisation"),
    step_s=3e-9,
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

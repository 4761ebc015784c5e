"""The methods in the inertial frame as studies know them; they have no keys."""

from functools import partial

from sinsjax.methods.inertial_frame.method import (
    build_inertial,
    build_optimisation,
    build_optimisation_position,
)
from sinsjax.methods.method import Method

_describe = partial(Method, needs_start=False, turning="many")

OPTIMISATION = _describe(
    name="optimisation",
    summary="attitude that takes all integrated velocities closest to gravity's in inertial space",
    source="Wu et al. (2011), Wu and Pan (2013)",
    build=build_optimisation,
    step_s=3e-9,
)

OPTIMISATION_POSITION = _describe(
    name="optimisation_position",
    summary="the same of integrated positions, from an unknown velocity: for a base that surges",
    source="`methods.inertial_frame.least_squares`",
    build=build_optimisation_position,
    step_s=4e-9,
)

INERTIAL = _describe(
    name="inertial",
    summary="attitude from two weighted means of the specific force, as coarse alignment does",
    source="weighted TRIAD, see methods.coarse",
    build=build_inertial,
    step_s=5e-9,
)

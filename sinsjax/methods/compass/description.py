"""Compass alignment, as studies know it."""

from sinsjax.methods.compass.section import CompassSection, check_pieces
from sinsjax.methods.description import INITIAL_KEYS, Description, Implementation


def _load() -> Implementation:
    from sinsjax.methods.compass.method import build
    from sinsjax.methods.compass.parameters import check, parameters
    from sinsjax.methods.compass.relaxed import RELAXED

    return Implementation(build, parameters, check, RELAXED)


COMPASS = Description(
    name="compass",
    summary="gyrocompass loops: levelling of third order, azimuth of fourth",
    source="[P2] section 2.1",
    sections={"compass": CompassSection},
    reads=(*INITIAL_KEYS, "turn", "turn_smoothing_s"),
    load=_load,
    has_covariance=False,
    has_error_step=True,
    rules=(check_pieces,),
    step_s=5e-9,
    estimate_runs=7.5,
)

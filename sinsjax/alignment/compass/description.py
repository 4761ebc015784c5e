"""Compass alignment, as studies know it."""

from sinsjax.alignment.compass.section import CompassSection, check_pieces
from sinsjax.alignment.description import INITIAL_KEYS, Description, Implementation


def _load() -> Implementation:
    from sinsjax.alignment.compass.method import build
    from sinsjax.alignment.compass.parameters import check, parameters
    from sinsjax.alignment.compass.relaxed import RELAXED

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

"""The filters with a large azimuth, as studies know them."""

from functools import partial

from sinsjax.methods.azimuth.section import AzimuthSection
from sinsjax.methods.description import Implementation
from sinsjax.methods.filters.description import filter_description
from sinsjax.methods.filters.section import FilterSection, ResetsSection
from sinsjax.value_types import Section


def _load(name: str) -> Implementation:
    from sinsjax.methods.azimuth import prediction
    from sinsjax.methods.azimuth.method import build
    from sinsjax.methods.azimuth.model import STATES
    from sinsjax.methods.azimuth.parameters import parameters
    from sinsjax.methods.filters.relaxed import relaxed

    return Implementation(
        partial(build, getattr(prediction, name)),
        parameters,
        relaxed=relaxed(STATES),
    )


_SECTIONS: dict[str, type[Section]] = {
    "filter": FilterSection,
    "resets": ResetsSection,
    "azimuth": AzimuthSection,
}

EKF_AZIMUTH = filter_description(
    name="ekf_azimuth",
    summary="extended Kalman filter, its model nonlinear in the azimuth",
    source="after Yan, Strapdown Inertial Navigation, eq. (4-23)",
    sections=_SECTIONS,
    load=partial(_load, "linearised"),
    step_s=25e-9,
)

UNSCENTED = filter_description(
    name="unscented",
    summary="the same model with an unscented transform",
    source="Julier (2002); Wan and van der Merwe (2000)",
    sections=_SECTIONS,
    load=partial(_load, "unscented"),
    step_s=60e-9,
)

"""[compass]: the loops of method 'compass', and when their gains change."""

from typing import Annotated, Literal

from pydantic import Field

from sinsjax.value_types import (
    Bandwidth,
    Count,
    Damping,
    Factors,
    Finite,
    PassNumbers,
    Seconds,
    SecondsOrZero,
    Section,
    Times,
    Usual,
)

_DAMPING = 0.5**0.5


class CompassSection(Section):
    """[compass]: the loops of method 'compass', and when their gains change."""

    level_sigma_per_s: Bandwidth | None = Field(
        None, description="sigma of the levelling loop, 1/s; default 0.02"
    )
    level_adjustment_s: Seconds | None = Field(
        None, description="adjustment time of the levelling loop instead of its sigma, s"
    )
    level_gains: Annotated[tuple[Finite, Finite, Finite], Usual(-1e11, 1e11)] | None = Field(
        None, description="K1, K2, K3 of the levelling loop instead of its sigma, SI"
    )
    level_damping: Damping = Field(_DAMPING, description="damping ratio of the levelling loop")
    level_time_s: SecondsOrZero | None = Field(
        None, description="levelling before the azimuth loop begins, s; default 150"
    )
    level_passes: Annotated[Count, Field(ge=1)] | None = Field(
        None, description="the same in passes over the tape"
    )
    azimuth_sigma_per_s: Bandwidth | None = Field(
        None, description="sigma of the azimuth loop, 1/s; default 0.01"
    )
    azimuth_adjustment_s: Seconds | None = Field(
        None, description="adjustment time of the azimuth loop instead of its sigma, s"
    )
    azimuth_gains: Annotated[tuple[Finite, Finite, Finite, Finite], Usual(-1e11, 1e11)] | None = (
        Field(None, description="K1 to K4 of the azimuth loop instead of its sigma, SI")
    )
    azimuth_damping: Damping = Field(_DAMPING, description="damping ratio of the azimuth loop")
    adjustment_reading: Literal["period", "settling"] = Field(
        "period", description="reading of adjustment times: the damped period, or exp(-sigma T)"
    )
    adjustment_remainder: Annotated[float, Field(gt=0, lt=1)] = Field(
        0.05, description="what is left after an adjustment time, for reading 'settling'"
    )
    sigma_factors: Factors = Field(
        (1.0,), description="sigma of the azimuth loop, piece by piece, as factors on it"
    )
    sigma_times_s: Times | None = Field(
        None, description="update times at which the second and later pieces begin, s"
    )
    sigma_passes: PassNumbers | None = Field(
        None, description="the same as numbers of passes gone over before"
    )
    allow_unstable: bool = Field(False, description="whether unstable loops are run")

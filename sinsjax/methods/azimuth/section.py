"""[azimuth]: keys of the filters whose model is nonlinear in the azimuth."""

from typing import Literal

from pydantic import Field

from sinsjax.value_types import Section


class AzimuthSection(Section):
    """[azimuth]: feedback of the filters whose model is nonlinear in the azimuth."""

    azimuth_feedback: Literal["vector", "angles"] = Field(
        "vector",
        description="form in which the estimated attitude error is fed back. 'vector': rotation"
        " by the azimuth error and the shortest rotation of the vertical. 'angles': rotation by"
        " three small angles",
    )

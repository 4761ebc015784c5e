"""[azimuth]: the filters whose model is nonlinear in the azimuth."""

from typing import Literal

from pydantic import Field

from sinsjax.value_types import Section


class AzimuthSection(Section):
    """[azimuth]: how filters with a large azimuth feed their estimate back."""

    azimuth_feedback: Literal["vector", "angles"] = Field(
        "vector",
        description="attitude is fed back as azimuth and turn of the vertical, or as small angles",
    )

"""[azimuth]: the filters whose model is nonlinear in the azimuth."""

from typing import Annotated, Literal

from pydantic import Field

from sinsjax.value_types import Section


class AzimuthSection(Section):
    """[azimuth]: how filters with a large azimuth feed their estimate back."""

    azimuth_feedback: Literal["vector", "angles"] = Field(
        "vector",
        description="attitude is fed back as azimuth and turn of the vertical, or as small angles",
    )


class UnscentedSection(Section):
    """[unscented]: the sigma points of the unscented filter."""

    sigma_point_alpha: Annotated[float, Field(gt=0, le=1)] = Field(
        0.5, description="spread of the sigma points: alpha sqrt(5) standard deviations"
    )

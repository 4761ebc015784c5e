"""The sections of draws: [drawn], the keys that differ from draw to draw, and [stop_when].

Which keys may be drawn stands here; the numbers themselves are made in `sampling`.
"""

from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import ConfigDict, Field

from sinsjax.study.schema import MotionSection, SensorsSection
from sinsjax.value_types import IncreasingPair, Name, Normal, Positive, Section

INITIAL_KEYS = ("phi_e0_deg", "phi_n0_deg", "phi_u0_deg", "ve0_m_per_s", "vn0_m_per_s")
"""The keys of [alignment] that may be drawn; in a recorded study no others may."""

BIASES = ("gyro_bias_deg_per_h", "accel_bias_ug")
"""The keys of the constant sensor biases."""


def _length(annotation: Any) -> int:
    """The longest list that a type takes, 1 if it takes none; 0 of what is no number."""
    if annotation is str or get_origin(annotation) is Literal:
        return 0
    if get_origin(annotation) is tuple:
        return len(get_args(annotation))
    return max(map(_length, get_args(annotation)), default=1)


NUMBERS_DRAWN = {
    "latitude_deg": 1,
    **{
        key: numbers
        for section in (MotionSection, SensorsSection)
        for key, field in section.model_fields.items()
        if (numbers := _length(field.annotation))
    },
    **dict.fromkeys(INITIAL_KEYS, 1),
}
"""Every key that may be drawn and its numbers a draw: one, or one for each axis of a vector."""

ListEntries = Annotated[tuple[Any, ...], Field(min_length=1)]


class Distribution(Section):
    """How the values of a key are drawn; exactly one of the fields is given.

    The entries of a list are values of the key: for a vector one number or one for each axis.
    """

    uniform: IncreasingPair | None = Field(None, description="evenly between [low, high]")
    normal: Normal | None = Field(None, description="normally, with [mean, standard deviation]")
    values: ListEntries | None = Field(None, description="one entry a draw, from the first again")
    grid: ListEntries | None = Field(
        None, description="one point a draw of the product of all grids, the last key fastest"
    )


def is_normal(key: str, law: Distribution) -> bool:
    """Whether a key adds normal numbers to what runs begin with, or to constant biases."""
    return law.normal is not None and key in (*INITIAL_KEYS, *BIASES)


class DrawnSection(Section):
    """[drawn]: one value a draw, common to all variants of the draw."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Distribution] = Field(init=False)

    sampling: Literal["random", "sobol"] = Field(
        "random", description="uniform and normal numbers: independent, or scrambled Sobol points"
    )

    @property
    def laws(self) -> dict[str, Distribution]:
        """How every drawn key is drawn, in the order written."""
        return self.__pydantic_extra__


class StopWhenSection(Section):
    """[stop_when]: drawing goes on until a statistic is known well in every variant."""

    statistic: Name = Field(
        description="'success_rate', or the mean settling time 'settle_B_s_mean' of a band of B',"
        " from the truth or the bias floor as judged_from says"
    )
    half_width: Positive = Field(
        description="of its 95 % interval in the variant where it is widest: a share, or s"
    )

"""The section of tuning: [tune], what is tuned by which searches, and the ranges of its variables.

What stands in [tune.variables] and [tune.baseline] is read in `search_space`.
"""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from sinsjax.study.distributions import ListEntries
from sinsjax.value_types import Band, Count, Finite, Positive, Seconds, Section, invalid, unique

Some = Annotated[Count, Field(ge=1)]
Searches = Annotated[
    tuple[Literal["grid", "sobol", "random", "gradient", "covariance"], ...],
    Field(min_length=1),
    AfterValidator(unique),
]


class Range(Section):
    """What a variable may be: between two ends, or one value, or one of some.

    Exactly one of these is given; ``scale`` requires low and high.
    """

    low: Finite | None = Field(None, description="least value")
    high: Finite | None = Field(None, description="greatest value")
    scale: Literal["linear", "log"] | None = Field(
        None, description="how it is gone through from low to high; default 'linear'"
    )
    fixed: Any = Field(None, description="the one value, which is not searched")
    candidates: ListEntries | None = Field(None, description="values that are tried one by one")

    @model_validator(mode="after")
    def _one_of_three(self) -> "Range":
        names = ("low", "high", "fixed", "candidates")
        given = [name for name in names if getattr(self, name) is not None]
        if given not in (["low", "high"], ["fixed"], ["candidates"]):
            told = " and ".join(given) or "none"
            raise invalid(f"needs low and high, or fixed, or candidates, not {told}")
        if self.low is None or self.high is None:
            if self.scale is not None:
                raise invalid("requires low and high", key="scale")
            return self
        if not self.low < self.high:
            raise invalid(f"must be above low = {self.low:.12g}, not {self.high:.12g}", key="high")
        if self.scale == "log" and self.low <= 0:
            raise invalid(f"'log' needs low > 0, not {self.low:.12g}", key="scale")
        return self

    @property
    def is_free(self) -> bool:
        """Whether it has two ends to search between."""
        return self.low is not None


class TuneSection(Section):
    """[tune]: an objective, the variables that it is tuned by, and how they are searched."""

    objective: Literal["settle_mean", "settle_quantile", "final_error", "failure_rate"] = Field(
        "settle_mean", description="what is made as small as it can be"
    )
    objective_band_arcmin: Band = Field(
        10.0, description="band of settling times and failures, arcmin; one of the study's"
    )
    objective_quantile: Annotated[float, Field(gt=0, lt=1)] = Field(
        0.9, description="of the settling time, for 'settle_quantile'"
    )
    objective_across: Literal["mean", "worst"] = Field(
        "mean", description="what of the objectives of all variants"
    )
    searches: Searches = Field(("grid", "gradient"), description="searches, in this order")
    tune_draws: Some | None = Field(
        None,
        description="draws that tune; default 16. In a recorded study every other start time does",
    )
    evaluation_draws: Some | None = Field(
        None, description="draws that judge what was found; default 64. Recorded: the other starts"
    )
    grid_points: Annotated[Count, Field(ge=2)] = Field(
        15, description="points a variable of a grid, of up to two variables"
    )
    sobol_points: Some = Field(256, description="points of a Sobol search")
    random_points: Some = Field(256, description="points of a random search")
    descent_screen: Some = Field(
        16,
        description="points looked at first, on `descent_draws` draws or by covariance analysis;"
        " the best are begun at",
    )
    descent_starts: Some = Field(4, description="descents side by side")
    descent_steps: Some = Field(16, description="steps of a descent")
    descent_draws: Some = Field(
        4,
        description="draws a step and descent, in turn; none where all variables leave resets where"
        " they are and covariance analysis holds, which then stands for draws",
    )
    descent_rate: Positive = Field(0.1, description="rate of Adam, all ranges being one long")
    relaxed_window_s: tuple[Seconds, Seconds] = Field(
        (4.0, 1.0),
        description="half width of relaxed resets at the first and last step, s; only where a"
        " variable moves resets",
    )
    relaxed_sharpness: tuple[Positive, Positive] = Field(
        (6.0, 16.0), description="sharpness of the band's relaxed edge at the first and last step"
    )
    evolution_screen: Some = Field(
        64, description="Sobol points looked at first by 'covariance'; the best is begun at"
    )
    evolution_points: Annotated[Count, Field(ge=4)] = Field(
        8, description="points of a generation of the evolution strategy"
    )
    evolution_steps: Some = Field(12, description="generations")
    evolution_spread: Positive = Field(
        0.2, description="standard deviation of the first generation, all ranges being one long"
    )
    evolution_samples: Annotated[Count, Field(ge=2, multiple_of=2)] = Field(
        64,
        description="errors sampled for a point and variant by covariance analysis, in 'covariance'"
        " and 'gradient'",
    )
    evolution_finalists: Some = Field(3, description="best points run on the tuning draws")
    feedback_phases: Some = Field(
        4,
        description="shifts of the reset times within a feedback interval that 'covariance' "
        "averages over; 1 leaves them as they are",
    )
    variables: dict[str, Range | tuple[Range, ...]] = Field(
        description="what may change: [tune.variables] with a range a key"
    )
    baseline: dict[str, Any] = Field(
        default={}, description="what to stand beside; default: the study's own values"
    )

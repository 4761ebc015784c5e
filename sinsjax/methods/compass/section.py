"""[compass]: levelling and azimuth loops of method 'compass', and the times of their gains."""

from typing import Annotated, Literal

from pydantic import Field

from sinsjax.methods.description import CheckedStudy
from sinsjax.value_types import (
    Bandwidth,
    Count,
    Damping,
    Factors,
    Finite,
    KeyCondition,
    KeyInfo,
    PassNumbers,
    Seconds,
    SecondsOrZero,
    Section,
    Times,
)

_DAMPING = 0.5**0.5
_ADJUSTMENTS = ("level_adjustment_s", "azimuth_adjustment_s")


def _are_designed(gains: tuple[float, ...] | None) -> bool:
    return gains is None


def _any_given(*times_s: float | None) -> bool:
    return any(time is not None for time in times_s)


def _settles(reading: str, *times_s: float | None) -> bool:
    return reading == "settling" and _any_given(*times_s)


class CompassSection(Section):
    """[compass]: levelling and azimuth loops of method 'compass', and the times of their gains."""

    exclusive = (
        ("level_gains", "level_sigma_per_s"),
        ("level_gains", "level_adjustment_s"),
        ("level_adjustment_s", "level_sigma_per_s"),
        ("level_passes", "level_time_s"),
        ("azimuth_gains", "azimuth_sigma_per_s"),
        ("azimuth_gains", "azimuth_adjustment_s"),
        ("azimuth_adjustment_s", "azimuth_sigma_per_s"),
        ("sigma_passes", "sigma_times_s"),
    )
    conditions = (
        KeyCondition(("level_damping",), ("level_gains",), _are_designed, refused=True),
        KeyCondition(("azimuth_damping",), ("azimuth_gains",), _are_designed, refused=True),
        KeyCondition(("adjustment_reading",), _ADJUSTMENTS, _any_given),
        KeyCondition(("adjustment_remainder",), ("adjustment_reading", *_ADJUSTMENTS), _settles),
    )

    level_sigma_per_s: Annotated[Bandwidth | None, KeyInfo(default=0.02)] = Field(
        None, description="decay rate sigma of the levelling loop, 1/s; default 0.02"
    )
    level_adjustment_s: Seconds | None = Field(
        None,
        description="adjustment time of the levelling loop, s, defined by adjustment_reading; an"
        " alternative to its sigma",
    )
    level_gains: Annotated[tuple[Finite, Finite, Finite], KeyInfo(usual=(-1e11, 1e11))] | None = (
        Field(
            None,
            description="gains of the levelling loop, an alternative to its sigma: K1 of the"
            " velocity damping in 1/s, K2 of the platform rate in units of the transport rate, K3"
            " of the velocity integral in rad/(m s)",
        )
    )
    level_damping: Damping = Field(_DAMPING, description="damping ratio of the levelling loop")
    level_time_s: Annotated[SecondsOrZero | None, KeyInfo(default=150.0, time="s")] = Field(
        None,
        description="time of levelling in both channels before the azimuth loop starts, s;"
        " default 150",
    )
    level_passes: Annotated[Annotated[Count, Field(ge=1)] | None, KeyInfo(time="pass")] = Field(
        None,
        description="time of levelling as a number of passes over the stored record; an"
        " alternative to level_time_s",
    )
    azimuth_sigma_per_s: Annotated[Bandwidth | None, KeyInfo(default=0.01)] = Field(
        None, description="decay rate sigma of the azimuth loop, 1/s; default 0.01"
    )
    azimuth_adjustment_s: Seconds | None = Field(
        None,
        description="adjustment time of the azimuth loop, s, defined by adjustment_reading; an"
        " alternative to its sigma",
    )
    azimuth_gains: (
        Annotated[tuple[Finite, Finite, Finite, Finite], KeyInfo(usual=(-1e11, 1e11))] | None
    ) = Field(
        None,
        description="gains of the azimuth loop, an alternative to its sigma: K1 of the velocity"
        " damping in 1/s, K2 of the platform rate in units of the transport rate, K3 in 1/(m s^2)"
        " and K4 in 1/s of the azimuth control K3 / (omega_N (s + K4))",
    )
    azimuth_damping: Damping = Field(_DAMPING, description="damping ratio of the azimuth loop")
    adjustment_reading: Literal["period", "settling"] = Field(
        "period",
        description="definition of an adjustment time. 'period': one period of the damped"
        " oscillation. 'settling': the time in which exp(-sigma t) falls to adjustment_remainder",
    )
    adjustment_remainder: Annotated[float, Field(gt=0, lt=1)] = Field(
        0.05,
        description="value of exp(-sigma t) after an adjustment time; only with"
        " adjustment_reading = 'settling'",
    )
    sigma_factors: Factors = Field(
        (1.0,),
        description="factors on the sigma of the azimuth loop in successive intervals of a run,"
        " the first from its start",
    )
    sigma_times_s: Annotated[Times | None, KeyInfo(whole="sample", time="s")] = Field(
        None,
        description="update times at which the second and later intervals of sigma_factors start,"
        " s",
    )
    sigma_passes: Annotated[PassNumbers | None, KeyInfo(time="pass")] = Field(
        None,
        description="numbers of completed passes after which the second and later intervals of"
        " sigma_factors start; an alternative to sigma_times_s",
    )
    allow_unstable: bool = Field(
        False,
        description="whether loops are run that are unstable, or too fast for the sample time",
    )


def check_pieces(study: CheckedStudy) -> None:
    """Refuse sigma factors without as many times, and numbers of passes without a stored record."""
    if not study.has("compass"):
        return
    for point in study.combinations("sigma_factors", "sigma_times_s", "sigma_passes"):
        factors = point["sigma_factors"]
        key = "sigma_passes" if point["sigma_passes"] is not None else "sigma_times_s"
        if len(point[key] or ()) != len(factors) - 1:
            text = f"needs {len(factors) - 1} entries for {len(factors)} sigma_factors"
            study.refuse(key, f"{text}, not {len(point[key] or ())}")
    for key in ("level_passes", "sigma_passes"):
        if all(point[key] is None for point in study.combinations(key)):
            continue
        if not study.has("passes") or any(
            p["stored_s"] is None for p in study.combinations("stored_s")
        ):
            study.refuse(key, "needs passes over a stored record (give [passes] stored_s)")

"""Compass alignment as studies know it: [compass], params of the loops, description."""

import math
from typing import Annotated, Any, Literal, NoReturn

import numpy as np
from pydantic import Field

from sinsjax.methods.compass import design as loops
from sinsjax.methods.compass.design import AzimuthGains, LevelGains
from sinsjax.methods.compass.method import LoopParams, Reversal, build
from sinsjax.methods.method import Method, StudyKeys
from sinsjax.methods.schedules import PiecewiseConstant
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
    """[compass]: levelling and azimuth loops, and their gain schedule."""

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
        None, description="decay rate sigma of the loop, 1/s; default 0.02"
    )
    level_adjustment_s: Seconds | None = Field(
        None,
        description="adjustment time, see adjustment_reading, s; alternative to the loop's sigma",
    )
    level_gains: (
        Annotated[tuple[Finite, Finite, Finite], KeyInfo(usual_range=(-1e11, 1e11))] | None
    ) = Field(
        None,
        description="gains instead of sigma: velocity damping K1 (1/s), platform rate K2 (transport"
        " rates), velocity integral K3 (rad/(m s))",
    )
    level_damping: Damping = Field(_DAMPING, description="damping ratio of the loop")
    level_time_s: Annotated[SecondsOrZero | None, KeyInfo(default=150.0, time="s")] = Field(
        None,
        description="levelling time in both channels before the azimuth loop starts, s; default"
        " 150",
    )
    level_passes: Annotated[Annotated[Count, Field(ge=1)] | None, KeyInfo(time="pass")] = Field(
        None,
        description="levelling time in passes; alternative to level_time_s",
    )
    azimuth_sigma_per_s: Annotated[Bandwidth | None, KeyInfo(default=0.01)] = Field(
        None, description="decay rate sigma of the loop, 1/s; default 0.01"
    )
    azimuth_adjustment_s: Seconds | None = Field(
        None,
        description="adjustment time, see adjustment_reading, s; alternative to the loop's sigma",
    )
    azimuth_gains: (
        Annotated[tuple[Finite, Finite, Finite, Finite], KeyInfo(usual_range=(-1e11, 1e11))] | None
    ) = Field(
        None,
        description="gains instead of sigma: K1 and K2 as in level_gains; K3 (1/(m s^2)) and K4"
        " (1/s) of the azimuth control K3 / (omega_N (s + K4))",
    )
    azimuth_damping: Damping = Field(_DAMPING, description="damping ratio of the loop")
    adjustment_reading: Literal["period", "settling"] = Field(
        "period",
        description="adjustment time. 'period': of the damped oscillation. 'settling': until"
        " exp(-sigma t) falls to adjustment_remainder",
    )
    adjustment_remainder: Annotated[float, Field(gt=0, lt=1)] = Field(
        0.05,
        description="exp(-sigma t) after 'settling'",
    )
    sigma_factors: Factors = Field(
        (1.0,),
        description="factors on the azimuth sigma in successive intervals, the first from"
        " the start",
    )
    sigma_times_s: Annotated[Times | None, KeyInfo(whole="sample", time="s")] = Field(
        None, description="start times of the later intervals of sigma_factors, s"
    )
    sigma_passes: Annotated[PassNumbers | None, KeyInfo(time="pass")] = Field(
        None,
        description="completed passes before the later intervals; alternative to sigma_times_s",
    )
    allow_unstable: bool = Field(
        False, description="whether to run loops that are unstable, or too fast for the sample time"
    )


def check_sigma_factors(study: StudyKeys) -> None:
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


REVERSALS = {
    # see `method.Reversal`: velocity, integral, rate, reflection
    "reflect": (-1.0, -1.0, 1.0, 1.0),
    "velocity": (-1.0, -1.0, 1.0, 0.0),
    "velocity_and_rate": (-1.0, -1.0, -1.0, 0.0),
    "velocity_drop_rate": (-1.0, -1.0, 0.0, 0.0),
    "restart": (0.0, 0.0, 0.0, 0.0),
    "keep": (1.0, -1.0, 1.0, 0.0),
}
"""Factors on the loops' state at a direction reversal by the names of ``turn``.

``velocity``, that of [P2], negates the velocity and leaves azimuth rate and tilt, which a reversed
Earth rate turns against the loop; ``velocity_and_rate`` also negates the azimuth rate,
``velocity_drop_rate`` sets it to zero. ``reflect`` negates velocity and tilt, so that the next pass
continues where this one stopped. ``restart`` keeps the attitude alone, ``keep`` changes nothing but
the levelling integrals, which all others negate, too, except ``restart``.
"""


def params(columns: StudyKeys, xp: Any) -> LoopParams:
    """Return the params of the loops, leaves (variants,)."""
    site = columns.site
    rate = columns.rate_hz
    passes = columns.has("passes")
    stored = ("stored_s",) if passes else ()

    def level_s(
        time: float | None, number: int | None, stored_s: float | None = None
    ) -> float | None:
        return time if number is None else number * (stored_s or math.nan)

    def change_times_s(
        times: tuple[float, ...] | None,
        numbers: tuple[int, ...] | None,
        stored_s: float | None = None,
    ) -> tuple[float, ...]:
        return (
            times or () if numbers is None else tuple(n * (stored_s or math.nan) for n in numbers)
        )

    level_gains, azimuth_gains = gains(columns, site, xp)
    smoothing = columns.column("turn_smoothing_s") if passes else np.ones(columns.count)
    turn = (
        columns.compute(REVERSALS.__getitem__, "turn").T
        if passes
        else np.tile(np.reshape(REVERSALS["keep"], (-1, 1)), columns.count)
    )
    return LoopParams(
        level=level_gains,
        azimuth=azimuth_gains,
        pace=PiecewiseConstant(
            np.round(
                columns.lists(
                    change_times_s, "sigma_times_s", "sigma_passes", *stored, padding=np.inf
                )
                * rate
            ),
            columns.lists(list, "sigma_factors", padding=1.0),
        ),
        azimuth_from=np.round(
            columns.compute(level_s, "level_time_s", "level_passes", *stored) * rate
        ),
        smoothing=-xp.expm1(-2 / (rate * smoothing)),  # two stages share the delay
        reversal=Reversal(*turn),
    )


def gains(columns: StudyKeys, site: Any, xp: Any = np) -> tuple[LevelGains, AzimuthGains]:
    """Return the gains of the loops: as given, or designed from sigma or adjustment time, damping.

    They are designed for the north channel; on an ellipsoid the east one differs in its K2 by some
    0.1 %.
    """
    earth = earth_numbers(site)
    level = loops.level_gains(*_sigma_and_damping(columns, "level"), **earth)
    azimuth = loops.azimuth_gains(*_sigma_and_damping(columns, "azimuth"), **earth)
    return _replace_given(columns, "level_gains", level, xp), _replace_given(
        columns, "azimuth_gains", azimuth, xp
    )


def check(columns: StudyKeys) -> None:
    """Refuse compass loops that are unstable, or too fast for the sample time.

    Args:
        columns: keys of variants with this method and one site.

    Raises:
        InputError: names the roots; not if ``allow_unstable`` is set.
    """
    site = columns.site
    refused = ~columns.compute(bool, "allow_unstable", dtype=bool)
    earth = earth_numbers(site)
    fastest = columns.compute(max, "sigma_factors")
    with np.errstate(over="ignore", invalid="ignore"):
        level, azimuth = gains(columns, site)
        azimuth = loops.scale_azimuth_gains(azimuth, fastest)
    for loop, found in (("level", level), ("azimuth", azimuth)):
        for row in np.flatnonzero(~np.isfinite(np.stack(found)).all(axis=0)):
            _refuse_loop(columns, loop, int(row), "gives a gain that is no finite number")
    dt = 1 / columns.rate_hz
    rate_n = float(site.place.rate_n)
    for loop, polynomial, matrix in (
        (
            "level",
            loops.level_polynomial(level, **earth),
            loops.level_matrix(level, **earth),
        ),
        (
            "azimuth",
            loops.azimuth_polynomial(azimuth, **earth),
            loops.azimuth_matrix(azimuth, rate_n=rate_n, **earth),
        ),
    ):
        roots = loops.roots(polynomial)
        unstable = roots.real.max(axis=-1) >= 0
        for row in np.flatnonzero(refused & (unstable | ~loops.is_stable(matrix, dt))):
            what = (
                "makes an unstable loop"
                if unstable[row]
                else f"makes a loop that a sample of {dt:g} s cannot carry"
            )
            text = f"{what}, its roots are {_format_roots(roots[row])} 1/s"
            _refuse_loop(columns, loop, int(row), f"{text} (allow_unstable = true runs it)")


def _refuse_loop(columns: StudyKeys, loop: str, row: int, text: str) -> NoReturn:
    """Refuse a variant's loop, naming the key that sets its gains, and the value."""
    keys = [f"{loop}_{kind}" for kind in ("gains", "adjustment_s", "sigma_per_s")]
    key, value = next((k, v) for k in keys if (v := columns.value(k, row)) is not None)
    shown = list(value) if isinstance(value, tuple) else f"{value:g}"
    factor = max(columns.value("sigma_factors", row))
    if loop == "azimuth" and factor != 1:
        shown = f"{shown} with a sigma factor of {factor:g}"
    columns.refuse(key, f"{shown} {text}")


def earth_numbers(site: Any) -> dict[str, Any]:
    """Return gravity and radius, the arguments of `compass.design`."""
    return {"gravity": float(site.place.gravity), "radius": float(1 / site.place.curvature_n)}


def _format_roots(found: np.ndarray) -> str:
    ordered = sorted(found, key=lambda r: (-round(r.real, 9), r.imag))
    return ", ".join(f"{r.real + 0.0:.4g}{f'{r.imag:+.4g}j' if r.imag else ''}" for r in ordered)


def _replace_given(columns: StudyKeys, key: str, designed: Any, xp: Any) -> Any:
    """Return designed gains, replaced for variants that give gains."""
    rows, count = xp.stack(designed, axis=-1), len(designed)
    given = columns.compute(lambda v: [math.nan] * count if v is None else v, key)
    return type(designed)(*xp.where(xp.isnan(given), rows, given).T)


def _sigma_and_damping(columns: StudyKeys, loop: str) -> tuple[Any, Any]:
    """Return sigma (1/s) and damping of a loop; sigma is arbitrary if a variant gives gains."""

    def sigma_of(given: Any, time: Any, damping: Any, reading: str, remainder: Any) -> Any:
        if given is not None:
            return given
        if time is None:
            return 1.0
        if reading == "period":
            return loops.sigma_from_period(time, damping)
        return loops.sigma_from_settling(time, remainder)

    keys = (f"{loop}_sigma_per_s", f"{loop}_adjustment_s", f"{loop}_damping")
    sigmas = columns.compute(sigma_of, *keys, "adjustment_reading", "adjustment_remainder")
    return sigmas, columns.column(f"{loop}_damping")


COMPASS = Method(
    name="compass",
    summary="gyrocompass loops: levelling of third order, azimuth of fourth",
    source="[P2] section 2.1",
    sections={"compass": CompassSection},
    reads=("turn", "turn_smoothing_s"),
    build=build,
    params=params,
    check=check,
    turning="none",
    rules=(check_sigma_factors,),
    step_s=5e-9,
)

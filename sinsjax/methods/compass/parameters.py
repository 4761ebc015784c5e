"""[compass] as the numbers of the loops: gains, when they change, and what a turn does."""

import math
from typing import Any

import numpy as np

from sinsjax.errors import InputError
from sinsjax.methods.base import Site
from sinsjax.methods.compass import design as loops
from sinsjax.methods.compass.design import AzimuthGains, LevelGains
from sinsjax.methods.compass.method import LoopParams, Reversal
from sinsjax.methods.parameters import Columns, in_samples
from sinsjax.methods.schedules import Pieces

REVERSALS = {
    # velocity, integral, rate, reflection
    "reflect": Reversal(-1.0, -1.0, 1.0, 1.0),
    "velocity": Reversal(-1.0, -1.0, 1.0, 0.0),
    "velocity_and_rate": Reversal(-1.0, -1.0, -1.0, 0.0),
    "velocity_drop_rate": Reversal(-1.0, -1.0, 0.0, 0.0),
    "restart": Reversal(0.0, 0.0, 0.0, 0.0),
    "keep": Reversal(1.0, -1.0, 1.0, 0.0),
}
"""What compass loops do at a direction reversal, by the names of ``turn``.

``velocity``, [P2]'s own, changes the sign of the velocity and leaves azimuth rate and tilt, which a
reversed Earth rate turns against the loop; ``velocity_and_rate`` changes that of the azimuth rate
too, ``velocity_drop_rate`` sets it to zero. ``reflect`` changes the signs of velocity and tilt, so
that the next pass goes on where this one stopped. ``restart`` begins again with the attitude alone,
``keep`` goes on as if nothing had happened. All but ``restart`` change the sign of the levelling
integrals.
"""


def parameters(columns: Columns, site: Site, ug: float) -> LoopParams:
    """Numbers of the loops, leaves (variants,).

    Args:
        columns: of variants with this method.
        site: Earth and place.
        ug: micro-g in m/s^2, which loops do not ask for.
    """
    rate = columns.rate_hz
    passes = columns.has("passes")
    stored = ("stored_s",) if passes else ()

    def level_s(
        time: float | None, number: int | None, stored_s: float | None = None
    ) -> float | None:
        return time if number is None else number * (stored_s or math.nan)

    def pieces_s(
        times: tuple[float, ...] | None,
        numbers: tuple[int, ...] | None,
        stored_s: float | None = None,
    ) -> tuple[float, ...]:
        return (
            times or () if numbers is None else tuple(n * (stored_s or math.nan) for n in numbers)
        )

    level_gains, azimuth_gains = gains(columns, site)
    smoothing = columns.column("turn_smoothing_s") if passes else np.ones(columns.count)
    turn = (
        columns.each(REVERSALS.__getitem__, "turn").T
        if passes
        else np.tile(np.reshape(REVERSALS["keep"], (-1, 1)), columns.count)
    )
    return LoopParams(
        level=level_gains,
        azimuth=azimuth_gains,
        pace=Pieces(
            in_samples(columns, pieces_s, "sigma_times_s", "sigma_passes", *stored),
            columns.lists(list, "sigma_factors", rest=1.0),
        ),
        azimuth_from=np.round(
            columns.each(level_s, "level_time_s", "level_passes", *stored) * rate
        ),
        smoothing=-np.expm1(-2 / (rate * smoothing)),  # two stages share the delay
        turn=Reversal(*turn),
    )


def gains(columns: Columns, site: Site) -> tuple[LevelGains, AzimuthGains]:
    """Gains of the loops: as given, or designed from sigma or an adjustment time and damping.

    They are designed for the north channel; on an ellipsoid the east one differs in its K2 by some
    0.1 %.
    """
    earth = earth_numbers(site)
    level = loops.level_gains(*_sigma(columns, "level"), **earth)
    azimuth = loops.azimuth_gains(*_sigma(columns, "azimuth"), **earth)
    return _given(columns, "level_gains", level), _given(columns, "azimuth_gains", azimuth)


def check(columns: Columns, site: Site) -> None:
    """Refuses compass loops that are unstable, or that a sample interval cannot carry.

    Args:
        columns: of columns with this method and one site.
        site: Earth and place.

    Raises:
        InputError: names the roots; not where ``allow_unstable`` is set.
    """
    refused = ~columns.each(bool, "allow_unstable", dtype=bool)
    earth = earth_numbers(site)
    fastest = columns.each(max, "sigma_factors")
    with np.errstate(over="ignore", invalid="ignore"):
        level, azimuth = gains(columns, site)
        azimuth = loops.at_pace(azimuth, fastest)
    for loop, found in (("level", level), ("azimuth", azimuth)):
        for row in np.flatnonzero(~np.isfinite(np.stack(found)).all(axis=0)):
            raise _refusal(columns, loop, int(row), "gives a gain that is no finite number")
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
        for row in np.flatnonzero(refused & (unstable | ~loops.carries(matrix, dt))):
            what = (
                "makes an unstable loop"
                if unstable[row]
                else f"makes a loop that a sample of {dt:g} s cannot carry"
            )
            text = f"{what}, its roots are {_roots_text(roots[row])} 1/s"
            raise _refusal(columns, loop, int(row), f"{text} (allow_unstable = true runs it)")


def _refusal(columns: Columns, loop: str, row: int, text: str) -> InputError:
    """The error of a variant's loop, naming the key that decides its gains, and the value."""
    keys = [f"{loop}_{kind}" for kind in ("gains", "adjustment_s", "sigma_per_s")]
    key, value = next((k, v) for k in keys if (v := columns.value(k, row)) is not None)
    shown = list(value) if isinstance(value, tuple) else f"{value:g}"
    factor = max(columns.value("sigma_factors", row))
    if loop == "azimuth" and factor != 1:
        shown = f"{shown} with a sigma factor of {factor:g}"
    return columns.refused(key, f"{shown} {text}")


def earth_numbers(site: Site) -> dict[str, Any]:
    """Gravity and radius as `compass.design` takes them."""
    return {"gravity": float(site.place.gravity), "radius": float(1 / site.place.curvature_n)}


def _roots_text(found: np.ndarray) -> str:
    ordered = sorted(found, key=lambda r: (-round(r.real, 9), r.imag))
    return ", ".join(f"{r.real + 0.0:.4g}{f'{r.imag:+.4g}j' if r.imag else ''}" for r in ordered)


def _given(columns: Columns, key: str, designed: Any) -> Any:
    """The gains, replaced where a variant gives its own."""
    rows, count = np.stack(designed, axis=-1), len(designed)
    own = columns.each(lambda v: [math.nan] * count if v is None else v, key)
    return type(designed)(*np.where(np.isnan(own), rows, own).T)


def _sigma(columns: Columns, loop: str) -> tuple[np.ndarray, np.ndarray]:
    """Sigma (1/s) and damping of a loop; a variant with gains of its own has some sigma."""

    def sigma(
        own: float | None, time: float | None, damping: float, reading: str, remainder: float
    ) -> float:
        if own is not None:
            return own
        if time is None:
            return 1.0
        if reading == "period":
            return loops.sigma_of_period(time, damping)
        return loops.sigma_of_settling(time, remainder)

    keys = (f"{loop}_sigma_per_s", f"{loop}_adjustment_s", f"{loop}_damping")
    sigmas = columns.each(sigma, *keys, "adjustment_reading", "adjustment_remainder")
    return sigmas, columns.column(f"{loop}_damping")

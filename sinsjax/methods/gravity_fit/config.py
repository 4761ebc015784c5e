"""The gravity fit as studies know it: [gravity_fit], params, columns, description."""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pydantic import Field

from sinsjax.columns import Column
from sinsjax.methods.filters.keys import ACCEL_NOISE, GYRO_NOISE, level_surge
from sinsjax.methods.gravity_fit.fit import FitParams
from sinsjax.methods.gravity_fit.method import build
from sinsjax.methods.gravity_fit.noise import Drift, SensorNoise
from sinsjax.methods.method import Method, OwnColumn, StudyKeys
from sinsjax.units import ARCSEC, DEG_PER_H, DEG_PER_SQRT_H, PPM
from sinsjax.value_types import (
    AccelNoise,
    AccelSigma,
    GyroSigma,
    GyroWalk,
    KeyInfo,
    NonNegative,
    Section,
    keys_of,
)

LONGEST_BLOCK_S = 2.0

REFITS = (
    "gravity_fit refits after 4, 8, 16, ... s, at report_times_s and at the end: only then can it"
    " settle (7, 15, 31, ... s)"
)
"""What its settling times are worth; after the `GROWTH` of `gravity_fit.method`."""


class GravityFitSection(Section):
    """[gravity_fit]: assumed sensor errors; biases and noise are required with a record."""

    fit_gyro_bias_deg_per_h: GyroSigma | None = Field(
        None,
        description="1 sigma of this sensor error, deg/h; default: that of [sensors] or [drawn]",
    )
    fit_gyro_arw_deg_per_sqrt_h: GyroWalk | None = Field(
        None, description="angle or velocity random walk, deg/sqrt(h); default: that of [sensors]"
    )
    fit_gyro_scale_ppm: Annotated[NonNegative, KeyInfo(usual_range=(0, 1e6))] | None = Field(
        None,
        description="1 sigma of this sensor error, ppm; default: that of [sensors] or [drawn]",
    )
    fit_gyro_misalignment_arcsec: Annotated[NonNegative, KeyInfo(usual_range=(0, 1e5))] | None = (
        Field(
            None,
            description="1 sigma of this sensor error, arcsec; default: that of [sensors] or"
            " [drawn]",
        )
    )
    fit_lever_arm_m: Annotated[NonNegative, KeyInfo(usual_range=(0, 1e3))] | None = Field(
        None,
        description="1 sigma per axis of the lever arm from the turn axis, m; 0 on the axis;"
        " default: that of [motion]",
    )
    fit_accel_bias_ug: AccelSigma | None = Field(
        None,
        description="1 sigma of this sensor error, ug; default: that of [sensors] or [drawn]",
    )
    fit_accel_vrw_ug_per_sqrt_hz: AccelNoise | None = Field(
        None, description="angle or velocity random walk, ug/sqrt(Hz); default: that of [sensors]"
    )


_DEFAULTS = {
    "fit_gyro_bias_deg_per_h": "gyro_bias_deg_per_h",
    "fit_gyro_scale_ppm": "gyro_scale_ppm",
    "fit_gyro_misalignment_arcsec": "gyro_misalignment_arcsec",
    "fit_accel_bias_ug": "accel_bias_ug",
    "fit_lever_arm_m": "lever_arm_m",
}
"""Keys of [sensors] and [motion] that a belief follows if it is left out."""

_NOISE = {
    "fit_gyro_arw_deg_per_sqrt_h": GYRO_NOISE.density,
    "fit_accel_vrw_ug_per_sqrt_hz": ACCEL_NOISE.density,
}
"""Keys of Q whose white noise a density follows if it is left out."""


def params(columns: StudyKeys, xp: Any) -> FitParams:
    """Return `fit.FitParams`, leaves (variants,)."""
    site, ug = columns.site, columns.micro_g

    def given_or(key: str, unit: float, default: Callable[[], Any]) -> NDArray:
        given = columns.column(key, unit)
        return np.where(np.isnan(given), default(), given) if np.isnan(given).any() else given

    def sigma(key: str, unit: float) -> NDArray:
        # A record has no [sensors]: the rules require what it must give itself.
        has_default = columns.has("sensors")
        return given_or(
            key, unit, lambda: columns.rms(_DEFAULTS[key]) * unit if has_default else 0.0
        )

    def noise(key: str, unit: float, default_unit: float) -> NDArray:
        white = partial(_NOISE[key], columns.rate_hz)
        return given_or(
            key, unit, lambda: columns.compute(white, *keys_of(_NOISE[key])) * default_unit
        )

    def drift(rms: str, time: str, walk: str, unit: float) -> tuple[Any, ...]:
        if not columns.has("sensors"):
            return ()
        zero = np.zeros(columns.count)
        variance, density = (columns.rms(rms) * unit) ** 2, (columns.rms(walk) * unit) ** 2 / 3600
        drifts = []
        if variance.any():
            drifts.append(Drift(variance, 1 / columns.column(time), zero))
        if density.any():
            drifts.append(Drift(zero, zero, density))
        return tuple(drifts)

    scale = sigma("fit_gyro_scale_ppm", PPM)
    cross = sigma("fit_gyro_misalignment_arcsec", ARCSEC)
    lever = sigma("fit_lever_arm_m", 1.0)
    accel = sigma("fit_accel_bias_ug", ug)
    has_scale = bool(np.any(scale) or np.any(cross))
    surge = None
    if columns.has("sensors"):  # of a simulation, which has [motion] as well
        # On a level base the reaction to gravity makes a bias of the axes' errors.
        tilted = columns.rms("accel_misalignment_arcsec") * ARCSEC * site.place.gravity
        accel = np.hypot(accel, tilted)
        rms = columns.compute(level_surge, "surge_m_per_s")
        if rms.any():
            zero = np.zeros(columns.count)
            surge = Drift(rms**2, 1 / columns.column("surge_time_s"), zero)
    return FitParams(
        noise=SensorNoise(
            gyro=noise("fit_gyro_arw_deg_per_sqrt_h", DEG_PER_SQRT_H, DEG_PER_H),
            accel=noise("fit_accel_vrw_ug_per_sqrt_hz", ug, ug),
            gyro_drifts=drift(*_GYRO_DRIFTS, DEG_PER_H),
            accel_drifts=drift(*_ACCEL_DRIFTS, ug),
            surge=surge,
        ),
        gyro_bias=sigma("fit_gyro_bias_deg_per_h", DEG_PER_H),
        accel_bias=accel,
        scale_factor=scale if has_scale else None,
        cross_axis=cross if has_scale else None,
        lever_arm=lever if np.any(lever) else None,
    )


_GYRO_DRIFTS = (
    "gyro_instability_deg_per_h",
    "gyro_instability_time_s",
    "gyro_rrw_deg_per_h_per_sqrt_h",
)
_ACCEL_DRIFTS = ("accel_instability_ug", "accel_instability_time_s", "accel_rrw_ug_per_sqrt_h")


def _gyro_bias(axis: int) -> Callable[[Any, float], NDArray]:
    def value(results: Any, rate_hz: float) -> NDArray:
        return np.asarray(results.gyro[0][axis]) / DEG_PER_H

    return value


def _gyro_bias_sigma(axis: int) -> Callable[[Any, float], NDArray]:
    def value(results: Any, rate_hz: float) -> NDArray:
        return np.sqrt(np.asarray(results.gyro_bias_variance[axis])) / DEG_PER_H

    return value


_AXES = ("right", "front", "up")

COLUMNS = (
    OwnColumn(
        Column(
            "fit_misfit",
            pa.float64(),
            "",
            "root mean square of the fit's residuals over their sigma; 1 is expected, more than 3"
            " is a doubt",
        ),
        lambda results, rate_hz: np.asarray(results.misfit),
    ),
    OwnColumn(
        Column(
            "fit_prior_ratio",
            pa.float64(),
            "",
            "largest sensor error or lever arm that the fit finds, over its 1 sigma in"
            " [gravity_fit]; more than 3 is a doubt",
        ),
        lambda results, rate_hz: np.asarray(results.prior_ratio),
    ),
    OwnColumn(
        Column(
            "fit_change",
            pa.float64(),
            "",
            "change of the unknowns in the last pass of the fit, in sigma; more than 1 is a doubt,"
            " the fit has not converged",
        ),
        lambda results, rate_hz: np.asarray(results.change),
    ),
    *(
        OwnColumn(
            Column(
                f"fit_gyro_bias_{name}_deg_per_h",
                pa.float64(),
                "deg/h",
                f"gyro bias of the {name} axis by the fit",
            ),
            _gyro_bias(axis),
        )
        for axis, name in enumerate(_AXES)
    ),
    *(
        OwnColumn(
            Column(f"fit_gyro_bias_{name}_sigma_deg_per_h", pa.float64(), "deg/h", "1 sigma of it"),
            _gyro_bias_sigma(axis),
        )
        for axis, name in enumerate(_AXES)
    ),
)


def _check_record_interval(study: StudyKeys) -> None:
    """Refuse record intervals beyond the length of a block."""
    for point in study.combinations("method"):
        if point["method"] == "gravity_fit" and study.record_interval_s > LONGEST_BLOCK_S:
            text = f"gravity_fit needs at most {LONGEST_BLOCK_S:g} s (its blocks are as long)"
            study.refuse("record_interval_s", text)


def _check_beliefs(study: StudyKeys) -> None:
    """Require what a record cannot say of its sensors, and white noise of simulated ones."""
    biases = ("fit_gyro_bias_deg_per_h", "fit_accel_bias_ug") if study.is_recorded else ()
    white = [key for density in _NOISE.values() for key in keys_of(density)]
    sensors = () if study.is_recorded else white
    for point in study.combinations("method", *biases, *_NOISE, *sensors):
        if point["method"] != "gravity_fit":
            continue
        for key in biases:
            if point[key] is None:
                study.refuse(key, "required with a record (from the sensors' data sheet)")
        for key, density in _NOISE.items():
            noise = point[key]
            if noise is None and study.is_recorded:
                study.refuse(key, "required with a record (from the sensors' data sheet)")
            if noise is None:
                noise = density(study.rate_hz, *(point[name] for name in keys_of(density)))
            if not noise:
                text = "must be above 0: gravity_fit weights its data by the noise"
                study.refuse(key, f"{text} (give it, or white noise in [sensors])")


GRAVITY_FIT = Method(
    name="gravity_fit",
    summary="least squares of the turn of gravity with the sensor biases as unknowns: for a base"
    " that is turned",
    source="`methods.gravity_fit.fit`",
    sections={"gravity_fit": GravityFitSection},
    build=build,
    params=params,
    needs_start=False,
    turning="any",
    rules=(_check_record_interval, _check_beliefs),
    columns=COLUMNS,
    step_s=10e-9,
)

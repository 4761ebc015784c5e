"""The resets of a study's filters by the law, and the settling times that it predicts."""

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from sinsjax.errors import InputError
from sinsjax.methods.reset_law import MEDIAN_SIGMAS, ResetProblem
from sinsjax.methods.reset_prediction import Lane, predict_settling_times
from sinsjax.study import display
from sinsjax.study.keys import format_toml
from sinsjax.study.load import load_study
from sinsjax.study.reset_schedules import (
    DERIVED,
    LAW_KEYS,
    LAW_METHODS,
    reset_problem,
    schedule_by_law,
)
from sinsjax.study.study import Study
from sinsjax.units import ARCMIN, DEG

_NOISY = 1.1  # settling times that noise delays by less are one
_SIGMAS = (MEDIAN_SIGMAS, 1.15, 2.0)
"""1 sigma of white noise that narrow the band: for the median, and if noise alone decides, for the
median and nine runs of ten. Gyro noise leaves a heading error W(T)/T, a Brownian motion in 1/T, so
the run settles where that motion first leaves the band; (2, 4, 6, 69 s) of `reset_sweep`: 178 and
226 s, measured 172 and 238 s.
"""
_TILT = 5 * (1 + 1j) * DEG  # of the start
_DRIFTS = (
    *("gyro_instability_deg_per_h", "accel_instability_ug"),
    *("gyro_rrw_deg_per_h_per_sqrt_h", "accel_rrw_ug_per_sqrt_h"),
)
"""Sensor errors that delay settling and that the prediction leaves out."""


class ResetPlan(NamedTuple):
    """The schedule of a filter by the law, and its predicted settling time; times in s.

    Settling times are those of a median run from the heading bound and 5 deg of level about both
    axes, predicted by `sinsjax.methods.reset_prediction`; inf if it does not settle. They hold for
    resets that open P as `settings` does.

    Attributes:
        problem: the filter and its place.
        heading_bound_deg: largest initial heading error that the schedule settles, deg.
        band_arcmin: heading error within which a run is settled, arcmin.
        times_s: times of the resets.
        settling_s: settling time with these resets.
        noisy_s: the same if the sensors' white noise alone decides, which is later.
        late_s: settling time with two sigma of noise, of some 90 % of such runs.
        without_s: settling time without resets.
        left_out: keys of sensor errors that delay settling and are not predicted.

    Examples:
        >>> plan = sinsjax.reset_schedule("paper1_resets", heading_bound_deg=60.0)
        >>> len(plan.times_s), plan.settling_s < plan.without_s
        (4, True)
        >>> plan.settings["reset_velocity_m_per_s"]
        1.0
    """

    problem: ResetProblem
    heading_bound_deg: float
    band_arcmin: float
    times_s: tuple[float, ...]
    settling_s: float
    noisy_s: float
    late_s: float
    without_s: float
    left_out: tuple[str, ...] = ()

    @property
    def settings(self) -> dict[str, Any]:
        """The keys of [resets] that list these resets, as ``schedule = "law"`` sets them."""
        velocity = float(f"{self.problem.velocity:.9g}")
        return {"reset_times_s": [*self.times_s], "reset_velocity_m_per_s": velocity}

    @property
    def median(self) -> str:
        """The settling time of a median run in words: a range if noise may decide it."""
        if not self.noisy_s > _NOISY * self.settling_s:
            return _format_time(self.settling_s)
        if math.isinf(self.noisy_s):
            return f"{_format_time(self.settling_s)} or more"
        return f"{self.settling_s:,.0f} to {_format_time(self.noisy_s)}"

    @property
    def facts(self) -> dict[str, str]:
        """The plan in words, by heading."""
        drifts = f", more with {' and '.join(self.left_out)}" if self.left_out else ""
        velocity = self.settings["reset_velocity_m_per_s"]
        return {
            "resets": f"{', '.join(f'{time:g}' for time in self.times_s)} s",
            "set": f'schedule = "law", or these times with reset_velocity_m_per_s = {velocity:.4g}',
            "settles": f"within {self.band_arcmin:g}' from {self.heading_bound_deg:g} deg:"
            f" {self.median} (median run, predicted),"
            f" {_format_time(self.late_s)} with {_SIGMAS[-1]:g} sigma of noise{drifts}",
            "without": _format_time(self.without_s),
        }

    def __repr__(self) -> str:
        """Return the plan in lines."""
        return display.format_text("Reset schedule by the law", self.facts)


def reset_schedule(study: Study | str, **bounds: float) -> ResetPlan:
    """Return the reset schedule of a study's filter by the law.

    Args:
        study: study, its file, or the name of a shipped study, of one filter and place.
        bounds: ``heading_bound_deg`` and ``settle_band_arcmin`` in place of those of the study.

    Raises:
        InputError: the study has several filters or places, or the law does not hold for it.

    Examples:
        >>> plan = sinsjax.reset_schedule("paper1_resets")
        >>> plan.times_s
        (2.0, 4.0, 6.0, 118.0)
    """
    plans = list(iter_plans(load_study(study), **bounds))
    if len(plans) != 1:
        text = f"{len(plans)} filters or places (use sinsjax schedule, or replace their keys)"
        raise InputError(f"{load_study(study).name}: has {text}")
    return plans[0][1]


def iter_plans(study: Study, **bounds: float) -> Iterator[tuple[dict[str, Any], ResetPlan]]:
    """Yield what distinguishes each filter and place of a study, and its plan.

    Raises:
        InputError: no method of the study has the law, or it has no schedule for one of them.
    """
    left_out = tuple(key for key in _DRIFTS if _has_drift(study, key))
    filters, rate_hz = list(iter_filters(study, **bounds)), study.rate_hz or 100.0
    runs = list[tuple[Lane, float, float, float]]()
    for _, point in filters:
        try:
            found = schedule_by_law(rate_hz, point)
        except InputError as error:
            raise error.with_source(study.name) from None
        assert found is not None
        bound, band = point["heading_bound_deg"] * DEG, point["settle_band_arcmin"] * ARCMIN
        law = Lane(reset_problem(rate_hz, point), found.times_s, bound, _TILT)
        run_s = max(study.run_s, 3 * found.settling_s)
        runs += [(law, run_s, band, sigmas) for sigmas in _SIGMAS]
        runs.append((law._replace(times_s=()), run_s, band, MEDIAN_SIGMAS))
    settling = predict_settling_times(*zip(*runs, strict=True)).reshape(-1, 4).tolist()
    for (varying, point), (law, *_), times_s in zip(filters, runs[::4], settling, strict=True):
        by_law, noisy, late, without = times_s
        bound, band = point["heading_bound_deg"], point["settle_band_arcmin"]
        plan = ResetPlan(law.problem, bound, band, law.times_s, by_law, noisy, late, without)
        yield varying, plan._replace(left_out=left_out)


def iter_filters(
    study: Study, **bounds: float
) -> Iterator[tuple[dict[str, Any], Mapping[str, Any]]]:
    """Yield what distinguishes each filter and place of a study, and its values of `LAW_KEYS`.

    Raises:
        InputError: no method of the study has the law.
    """
    keys = [key for key in LAW_KEYS if study.is_readable(key) and key not in (*bounds, "schedule")]
    points = [p for p in study.given_combinations(*keys) if p["method"] in LAW_METHODS]
    if not points:
        text = f"the law of resets holds for {', '.join(LAW_METHODS)}"
        raise InputError(
            f"{study.name}: [alignment] method: {text}, not {', '.join(study.methods)}"
        )
    varying = [key for key in keys if len({point[key] for point in points}) > 1]
    absent = dict.fromkeys((*LAW_KEYS, *DERIVED)) | {"schedule": "law"}
    for point in points:
        yield {key: point[key] for key in varying}, absent | point | bounds


def describe_plans(study: Study) -> list[str]:
    """Return the plans of a study for a terminal, of several filters or places a line each.

    Raises:
        InputError: see `iter_plans`.
    """
    plans = list(iter_plans(study))
    if len(plans) == 1:
        facts = plans[0][1].facts
        return [f"{study.name}:", *(f"  {name:<7}  {text}" for name, text in facts.items())]
    lines = [f"{study.name}: {len(plans)} filters or places; resets, and settling of a median run:"]
    for point, plan in plans:
        name = ", ".join(f"{key} {format_toml(value)}" for key, value in point.items())
        without = _format_time(plan.without_s)
        lines.append(f"  {name}: {plan.facts['resets']}; {plan.median} (without: {without})")
    return lines


def _has_drift(study: Study, key: str) -> bool:
    if key in study.drawn_keys:
        return True
    return study.is_readable(key) and any(np.any(value or 0.0) for value in study.values(key))


def _format_time(time_s: float) -> str:
    return f"{time_s:,.0f} s" if math.isfinite(time_s) else "never"

"""What the law of resets says of a study: the times, their prediction, and when to distrust it."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import tomli_w

from sinsjax.errors import InputError
from sinsjax.methods import reset_law
from sinsjax.methods.filters.keys import SCHEDULE_KEYS
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
_NOISE_SIGMAS, _LATE_SIGMAS = 1.15, 2.0
"""1 sigma of white noise that narrow the band if noise alone decides: for the median and nine runs
of ten. Gyro noise leaves a heading error W(T)/T, a Brownian motion in 1/T, so the run settles where
that motion first leaves the band; (2, 4, 6, 69 s) of `reset_sweep`: 178 and 226 s,
measured 172 and 238 s.
"""
_TILT = 5 * (1 + 1j) * DEG  # of the start
_LARGE_BOUND, _LARGE_LEVEL = 165 * DEG, 30 * DEG
_SLOW_FEEDBACK_S = 20.0
_MAX_PLANS = 15
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
        warnings: where the law is known to fail.

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
    warnings: tuple[str, ...] = ()

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
        return {
            "resets": f"{', '.join(f'{time:g}' for time in self.times_s)} s",
            "set": _describe_settings([self]),
            "settles": f"within {self.band_arcmin:g}' from {self.heading_bound_deg:g} deg:"
            f" {self.median} (median run, predicted),"
            f" {_format_time(self.late_s)} with {_LATE_SIGMAS:g} sigma of noise",
            "without": _format_time(self.without_s),
        }

    def __repr__(self) -> str:
        """Return the plan in lines, with its warnings."""
        warnings = {f"warning {k}": text for k, text in enumerate(self.warnings, start=1)}
        return display.format_text("Reset schedule by the law", self.facts | warnings)


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
        noise = MEDIAN_SIGMAS, _NOISE_SIGMAS, _LATE_SIGMAS
        runs += [(law, run_s, band, sigmas) for sigmas in noise]
        runs.append((law._replace(times_s=()), run_s, band, MEDIAN_SIGMAS))
    settling = predict_settling_times(*zip(*runs, strict=True)).reshape(-1, 4).tolist()
    for (varying, point), (law, *_), times_s in zip(filters, runs[::4], settling, strict=True):
        by_law, noisy_s, late_s, without_s = times_s
        plan = ResetPlan(
            law.problem,
            point["heading_bound_deg"],
            point["settle_band_arcmin"],
            law.times_s,
            settling_s=by_law,
            noisy_s=noisy_s,
            late_s=late_s,
            without_s=without_s,
            left_out=left_out,
        )
        yield varying, plan._replace(warnings=tuple(_warnings(plan)))


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
        text = (
            f"the law of resets holds for {', '.join(LAW_METHODS)}, not {', '.join(study.methods)}"
        )
        raise InputError(f"{study.name}: [alignment] method: {text}")
    varying = [key for key in keys if len({point[key] for point in points}) > 1]
    defaults = {"heading_bound_deg": 150.0, "settle_band_arcmin": 10.0, "schedule": "law"}
    for point in points:
        whole = dict.fromkeys((*LAW_KEYS, *DERIVED)) | defaults | point | bounds
        yield {key: point[key] for key in varying}, whole


def describe_plans(study: Study) -> list[str]:
    """Return the plans of a study for a terminal, of several filters or places a line each.

    Raises:
        InputError: see `iter_plans`.
    """
    plans = list(iter_plans(study))
    if len(plans) == 1:
        _, plan = plans[0]
        width = max(map(len, plan.facts))
        lines = [f"{study.name}: {_describe_filter(plan)}"]
        lines += [f"  {heading:<{width}}  {text}" for heading, text in plan.facts.items()]
        return [*lines, *(f"Warning: {text}." for text in plan.warnings)]
    lines = [f"{study.name}: {len(plans)} filters or places; resets, and settling of a median run:"]
    for point, plan in plans[:_MAX_PLANS]:
        what = ", ".join(f"{key} {format_toml(value)}" for key, value in point.items())
        times = ", ".join(f"{time:g}" for time in plan.times_s)
        without = _format_time(plan.without_s)
        lines.append(f"  {what}: {times} s; {plan.median} (without: {without})")
    if left := len(plans) - _MAX_PLANS:
        lines += [f"  and {left} more"] if left > 0 else []
    lines.append(f"  set: {_describe_settings([plan for _, plan in plans])}")
    warnings = dict.fromkeys(text for _, plan in plans for text in plan.warnings)
    return [*lines, *(f"Warning, of some: {text}." for text in warnings)]


def with_law(study: Study) -> str:
    """Return a study with its resets by the law, as TOML without defaults.

    A comment names the key that listed times need too.
    """
    given = {key for key in (*SCHEDULE_KEYS, "reset_trigger") if study.is_readable(key)}
    tables = {name: dict(table) for name, table in study.to_dict().items() if name != "cases"}
    for name in ("resets", "axes"):
        table = tables.get(name, {})
        tables[name] = {key: value for key, value in table.items() if key not in given}
    tables["resets"] |= {"schedule": "law"}
    velocities = _format_velocities(
        reset_problem(study.rate_hz or 100.0, point).velocity for _, point in iter_filters(study)
    )
    comment = (
        '# Resets by the law: schedule = "law" also opens P of velocity at each reset. Listed times'
        f"\n# need it too: reset_velocity_m_per_s = {velocities}\n\n"
    )
    return comment + tomli_w.dumps({name: table for name, table in tables.items() if table})


def _describe_settings(plans: Sequence[ResetPlan]) -> str:
    """Return how to set the resets of some plans."""
    velocities = _format_velocities(plan.problem.velocity for plan in plans)
    return f'schedule = "law", or these times with reset_velocity_m_per_s = {velocities}'


def _format_velocities(velocities: Iterable[float]) -> str:
    return " or ".join(f"{velocity:.4g}" for velocity in sorted({*velocities}))


def _has_drift(study: Study, key: str) -> bool:
    if key in study.drawn_keys:
        return True
    return study.is_readable(key) and any(np.any(value or 0.0) for value in study.values(key))


def _describe_filter(plan: ResetPlan) -> str:
    force = "measured force" if plan.problem.is_force_measured else "the force of gravity"
    return f"kalman5 with {force} in A(t), feedback every {plan.problem.feedback_s:g} s"


def _warnings(plan: ResetPlan) -> Iterator[str]:
    """Yield where the law is known to fail."""
    problem, bound = plan.problem, plan.heading_bound_deg * DEG
    if plan.left_out:
        yield f"{' and '.join(plan.left_out)}, which the prediction leaves out, delay settling"
    if problem.feedback_s >= _SLOW_FEEDBACK_S:
        yield f"feedback every {problem.feedback_s:g} s decides: some runs may never settle"
    elif problem.feedback_s > reset_law.levelling_time(problem):
        yield f"feedback every {problem.feedback_s:g} s is slower than levelling: its lag is fitted"
    if bound > _LARGE_BOUND:
        yield "near 180 deg a heading error stands still: an unstable equilibrium"
    if problem.level > _LARGE_LEVEL:
        yield "P0 of level above 30 deg is beyond the cells that were measured"


def _format_time(time_s: float) -> str:
    return f"{time_s:,.0f} s" if math.isfinite(time_s) else "never"

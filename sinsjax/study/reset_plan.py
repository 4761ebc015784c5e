"""What the law of resets says of a study: the times, their prediction, and when to distrust it."""

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import tomli_w

from sinsjax.errors import InputError
from sinsjax.methods import reset_law
from sinsjax.methods.filters.section import OF_SCHEDULES
from sinsjax.methods.reset_law import ResetProblem, ResetSchedule, predicted_settling_time
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

_LIMITED_BY_R, _LIMITED_BY_Q = 1.0, 10.0  # segments in tau
_MOVED = 0.2  # share by which the last reset is moved, to tell how flat the optimum is
_NOT_WORTH = 0.9  # of the time without resets
_LARGE_BOUND, _KNOWN_BOUND, _LARGE_LEVEL = 165 * DEG, 25 * DEG, 30 * DEG
_SLOW_FEEDBACK_S = 20.0
_MAX_PLANS = 15


class ResetPlan(NamedTuple):
    """The schedule of a filter by the law, and what it is worth; times in s.

    Attributes:
        problem: the filter and its place.
        heading_bound_deg: largest initial heading error that it settles, deg.
        band_arcmin: heading error within which a run is settled, arcmin.
        times_s: times of the resets.
        settling_s: time within which the bound settles, with two sigma of noise.
        median_s: settling time of a median run from the bound.
        without_s: the same without resets and with levels of 5 deg; inf if never.
        by_segments: settling times with one to four segments after the early resets.
        warnings: where the law is known to fail.
    """

    problem: ResetProblem
    heading_bound_deg: float
    band_arcmin: float
    times_s: tuple[float, ...]
    settling_s: float
    median_s: float
    without_s: float
    by_segments: tuple[float, ...]
    warnings: tuple[str, ...]

    @property
    def segment_s(self) -> float:
        """Length of the segment before the last reset, or of the only one, s."""
        times = (*self.times_s, self.settling_s)
        return times[-2] - times[-3] if len(times) > 4 or len(times) == 3 else times[-1] - times[-2]

    @property
    def limited_by(self) -> str:
        """What limits the information of a segment: "Q", "R" or "Q and R"."""
        x = self.segment_s / self.problem.tau
        return "R" if x < _LIMITED_BY_R else "Q" if x > _LIMITED_BY_Q else "Q and R"

    def moved_last_reset_s(self, factor: float) -> float:
        """Return the settling time of a median run with the last reset moved by a factor, s."""
        *early, last = self.times_s
        begin = early[-1] if early else 0.0
        times = (*early, begin + (last - begin) * factor)
        return _median_time(self.problem, times, self.heading_bound_deg, self.band_arcmin)

    @property
    def facts(self) -> dict[str, str]:
        """The plan in words, by heading."""
        bound, band = f"{self.heading_bound_deg:g} deg", f"{self.band_arcmin:g}'"
        share = self.median_s / self.without_s
        worth = f"{share:.2g} of the time without resets" if math.isfinite(self.without_s) else (
            "without resets it never settles"
        )  # fmt: skip
        counts = ", ".join(
            f"{n}: {_format_time(time)}" for n, time in enumerate(self.by_segments, start=1)
        )
        factor = reset_law.contraction(self.segment_s, self.problem)
        moved = [self.moved_last_reset_s(1 + sign * _MOVED) / self.median_s - 1 for sign in (-1, 1)]
        return {
            "resets": f"{', '.join(f'{time:g}' for time in self.times_s)} s",
            "settles": f"within {band} from {bound}: {_format_time(self.median_s)} for a median"
            f" run, {_format_time(self.settling_s)} with 2 sigma of noise",
            "without": _format_time(self.without_s),
            "segments": f"after the early resets, with 2 sigma: {counts}",
            "filter": f"limited by its {self.limited_by} (tau {self.problem.tau:.3g} s): a segment"
            f" of {self.segment_s:.3g} s contracts the heading error {factor:.3g} times",
            "flat": f"the last reset {_MOVED:.0%} earlier {moved[0]:+.0%}, later {moved[1]:+.0%}",
            "worth": f"{'yes' if share < _NOT_WORTH else 'hardly'}: {worth}",
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
    for varying, point in iter_filters(study, **bounds):
        try:
            plan = _make_plan(study.rate_hz or 100.0, point)
        except InputError as error:
            raise error.with_source(study.name) from None
        yield varying, plan


def iter_filters(
    study: Study, **bounds: float
) -> Iterator[tuple[dict[str, Any], Mapping[str, Any]]]:
    """Yield what distinguishes each filter and place of a study, and its values of `LAW_KEYS`.

    Raises:
        InputError: no method of the study has the law.
    """
    keys = [key for key in (*LAW_KEYS, *DERIVED) if study.is_readable(key) and key not in bounds]
    keys = [key for key in keys if key not in (*DERIVED, "schedule")]
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
        lines.append(f"  {what}: {times} s; {_format_time(plan.median_s)} (without: {without})")
    if left := len(plans) - _MAX_PLANS:
        lines += [f"  and {left} more"] if left > 0 else []
    warnings = dict.fromkeys(text for _, plan in plans for text in plan.warnings)
    return [*lines, *(f"Warning, of some: {text}." for text in warnings)]


def with_law(study: Study) -> str:
    """Return a study with its resets by the law, as TOML without defaults."""
    given = {key for key in (*OF_SCHEDULES, "reset_trigger") if study.is_readable(key)}
    tables = {name: dict(table) for name, table in study.to_dict().items() if name != "cases"}
    for name in ("resets", "axes"):
        table = tables.get(name, {})
        tables[name] = {key: value for key, value in table.items() if key not in given}
    tables["resets"] |= {"schedule": "law"}
    return tomli_w.dumps({name: table for name, table in tables.items() if table})


def _describe_filter(plan: ResetPlan) -> str:
    force = "measured force" if plan.problem.is_force_measured else "the force of gravity"
    return f"kalman5 with {force} in A(t), feedback every {plan.problem.feedback_s:g} s"


def _make_plan(rate_hz: float, point: Mapping[str, Any]) -> ResetPlan:
    found = schedule_by_law(rate_hz, point)
    assert isinstance(found, ResetSchedule)
    problem = reset_problem(rate_hz, point)
    bound_deg, band = point["heading_bound_deg"], point["settle_band_arcmin"]
    by_segments = (
        reset_law.schedule(problem, bound_deg * DEG, band * ARCMIN, n).settling_s
        for n in range(1, 5)
    )
    tilt = math.sqrt(2) * 5 * DEG
    without = predicted_settling_time(problem, (), bound_deg * DEG, tilt, band * ARCMIN)
    plan = ResetPlan(
        problem,
        bound_deg,
        band,
        found.times_s,
        found.settling_s,
        _median_time(problem, found.times_s, bound_deg, band),
        without,
        tuple(by_segments),
        (),
    )
    return plan._replace(warnings=tuple(_warnings(plan)))


def _median_time(
    problem: ResetProblem, times: tuple[float, ...], bound_deg: float, band_arcmin: float
) -> float:
    return predicted_settling_time(problem, times, bound_deg * DEG, 0.0, band_arcmin * ARCMIN)


def _warnings(plan: ResetPlan) -> Iterator[str]:
    """Yield where the law is known to fail."""
    problem, bound = plan.problem, plan.heading_bound_deg * DEG
    if plan.limited_by != "Q" and bound > 2.0:
        yield "limited by R, a heading error of 150 deg takes 1.5 to 2.1 times as long as predicted"
    if problem.feedback_s >= _SLOW_FEEDBACK_S:
        yield f"feedback every {problem.feedback_s:g} s decides: some runs may never settle"
    elif problem.feedback_s > reset_law.levelling_time(problem):
        yield f"feedback every {problem.feedback_s:g} s is slower than levelling: its lag is fitted"
    if bound > _LARGE_BOUND:
        yield "near 180 deg a heading error stands still: an unstable equilibrium"
    if bound <= _KNOWN_BOUND and problem.is_force_measured:
        yield "of a heading known to 20 deg the trigger settles as fast, and need not reset"
    if problem.level > _LARGE_LEVEL:
        yield "P0 of level above 30 deg is beyond the cells that were measured"
    if plan.median_s > _NOT_WORTH * plan.without_s:
        yield "resets hardly pay: the filter settles as fast without them"


def _format_time(time_s: float) -> str:
    return f"{time_s:,.0f} s" if math.isfinite(time_s) else "never"

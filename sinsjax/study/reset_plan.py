"""The resets of a study's filters by the law, and the settling times that it predicts."""

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from sinsjax.errors import InputError
from sinsjax.messages import format_facts
from sinsjax.methods.reset_law import ResetProblem, predict_settling_time
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

_TILT = 5 * (1 + 1j) * DEG  # of the start


class ResetPlan(NamedTuple):
    """The schedule of a filter by the law, and its predicted settling time; times in s.

    Settling times are those of a median run from the heading bound and 5 deg of level about both
    axes; inf if it does not settle. They hold for resets that open P as `settings` does;
    instability and random walks of the biases delay them.

    Attributes:
        problem: the filter and its place.
        heading_bound_deg: largest initial heading error that the schedule settles, deg.
        band_arcmin: heading error within which a run is settled, arcmin.
        times_s: times of the resets.
        settling_s: settling time with these resets.
        without_s: settling time without resets.

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
    without_s: float

    @property
    def settings(self) -> dict[str, Any]:
        """The keys of [resets] that list these resets, as ``schedule = "law"`` sets them."""
        velocity = float(f"{self.problem.velocity:.9g}")
        return {"reset_times_s": [*self.times_s], "reset_velocity_m_per_s": velocity}

    def __repr__(self) -> str:
        """Return the plan in lines."""
        velocity = self.settings["reset_velocity_m_per_s"]
        facts = {
            "resets": f"{', '.join(f'{time:g}' for time in self.times_s)} s",
            "set": f'schedule = "law", or these times with reset_velocity_m_per_s = {velocity:.4g}',
            "settles": f"within {self.band_arcmin:g}' from {self.heading_bound_deg:g} deg:"
            f" {_format_time(self.settling_s)} (median run, predicted)",
            "without": _format_time(self.without_s),
        }
        return format_facts("Reset schedule by the law", facts)


def _format_time(time_s: float) -> str:
    return f"{time_s:,.0f} s" if math.isfinite(time_s) else "never"


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
    study = load_study(study)
    plans = [_plan_resets(study, point) for _, point in iter_filters(study, **bounds)]
    if len(plans) != 1:
        text = f"{len(plans)} filters or places (use sinsjax schedule, or replace their keys)"
        raise InputError(f"{study.name}: has {text}")
    return plans[0]


def iter_filters(
    study: Study, **bounds: float
) -> Iterator[tuple[dict[str, Any], Mapping[str, Any]]]:
    """Yield what distinguishes each filter and place of a study, and its values of `LAW_KEYS`."""
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


def _plan_resets(study: Study, point: Mapping[str, Any]) -> ResetPlan:
    """Return the plan of a filter and place."""
    rate_hz = study.rate_hz or 100.0
    try:
        found = schedule_by_law(rate_hz, point)
    except InputError as error:
        raise error.with_source(study.name) from None
    assert found is not None
    problem, times_s = reset_problem(rate_hz, point), found.times_s
    bound, band = point["heading_bound_deg"], point["settle_band_arcmin"]
    run_s, start = max(study.run_s, 3 * found.settling_s), (bound * DEG, _TILT, band * ARCMIN)
    settling_s = predict_settling_time(problem, times_s, run_s, *start)
    without_s = predict_settling_time(problem, (), run_s, *start)
    return ResetPlan(problem, bound, band, times_s, settling_s, without_s)


def describe_plans(study: Study) -> list[str]:
    """Return the plans of a study for a terminal, of each filter and place."""
    lines = [f"{study.name}:"]
    for varying, point in iter_filters(study):
        if varying:
            lines.append(", ".join(f"{key} {format_toml(value)}" for key, value in varying.items()))
        lines += repr(_plan_resets(study, point)).splitlines()[1:]
    return lines

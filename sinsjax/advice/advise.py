"""Advice: from a sheet by the bounds to the heading to expect, its budget, method and warnings."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w

from sinsjax.advice import method as methods
from sinsjax.advice.heading import (
    SOURCES,
    Budget,
    format_angle,
    heading_budget,
    sheet_problem,
    wrapped_quantile,
    wrapped_rms,
)
from sinsjax.advice.method import Choice, choose_method
from sinsjax.advice.sheet import MOTIONS, Sheet, read_sheet
from sinsjax.bounds.information import heading_bound
from sinsjax.bounds.turn_planner import SHORTEST_S, TurnChoice, compare_turns
from sinsjax.methods.filters.keys import level_surge
from sinsjax.units import ARCMIN, DEG

_BANDS_DEG = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
_MOST_TIMES = 60
_COARSE, _NOT_FOUND = 0.1, 0.5  # rad, above which errors are not small, and show no north
_ROTATES_DEG = 0.5


class Heading(NamedTuple):
    """The heading error to expect after a time.

    Attributes:
        time_s: length of the data, s.
        rms_arcmin: root mean square, from true north.
        within_95_arcmin: what 95 % of the alignments stay within.
    """

    time_s: float
    rms_arcmin: float
    within_95_arcmin: float


@dataclass(frozen=True)
class Advice:
    """Advice for an IMU; made by `sinsjax.advise`.

    Attributes:
        sheet: what was asked.
        choice: the method and its settings.
        budget: variance of the method's heading by source, over time.
        bound_arcmin: information bound of the heading at the time asked for, 1 sigma of linear
            theory, arcmin.
        turns: the base as it is, and turned in usual ways, with the same method; None if the sheet
            turns the base itself.

    Examples:
        >>> advice = sinsjax.advise(imu="kvh1775", latitude_deg=48.0, motion="rocking")
        >>> advice.choice.method, advice.dominant, round(advice.heading.rms_arcmin)
        ('gravity_fit', 'gyro_bias', 68)
    """

    sheet: Sheet
    choice: Choice
    budget: Budget
    bound_arcmin: float
    turns: TurnChoice | None

    @property
    def time_s(self) -> float:
        """Time that there is to align, s."""
        return self.sheet.asked.time_s

    @cached_property
    def headings(self) -> tuple[Heading, ...]:
        """The heading error to expect at each time of the budget."""
        return _expected_headings(self.choice, self.budget)

    @property
    def heading(self) -> Heading:
        """The heading error to expect at the time asked for."""
        return next(one for one in self.headings if one.time_s == self.time_s)

    @property
    def shares(self) -> dict[str, float]:
        """Part of each source in the variance at the time asked for, the largest first."""
        return self.budget.shares(self.time_s)

    @property
    def dominant(self) -> str:
        """The largest source, by its name in `SOURCES`."""
        return next(iter(self.shares))

    @cached_property
    def halved_rms_arcmin(self) -> float:
        """Rms heading error at the time asked for, arcmin, with half of the dominant source."""
        return _rms_at_the_end(scale_source(self.sheet, self.dominant, 0.5))

    @property
    def sigma(self) -> float:
        """1 sigma of the method's heading at the time asked for, rad, before it is wrapped."""
        (here,) = np.flatnonzero(self.budget.times_s == self.time_s)
        return self.choice.expected_sigma(self.budget.sigma[here], self.budget.varying[here])

    @property
    def loss(self) -> float:
        """Error of the method over the bound at the time asked for."""
        return self.sigma / (self.bound_arcmin * ARCMIN)

    @property
    def settles(self) -> tuple[float, float | None]:
        """A band, deg, and the time from which 95 % of the headings are within it, s, if any.

        The band is the one wanted, or a round one that is reached well before the end.
        """
        within = {one.time_s: one.within_95_arcmin / 60 for one in self.headings}
        wide = (one for one in _BANDS_DEG if one > 1.3 * within[self.time_s])
        band = self.sheet.asked.wanted_deg or next(wide, _BANDS_DEG[-1])
        times = [time for time in within if time <= self.time_s]
        late = [time for time in times if within[time] > band]
        return band, min((time for time in times if time > max(late, default=0.0)), default=None)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What can go wrong, a line each."""
        return tuple(_iter_warnings(self))

    def study(self) -> str:
        """Return the Monte Carlo study that confirms the advice, as TOML."""
        band = 60 * self.settles[0]
        settings = {"success_band_arcmin": band, "settle_bands_arcmin": [band]}
        sections = {name: dict(table) for name, table in self.choice.sections.items()}
        if self.choice.method == methods.FILTER:
            sections["alignment"] |= {"misalignment": "euler"}
            anywhere = {"phi_u0_deg": {"uniform": [-180.0, 180.0]}}
            sections["drawn"] = self.sheet.tables["drawn"] | anywhere
        tables = self.sheet.study_tables(sections, judged_from="truth", **settings)
        comment = (
            "# Written by sinsjax advise: the sheet with the method it names, to be confirmed by\n"
            "#   sinsjax sweep FILE -o out\n\n"
        )
        return comment + tomli_w.dumps(tables)

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers alone, as for JSON."""
        here, (band, settled), sheet = self.heading, self.settles, self.sheet
        cosine = math.cos(sheet.latitude_deg * DEG)
        return {
            "name": sheet.name,
            "latitude_deg": sheet.latitude_deg,
            "motion": sheet.motion,
            "time_s": self.time_s,
            "heading_rms_arcmin": here.rms_arcmin,
            "heading_95_arcmin": here.within_95_arcmin,
            "heading_rms_sec_latitude_arcmin": here.rms_arcmin * cosine,
            "bound_arcmin": self.bound_arcmin,
            "headings": [one._asdict() for one in self.headings if one.time_s in sheet.times_s],
            "budget_percent": {SOURCES[key].words: 100 * part for key, part in self.shares.items()},
            "dominant": SOURCES[self.dominant].words,
            "heading_rms_with_half_of_dominant_arcmin": self.halved_rms_arcmin,
            "band_deg": band,
            "settles_s": settled,
            "method": self.choice.method,
            "settings": self.choice.sections,
            "loss": self.loss,
            "turns": [one._asdict() for one in self.turns.options] if self.turns else None,
            "warnings": list(self.warnings),
            "doubts": list(sheet.doubts),
        }

    def __repr__(self) -> str:
        """Return the main numbers; `sinsjax.advice.text.describe_advice` yields all of them."""
        rms = f"{self.heading.rms_arcmin:.3g} arcmin rms after {self.time_s:g} s"
        return f"Advice for {self.sheet.name}: {rms} with {self.choice.method}"


def advise(
    sheet: str | Path | Mapping[str, Any] | None = None,
    *,
    imu: str | None = None,
    latitude_deg: float | None = None,
    time_s: float | None = None,
    motion: str | None = None,
    changes: Mapping[str, Any] | None = None,
) -> Advice:
    """Return what to expect of an IMU at rest, and what to do with it, without a Monte Carlo run.

    Args:
        sheet: file, or nested dictionaries: an ordinary study without an alignment. [sensors] has
            the noise of the data sheet, [drawn] the turn-on biases as ``{normal = [0.0, SIGMA]}``,
            [earth] the latitude, [motion] what moves, and [advise] ``time_s`` and ``wanted_deg``.
        imu: name of a shipped sheet instead, such as "kvh1775".
        latitude_deg: latitude, deg, in place of that of the sheet.
        time_s: time that there is to align, s, likewise.
        motion: "still", "rocking" or "surging", likewise; see `MOTIONS` for their numbers.
        changes: values by ``section.key`` that replace those of the sheet.

    Raises:
        InputError: the sheet is not valid, or lacks the white noise of its sensors.

    Examples:
        >>> advice = sinsjax.advise(
        ...     {
        ...         "earth": {"latitude_deg": 48.0},
        ...         "sensors": {"gyro_arw_deg_per_sqrt_h": 0.005, "accel_vrw_ug_per_sqrt_hz": 30.0},
        ...         "drawn": {
        ...             "gyro_bias_deg_per_h": {"normal": [0.0, 0.05]},
        ...             "accel_bias_ug": {"normal": [0.0, 200.0]},
        ...         },
        ...     },
        ...     time_s=300.0,
        ... )
        >>> round(advice.heading.rms_arcmin), advice.dominant, advice.choice.method
        (18, 'gyro_bias', 'gravity_fit')
    """
    given = read_sheet(
        sheet, imu=imu, latitude_deg=latitude_deg, time_s=time_s, motion=motion, changes=changes
    )
    choice, problem = choose_method(given), sheet_problem(given)
    left_out, asked_s = methods.LEFT_OUT[choice.method], given.asked.time_s
    curve_s = np.geomspace(SHORTEST_S, max(given.times_s), _MOST_TIMES)
    times_s = sorted({*given.times_s, *(float(round(time)) for time in curve_s)})
    (bound,) = heading_bound([asked_s], problem)
    return Advice(
        sheet=given,
        choice=choice,
        budget=heading_budget(problem, times_s, left_out),
        bound_arcmin=float(bound / ARCMIN),
        turns=None if given.is_turned else compare_turns(problem, asked_s, left_out),
    )


def scale_source(sheet: Sheet, source: str, factor: float) -> Sheet:
    """Return a sheet with another size of one source of errors, see `heading.SOURCES`."""
    tables = {name: dict(table) for name, table in sheet.tables.items()}
    key = SOURCES[source].key
    for name in ("sensors", "motion"):
        if key in tables[name]:
            tables[name][key] = (np.asarray(tables[name][key]) * factor).tolist()
    if key in tables["drawn"]:
        tables["drawn"][key] = {"normal": [0.0, factor * sheet.sigma(key)]}
    return replace(sheet, tables=tables)


def _expected_headings(choice: Choice, budget: Budget) -> tuple[Heading, ...]:
    sigmas = map(choice.expected_sigma, budget.sigma, budget.varying)
    return tuple(
        Heading(float(time_s), wrapped_rms(sigma) / ARCMIN, wrapped_quantile(sigma, 0.95) / ARCMIN)
        for time_s, sigma in zip(budget.times_s, sigmas, strict=True)
    )


def _rms_at_the_end(sheet: Sheet) -> float:
    """Return the rms heading error of a sheet at the time asked for, arcmin."""
    choice, problem = choose_method(sheet), sheet_problem(sheet)
    budget = heading_budget(problem, [sheet.asked.time_s], methods.LEFT_OUT[choice.method])
    return _expected_headings(choice, budget)[0].rms_arcmin


def _iter_warnings(advice: Advice) -> Iterator[str]:
    if advice.sigma > _NOT_FOUND:
        more = "; an IMU that is turned may find it (docs/turning.md)" if advice.turns else ""
        yield f"north is not found, for the {SOURCES[advice.dominant].words}{more}"
    elif advice.sigma > _COARSE:
        yield "beyond linear theory: 20 % more or less are possible"
    motion, surging = advice.sheet.motion, MOTIONS["surging"]
    angles_deg = [motion.get(key, 0.0) for key in MOTIONS["rocking"] if "amplitude" in key]
    if np.max(np.abs(angles_deg)) > _ROTATES_DEG and not level_surge(motion.get("surge_m_per_s")):
        moved = motion | {key: value for key, value in surging.items() if key.startswith("surge")}
        surged = replace(advice.sheet, tables=advice.sheet.tables | {"motion": moved})
        yield (
            f"the base is assumed to rotate without moving: a surge of"
            f" {surging['surge_m_per_s']:g} m/s rms would make it"
            f" {format_angle(_rms_at_the_end(surged))} (--motion surging)"
        )

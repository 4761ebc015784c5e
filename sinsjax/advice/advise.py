"""Advice: the heading to expect, the error budget, the method with its settings, and doubts."""

import json
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
    KEYS,
    SOURCES,
    Budget,
    heading_budget,
    share_beyond,
    sheet_problem,
    wrapped_quantile,
    wrapped_rms,
)
from sinsjax.advice.method import Choice, choose_method
from sinsjax.advice.sheet import MOTIONS, Sheet, read_sheet, without_empty
from sinsjax.bounds.information import heading_bound
from sinsjax.bounds.turn_planner import SHORTEST_S, TurnChoice, compare_turns
from sinsjax.methods.filters.keys import level_surge
from sinsjax.study import display
from sinsjax.study.turns import DEFAULTS, useless_methods
from sinsjax.units import ARCMIN, DEG, DEG_PER_H, micro_g

_SHARE = 0.95
_BANDS_DEG = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
_MOST_TIMES = 60
_NOT_FOUND, _FAR = 0.5, 30 * DEG
_LARGE_SHARE = 0.2
_UG = micro_g(9.8)
_HIGH_LATITUDE_DEG = 75.0
_ROTATES_DEG = 0.5
_COARSE = 0.1  # rad, above which errors are no longer small


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
        headings: errors to expect, by time.
        choice: the method and its settings.
        budget: variance of the method's heading by source, over time.
        bound_arcmin: information bound of the heading at the time asked for, 1 sigma of linear
            theory, arcmin.
        turns: the base as it is, and turned in usual ways, with the same method; None if the sheet
            turns the base itself.

    Examples:
        >>> advice = sinsjax.advise(imu="kvh1775", latitude_deg=48.0, motion="rocking")
        >>> advice.heading.rms_arcmin < 2 * advice.bound_arcmin
        True
        >>> print(advice.choice.toml.partition("fit_accel")[0])
        [alignment]
        method = "gravity_fit"
        <BLANKLINE>
        [gravity_fit]
        fit_gyro_bias_deg_per_h = 0.167
        fit_gyro_arw_deg_per_sqrt_h = 0.012
        <BLANKLINE>
    """

    sheet: Sheet
    headings: tuple[Heading, ...]
    choice: Choice
    budget: Budget
    bound_arcmin: float
    turns: TurnChoice | None

    @property
    def name(self) -> str:
        """Name of the sheet."""
        return str(self.sheet.tables["study"]["name"])

    @property
    def time_s(self) -> float:
        """Time that there is to align, s."""
        return self.sheet.asked.time_s

    @property
    def heading(self) -> Heading:
        """The heading error to expect at the time asked for."""
        return next(one for one in self.headings if one.time_s == self.time_s)

    @property
    def latitude_deg(self) -> float:
        """Latitude, deg."""
        return float(self.sheet.tables["earth"]["latitude_deg"])

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

    @cached_property
    def surging_rms_arcmin(self) -> float:
        """Rms heading error at the time asked for, arcmin, if the base surged as by `MOTIONS`."""
        motion = self.sheet.tables["motion"]
        surge = {key: v for key, v in MOTIONS["surging"].items() if key.startswith("surge")}
        return _rms_at_the_end(
            replace(self.sheet, tables=self.sheet.tables | {"motion": motion | surge})
        )

    @property
    def sigma(self) -> float:
        """1 sigma of the method's heading at the time asked for, rad, before it is wrapped."""
        (here,) = np.flatnonzero(self.budget.times_s == self.time_s)
        return self.choice.expected_sigma(self.budget.sigma[here], self.budget.varying[here])

    @property
    def loss(self) -> float:
        """Error of the method over the bound at the time asked for."""
        return self.sigma / (self.bound_arcmin * ARCMIN)

    @cached_property
    def misses_turns(self) -> bool:
        """Whether the base is turned and the method cannot use it, though the bound does."""
        return any(useless_methods(self.sheet.study(self.choice.sections)))

    @property
    def is_coarse(self) -> bool:
        """Whether the error at the time asked for is beyond linear theory."""
        return self.bound_arcmin * ARCMIN > _COARSE

    @property
    def settles(self) -> tuple[float, float | None]:
        """A band, deg, and the time from which 95 % of the headings are within it, s, if any.

        The band is the one wanted, or a round one that is reached well before the end.
        """
        within = {one.time_s: one.within_95_arcmin / 60 for one in self.headings}
        band = self.sheet.asked.wanted_deg
        if band is None:
            reached = within[self.time_s]
            band = next((one for one in _BANDS_DEG if one > 1.3 * reached), _BANDS_DEG[-1])
        times = [time for time in within if time <= self.time_s]
        late = [time for time in times if within[time] > band]
        return band, min((time for time in times if time > max(late, default=0.0)), default=None)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What can go wrong, a line each."""
        return tuple(_iter_warnings(self))

    def study(self) -> str:
        """Return the Monte Carlo study that confirms the advice, as TOML."""
        settings = dict(self.sheet.tables["study"])
        band = 60 * self.settles[0]
        settings |= {"judged_from": "truth", "success_band_arcmin": band}
        settings |= {"settle_bands_arcmin": [band]}
        tables = dict(self.sheet.tables)
        sections = {name: dict(table) for name, table in self.choice.sections.items()}
        if self.choice.method == methods.FILTER:
            sections["alignment"] |= {"misalignment": "euler"}
            known = self.sheet.asked.known_heading_deg
            law = {"normal": [0.0, known]} if known else {"uniform": [-180.0, 180.0]}
            tables["drawn"] = tables["drawn"] | {"phi_u0_deg": law}
        comment = (
            "# Written by sinsjax advise: the sheet with the method it names, to be confirmed by\n"
            "#   sinsjax sweep FILE -o out\n\n"
        )
        return comment + tomli_w.dumps(without_empty(tables | sections | {"study": settings}))

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers alone, as for JSON."""
        here, shares = self.heading, self.shares
        band, settled = self.settles
        return {
            "name": self.name,
            "latitude_deg": self.latitude_deg,
            "motion": self.sheet.tables["motion"],
            "time_s": self.time_s,
            "heading_rms_arcmin": here.rms_arcmin,
            "heading_95_arcmin": here.within_95_arcmin,
            "heading_rms_sec_latitude_arcmin": here.rms_arcmin * self._cos_latitude,
            "bound_arcmin": self.bound_arcmin,
            "headings": [
                one._asdict() for one in self.headings if one.time_s in self.sheet.times_s
            ],
            "budget_percent": {SOURCES[key]: 100 * share for key, share in shares.items()},
            "dominant": SOURCES[self.dominant],
            "heading_rms_with_half_of_dominant_arcmin": self.halved_rms_arcmin,
            "band_deg": band,
            "settles_s": settled,
            "method": self.choice.method,
            "settings": self.choice.sections,
            "loss": self.loss,
            "turns": [one._asdict() for one in self.turns.options] if self.turns else None,
            "warnings": list(self.warnings),
            "doubts": list(self.sheet.doubts),
        }

    def __repr__(self) -> str:
        """Return the main numbers; `sinsjax.advice.text.describe_advice` has all of them."""
        here, shares = self.heading, self.shares
        facts = {
            "heading": f"{here.rms_arcmin:.3g} arcmin rms after {self.time_s:g} s",
            "95 %": f"within {here.within_95_arcmin:.3g} arcmin",
            "budget": ", ".join(f"{SOURCES[key]} {part:.0%}" for key, part in shares.items()),
            "method": self.choice.method,
        }
        facts |= {f"warning {k}": text for k, text in enumerate(self.warnings, start=1)}
        return display.format_text(f"Advice for {self.name}", facts)

    @property
    def _cos_latitude(self) -> float:
        return math.cos(self.latitude_deg * DEG)


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
            [earth] the latitude, [motion] what moves, and [advise] ``time_s``, ``wanted_deg`` and
            ``known_heading_deg``.
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
    return advise_sheet(
        read_sheet(
            sheet, imu=imu, latitude_deg=latitude_deg, time_s=time_s, motion=motion, changes=changes
        )
    )


def advise_sheet(given: Sheet) -> Advice:
    """Return the advice for a sheet that was read."""
    choice, problem = choose_method(given), sheet_problem(given)
    left_out = methods.LEFT_OUT[choice.method]
    budget = heading_budget(problem, _times(given), left_out)
    (bound,) = heading_bound([given.asked.time_s], problem)
    return Advice(
        sheet=given,
        headings=tuple(_iter_headings(choice, budget)),
        choice=choice,
        budget=budget,
        bound_arcmin=float(bound / ARCMIN),
        turns=None if given.is_turned else compare_turns(problem, given.asked.time_s, left_out),
    )


def _rms_at_the_end(sheet: Sheet) -> float:
    """Return the rms heading error of a sheet at the time asked for, arcmin."""
    choice, time_s = choose_method(sheet), sheet.asked.time_s
    left_out = methods.LEFT_OUT[choice.method]
    (heading,) = _iter_headings(choice, heading_budget(sheet_problem(sheet), [time_s], left_out))
    return heading.rms_arcmin


def _times(sheet: Sheet) -> list[float]:
    """Return the times of the budget: those to report, and more for the curve, in whole steps."""
    last = max(sheet.times_s)
    curve = np.geomspace(SHORTEST_S, last, _MOST_TIMES)
    return sorted({*sheet.times_s, *(float(round(time)) for time in curve)})


def _iter_headings(choice: Choice, budget: Budget) -> Iterator[Heading]:
    """Yield the heading error of a method at each time of its budget."""
    for time_s, *sigmas in zip(budget.times_s, budget.sigma, budget.varying, strict=True):
        expected = choice.expected_sigma(*sigmas)
        rms, within = wrapped_rms(expected), wrapped_quantile(expected, _SHARE)
        yield Heading(float(time_s), rms / ARCMIN, within / ARCMIN)


def scale_source(sheet: Sheet, source: str, factor: float) -> Sheet:
    """Return a sheet with another size of one source of errors, see `heading.KEYS`."""
    tables = {name: dict(table) for name, table in sheet.tables.items()}
    for key in KEYS[source]:
        for name in ("sensors", "motion"):
            if key in tables[name]:
                tables[name][key] = (np.asarray(tables[name][key]) * factor).tolist()
        if key in tables["drawn"]:
            tables["drawn"][key] = {"normal": [0.0, factor * sheet.sigma(key)]}
    return replace(sheet, tables=tables)


def _iter_warnings(advice: Advice) -> Iterator[str]:
    """Yield what can go wrong."""
    here, asked, shares = advice.heading, advice.sheet.asked, advice.shares
    motion = advice.sheet.tables["motion"]
    within_deg = here.within_95_arcmin / 60
    if asked.wanted_deg is not None and within_deg > asked.wanted_deg:
        last = advice.headings[-1]
        text = f"95 % stay within {format_angle(here.within_95_arcmin)}"
        text += f", not {format_angle(60 * asked.wanted_deg)}"
        if last.within_95_arcmin / 60 > asked.wanted_deg and advice.turns is not None:
            text += f"; no method at rest gets under {format_angle(last.within_95_arcmin)}"
            text += f" in {last.time_s:g} s"
        yield text
    sigma = advice.sigma
    if sigma > _COARSE:
        far = f"{share_beyond(sigma, _FAR):.0%} of the headings are off by more than 30 deg"
        if sigma > _NOT_FOUND:
            turns, more = advice.turns, ""
            if turns is not None and turns.best.sigma_arcmin * ARCMIN < _COARSE:
                more = f"; an IMU that is turned finds it: {_describe_turn_keys(turns)}"
            yield f"north is not found: {far}, for the {SOURCES[advice.dominant]}{more}"
        else:
            yield f"beyond linear theory: 20 % more or less are possible, and {far}"
    if advice.misses_turns:
        yield (
            f"{methods.FILTER} does not estimate gyro biases, so the turns of the base hardly help"
            " (turn without surge, for gravity_fit)"
        )
    if _rotates(motion) and not level_surge(motion.get("surge_m_per_s")):
        surge = MOTIONS["surging"]["surge_m_per_s"]
        yield (
            f"the base is assumed to rotate without moving: a surge of {surge:g} m/s rms would make"
            f" it {format_angle(advice.surging_rms_arcmin)} (--motion surging)"
        )
    if abs(advice.latitude_deg) >= _HIGH_LATITUDE_DEG:
        factor = f"{1 / advice._cos_latitude:.3g}"
        yield f"errors grow with sec L, which is {factor} at this latitude"
    if shares.get("surge", 0.0) > _LARGE_SHARE:
        yield (
            "the surge of the base is taken for a process of known rms and correlation time"
            " (surge_m_per_s, surge_time_s); a gust or a step that is not like it costs more"
        )
    if (speed := _swing_speed(motion)) > 0.5 * methods.accel_density(advice.sheet) * _UG:
        yield (
            f"angular vibration swings the sensors at the end of the lever arm at {speed:.2g} m/s"
            f" rms, of which {advice.choice.method} knows nothing: errors are above the numbers"
            " here, up to 100 times"
        )
    known = asked.known_heading_deg
    if known is not None and known * 60 < here.rms_arcmin:
        yield (
            f"the heading known before, {format_angle(60 * known)}, is better than what these data"
            " give: keep it"
        )


def _rotates(motion: Mapping[str, Any]) -> bool:
    """Return whether the base sways by more than half a degree."""
    amplitudes = (motion.get(f"{axis}_amplitude_deg", 0.0) for axis in ("pitch", "roll", "yaw"))
    return any(np.any(np.abs(amplitude) > _ROTATES_DEG) for amplitude in amplitudes)


def _describe_turn_keys(turns: TurnChoice) -> str:
    """Return the options that turn the base of a sheet, once if that finds the heading."""
    simple = (one for one in turns.options if one.name == "half turn")
    option = next((one for one in simple if one.sigma_arcmin * ARCMIN < _COARSE), turns.best)
    motion = option.motion.items()
    changes = {key: value for key, value in motion if value != DEFAULTS.get(key)}
    return " ".join(f"--set 'motion.{key}={json.dumps(value)}'" for key, value in changes.items())


def _swing_speed(motion: Mapping[str, Any]) -> float:
    """Return the rms speed, m/s, at which angular vibration moves the end of the lever arm."""
    rate, arm = motion.get("vibration_deg_per_h_rms", 0.0), motion.get("lever_arm_m", 0.0)
    return float(np.max(np.abs(rate)) * DEG_PER_H * np.max(np.abs(arm)))


def format_angle(arcmin: float) -> str:
    """Return an angle, arcmin, in degrees where it is large."""
    if arcmin < 100:
        return f"{arcmin:.1f}'" if arcmin < 20 else f"{arcmin:.0f}'"
    return f"{arcmin / 60:.1f} deg" if arcmin < 600 else f"{arcmin / 60:.0f} deg"

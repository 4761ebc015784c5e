"""Advice from a sheet: the method for it, the heading error to expect, its sources and warnings."""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w
from scipy import special

from sinsjax.advice.sheet import AXES, MOTIONS, Sheet, read_sheet, rms
from sinsjax.bounds.estimator import heading_variances
from sinsjax.bounds.information import HeadingProblem, heading_bound
from sinsjax.bounds.turn_planner import SHORTEST_S, TurnChoice, compare_turns
from sinsjax.execution.information import budget_problem
from sinsjax.methods.filters.keys import level_surge
from sinsjax.study.load import study_from_dict
from sinsjax.units import ARCMIN, DEG


class Source(NamedTuple):
    """A source of errors: its name in words, and its key."""

    words: str
    key: str


SOURCES = {
    "gyro_bias": Source("gyro turn-on bias", "gyro_bias_deg_per_h"),
    "accel_bias": Source("accelerometer turn-on bias", "accel_bias_ug"),
    "gyro_noise": Source("angle random walk", "gyro_arw_deg_per_sqrt_h"),
    "accel_noise": Source("velocity random walk", "accel_vrw_ug_per_sqrt_hz"),
    "gyro_instability": Source("gyro bias instability", "gyro_instability_deg_per_h"),
    "accel_instability": Source("accelerometer bias instability", "accel_instability_ug"),
    "gyro_walk": Source("gyro rate random walk", "gyro_rrw_deg_per_h_per_sqrt_h"),
    "accel_walk": Source("accelerometer random walk", "accel_rrw_ug_per_sqrt_h"),
    "gyro_quantisation": Source("gyro quantisation", "gyro_quantisation_arcsec"),
    "accel_quantisation": Source("accelerometer quantisation", "accel_quantisation_um_per_s"),
    "swing": Source("gyro quantisation at the end of the lever arm", "gyro_quantisation_arcsec"),
    "surge": Source("surge of the base", "surge_m_per_s"),
    "lever_arm": Source("lever arm", "lever_arm_m"),
    "shaking": Source("vibration", "vibration_ug_rms"),
    "gyro_scale": Source("gyro scale factor", "gyro_scale_ppm"),
    "gyro_misalignment": Source("gyro axis misalignment", "gyro_misalignment_arcsec"),
    "accel_scale": Source("accelerometer scale factor", "accel_scale_ppm"),
    "accel_misalignment": Source("accelerometer axis misalignment", "accel_misalignment_arcsec"),
}
"""Sources of errors by their names in `heading_variances`."""

_FIT, _FILTER = "gravity_fit", "kalman_surge"

_UNMODELLED = {
    _FIT: ("gyro_quantisation", "accel_quantisation", "swing", "shaking", "accel_scale"),
    _FILTER: tuple(SOURCES.keys() - {"gyro_noise", "accel_noise", "surge"}),
}
"""Sources of errors for which a method has no unknowns."""

_MOST_LOSS, _LOSS_PER_RAD = 0.2, 0.5  # of the filter, in large errors by the surge
_FITTED = (
    *("gyro_bias_deg_per_h", "gyro_arw_deg_per_sqrt_h", "accel_bias_ug"),
    *("accel_vrw_ug_per_sqrt_hz", "gyro_scale_ppm", "gyro_misalignment_arcsec"),
)
_SWING_AN_ARM = (*(f"{a}_amplitude_deg" for a in AXES), "turn_times_s", "attitude_file")
_LEAST_SHARE = 1e-9  # of a source that is in a budget
_CELLS = 4000
_RATE_HZ = 100.0
_BANDS_DEG = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
_MOST_TIMES = 60
_COARSE, _NOT_FOUND = 0.1, 0.5  # rad, above which errors are not small, and show no north
_ROTATES_DEG = 0.5
_LEAST_SHOWN = 0.005  # share of a source
_LOSES = 2.0  # error of a filter over the bound from which a fit may be better
_PAYS = 0.8  # largest share of the error that turns leave, if they pay
_HEADER = """\
# Written by sinsjax advise: the sheet with the method it names, to be confirmed by
#   sinsjax sweep FILE -o out"""


class Choice(NamedTuple):
    """A method for a sheet: its name, the sections of a study that set it, and why, in a clause."""

    method: str
    sections: dict[str, Any]
    reason: str


def choose_method(sheet: Sheet) -> Choice:
    """Return the method with the least error for a sheet."""
    motion = sheet.motion
    sigma = {key: float(f"{sheet.sigma(key):.4g}") for key in _FITTED}
    if surge := level_surge(motion.get("surge_m_per_s")):
        sections = {
            "alignment": {"method": _FILTER},
            "surge": {"r_surge_m_per_s": surge, "r_surge_time_s": float(motion["surge_time_s"])},
            "filter": {  # R, which is left out, follows the motion
                "q_reading": "psd",
                "q_gyro_arw_deg_per_sqrt_h": sigma["gyro_arw_deg_per_sqrt_h"],
                "q_accel_ug_per_sqrt_hz": sigma["accel_vrw_ug_per_sqrt_hz"],
            },
        }
        return Choice(_FILTER, sections, "it estimates the velocity of a surging base")
    reason = "it fits all the data at once and needs no initial attitude"
    beliefs = {f"fit_{key}": value for key, value in sigma.items() if value}
    arm = rms(motion.get("lever_arm_m", 0.0))
    if arm and any(motion.get(key) for key in _SWING_AN_ARM):
        beliefs["fit_lever_arm_m"] = float(f"{arm:.4g}")
        reason += ", and the lever arm is one of its unknowns"
    return Choice(_FIT, {"alignment": {"method": _FIT}, "gravity_fit": beliefs}, reason)


class Budget(NamedTuple):
    """Variance of the heading over time, by source, of a linear estimator.

    Attributes:
        times_s: (times,).
        sources: names of the sources, see `SOURCES`.
        variance: (times, sources), rad^2; linear theory.
    """

    times_s: np.ndarray
    sources: tuple[str, ...]
    variance: np.ndarray

    @property
    def sigma(self) -> np.ndarray:
        """(times,) 1 sigma of the sum, rad."""
        return np.sqrt(self.variance.sum(axis=1))

    def shares(self, time_s: float) -> dict[str, float]:
        """Return the part of each source in the variance at a time, the largest first."""
        (row,) = self.variance[self.times_s == time_s]
        parts = dict(zip(self.sources, row / row.sum(), strict=True))
        return dict(sorted(parts.items(), key=lambda part: -part[1]))


def sheet_problem(sheet: Sheet) -> HeadingProblem:
    """Return the base and the sensors of a sheet.

    The bound does not depend on the rate of the data, but a round one makes whole steps.
    """
    drawn = {key: law for key, law in sheet.tables["drawn"].items() if key != "yaw_center_deg"}
    motion = {"yaw_center_deg": 0.0} | sheet.motion
    if "attitude_file" in motion:
        del motion["yaw_center_deg"]
    sections = {"alignment": {"method": "inertial"}, "motion": motion, "drawn": drawn}
    rate = _RATE_HZ * math.ceil(float(motion.get("vibration_hz", 0.0)) / _RATE_HZ * 3 or 1)
    settings = {"rate_hz": rate, "duration_s": max(sheet.times_s), "draws": 1}
    return budget_problem(study_from_dict(sheet.study_tables(sections, **settings), sheet.name))


def heading_budget(
    problem: HeadingProblem, times_s: Sequence[float], unmodelled: Collection[str] = ()
) -> Budget:
    """Return the budget of an estimator at some times, whole seconds, see `heading_variances`."""
    budget = heading_variances(times_s, problem, unmodelled)
    total = sum(budget.values())
    present = {name: part for name, part in budget.items() if np.any(part > _LEAST_SHARE * total)}
    return Budget(np.asarray(times_s), tuple(present), np.stack([*present.values()], axis=1))


def rms_and_q95_of_noisy_direction(sigma: float) -> tuple[float, float]:
    """Return rms and 95 % quantile, rad, of a heading that a vector with noise shows.

    The data show the level part of the Earth rate with an error of ``sigma``, the linear 1 sigma of
    the heading, times its length along each of the two level axes. The rms of small errors is
    ``sigma``; that of large ones tends to 104 deg, where nothing is known about the heading.
    """
    angles = np.linspace(0.0, min(math.pi, 10 * sigma), _CELLS + 1)
    length = 1 / sigma
    along = length * np.cos(angles)
    across = np.exp(-0.5 * (length * np.sin(angles)) ** 2)
    tail = math.exp(-0.5 * length**2)
    density = tail + math.sqrt(2 * math.pi) * along * special.ndtr(along) * across
    rms = np.sqrt(np.trapezoid(density * angles**2) / np.trapezoid(density))
    reached = np.concatenate([[0.0], np.cumsum(density[1:] + density[:-1])])
    return float(rms), float(np.interp(0.95, reached / reached[-1], angles))


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
        sheet: the data sheet, its conditions and requirements.
        choice: the method and its settings.
        budget: variance of the method's heading by source, over time.
        headings: expected heading error at each time of the budget.
        sigma: 1 sigma of the heading at the available time, rad, before it is wrapped.
        bound_arcmin: information bound of the heading at the available time, 1 sigma of linear
            theory, arcmin.
        turns: the base as it is, and turned in usual ways, with the same method; None if the sheet
            turns the base itself.

    Examples:
        >>> sinsjax.advise(imu="kvh1775", latitude_deg=48.0)
        Advice for kvh1775: 67.8 arcmin rms after 300 s with gravity_fit
    """

    sheet: Sheet
    choice: Choice
    budget: Budget
    headings: tuple[Heading, ...]
    sigma: float
    bound_arcmin: float
    turns: TurnChoice | None

    @property
    def time_s(self) -> float:
        """Available alignment time, s."""
        return self.sheet.asked.time_s

    @property
    def heading(self) -> Heading:
        """The expected heading error at the available time."""
        return next(one for one in self.headings if one.time_s == self.time_s)

    @property
    def dominant(self) -> str:
        """The largest source, by its name in `SOURCES`."""
        return next(iter(self.budget.shares(self.time_s)))

    @cached_property
    def halved_rms_arcmin(self) -> float:
        """Rms heading error at the available time, arcmin, with half of the dominant source."""
        return _rms_at_the_end(scale_source(self.sheet, self.dominant, 0.5))

    @property
    def loss(self) -> float:
        """Ratio of the method's error to the bound at the available time."""
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
        """Cautions, one line each."""
        lines, motion, surging = [], self.sheet.motion, MOTIONS["surging"]
        if self.sigma > _NOT_FOUND:
            more = "; an IMU that is turned may find it (docs/turning.md)" if self.turns else ""
            lines.append(f"north is not found, for the {SOURCES[self.dominant].words}{more}")
        elif self.sigma > _COARSE:
            lines.append("beyond linear theory: 20 % more or less are possible")
        rotates = np.max(np.abs([motion.get(f"{a}_amplitude_deg", 0.0) for a in AXES]))
        if rotates > _ROTATES_DEG and not level_surge(motion.get("surge_m_per_s")):
            rms = surging["surge_m_per_s"]
            moved = motion | {key: surging[key] for key in ("surge_m_per_s", "surge_time_s")}
            surged = replace(self.sheet, tables=self.sheet.tables | {"motion": moved})
            lines.append(
                f"the base is assumed to rotate only: a surge of {rms:g} m/s rms would make it"
                f" {format_angle(_rms_at_the_end(surged))} (--set motion.surge_m_per_s={rms:g})"
            )
        if self.choice.method == _FILTER and self.loss > _LOSES:
            text = f"{_FILTER} does not model the {SOURCES[self.dominant].words}"
            lines.append(f"{text}: try {_FIT} on the study that --study writes")
        return tuple(lines)

    def study(self) -> str:
        """Return the Monte Carlo study that confirms the advice, as TOML."""
        band = 60 * self.settles[0]
        settings = {"success_band_arcmin": band, "settle_bands_arcmin": [band]}
        sections = self.choice.sections
        if self.choice.method == _FILTER:
            anywhere = {"phi_u0_deg": {"uniform": [-180.0, 180.0]}}
            sections = sections | {
                "alignment": sections["alignment"] | {"misalignment": "euler"},
                "drawn": self.sheet.tables["drawn"] | anywhere,
            }
        tables = self.sheet.study_tables(sections, judged_from="truth", **settings)
        return f"{_HEADER}\n\n{tomli_w.dumps(tables)}"

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers alone, as for JSON."""
        here, (band, settled), sheet = self.heading, self.settles, self.sheet
        shares, cosine = self.budget.shares(self.time_s), math.cos(sheet.latitude_deg * DEG)
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
            "budget_percent": {SOURCES[key].words: 100 * part for key, part in shares.items()},
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
        """Return the main numbers; `describe_advice` yields all of them."""
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
    """Return the expected heading error of an IMU at rest, its sources and the method to use.

    Args:
        sheet: file, or nested dictionaries: an ordinary study without an alignment. [sensors] has
            the noise of the data sheet, [drawn] the turn-on biases as ``{normal = [0.0, SIGMA]}``,
            [earth] the latitude, [motion] the motion, and [advise] ``time_s`` and ``wanted_deg``.
        imu: name of a shipped sheet instead, such as "kvh1775".
        latitude_deg: latitude, deg, in place of that of the sheet.
        time_s: available alignment time, s, likewise.
        motion: "still", "rocking" or "surging", likewise; see `MOTIONS` for their numbers.
        changes: values by ``section.key`` that replace those of the sheet.

    Raises:
        InputError: the sheet is not valid, or lacks the white noise of its sensors.

    Examples:
        >>> advice = sinsjax.advise(imu="kvh1775", latitude_deg=48.0, motion="rocking")
        >>> advice.choice.method, advice.dominant, round(advice.heading.rms_arcmin)
        ('gravity_fit', 'gyro_bias', 68)
    """
    given = read_sheet(
        sheet, imu=imu, latitude_deg=latitude_deg, time_s=time_s, motion=motion, changes=changes
    )
    problem, asked_s = sheet_problem(given), given.asked.time_s
    curve_s = np.geomspace(SHORTEST_S, max(given.times_s), _MOST_TIMES)
    times_s = sorted({*given.times_s, *(float(round(time)) for time in curve_s)})
    choice, budget, sigmas = _expected_sigmas(given, problem, times_s)
    errors = np.transpose([*map(rms_and_q95_of_noisy_direction, sigmas)]) / ARCMIN
    headings = tuple(map(Heading, times_s, *errors.tolist()))
    known = sheet_problem(scale_source(given, "lever_arm", 0.0))
    sigma, (bound,) = float(sigmas[times_s.index(asked_s)]), heading_bound([asked_s], known)
    unmodelled = _UNMODELLED[choice.method]
    turns = None if given.is_turned else compare_turns(problem, asked_s, unmodelled)
    return Advice(given, choice, budget, headings, sigma, float(bound / ARCMIN), turns)


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


def _rms_at_the_end(sheet: Sheet) -> float:
    """Return the rms heading error of a sheet at the time asked for, arcmin."""
    *_, (sigma,) = _expected_sigmas(sheet, sheet_problem(sheet), [sheet.asked.time_s])
    return rms_and_q95_of_noisy_direction(sigma)[0] / ARCMIN


def _expected_sigmas(
    sheet: Sheet, problem: HeadingProblem, times_s: Sequence[float]
) -> tuple[Choice, Budget, np.ndarray]:
    """Return the method for a sheet, its budget, and the 1 sigma to expect at all times, rad."""
    choice = choose_method(sheet)
    budget = heading_budget(problem, times_s, _UNMODELLED[choice.method])
    if choice.method == _FIT:
        return choice, budget, budget.sigma
    surge = np.sqrt(budget.variance[:, [s == "surge" for s in budget.sources]].sum(axis=1))
    more = 1 + np.minimum(_MOST_LOSS, _LOSS_PER_RAD * surge)
    return choice, budget, np.sqrt(budget.sigma**2 + (more**2 - 1) * surge**2)


def describe_advice(advice: Advice) -> Iterator[str]:
    """Yield the lines of an advice: title, facts by label, and settings as TOML."""
    sheet = advice.sheet
    place = f"{advice.time_s:g} s at {sheet.latitude_deg:g} deg of latitude"
    yield f"{sheet.name}, {_name_motion(sheet)} base, {place}"
    yield ""
    yield from (f"  {label:<9} {text}" for label, text in _iter_facts(advice) if text)
    yield ""
    settings = tomli_w.dumps(advice.choice.sections).strip()
    yield from (f"    {line}".rstrip() for line in settings.splitlines())


def _iter_facts(advice: Advice) -> Iterator[tuple[str, str]]:
    """Yield labels and texts; an empty text is not shown."""
    sheet, here = advice.sheet, advice.heading
    rms, cosine = format_angle(here.rms_arcmin), math.cos(sheet.latitude_deg * DEG)
    yield "motion", ", ".join(_iter_motion(sheet))
    yield from (("doubt", doubt) for doubt in sheet.doubts)
    level, widest = map(format_angle, (here.rms_arcmin * cosine, here.within_95_arcmin))
    yield "heading", f"{rms} rms from true north ({level} sec L), 95 % within {widest}"
    reported = [one for one in advice.headings if one.time_s in sheet.times_s]
    yield "after", " ".join(f"{f'{one.time_s:g} s':>9}" for one in reported)
    yield "rms", " ".join(f"{format_angle(one.rms_arcmin):>9}" for one in reported)
    yield "95 %", " ".join(f"{format_angle(one.within_95_arcmin):>9}" for one in reported)
    band, settled = advice.settles
    when = f"from {settled:.0f} s" if settled is not None else f"not in {advice.time_s:g} s"
    yield "settles", f"95 % within {band:g} deg {when}, from any heading"
    shares = advice.budget.shares(advice.time_s).items()
    parts = (f"{SOURCES[key].words} {part:.0%}" for key, part in shares if part >= _LEAST_SHOWN)
    yield "budget", ", ".join(parts)
    words, halved = SOURCES[advice.dominant].words, format_angle(advice.halved_rms_arcmin)
    yield "dominant", f"{words}: halving it gives {halved} instead of {rms}"
    bound = f"the information bound of linear theory, {format_angle(advice.bound_arcmin)}"
    loss = f"its error is {advice.loss:.2f} times {bound}"
    yield "method", f"{advice.choice.method}: {advice.choice.reason}; {loss}"
    yield "turning", _describe_turns(advice)
    yield from (("warning", warning) for warning in advice.warnings)


def _name_motion(sheet: Sheet) -> str:
    """Return the motion of the base in a word."""
    words = {
        "turned": sheet.is_turned,
        "surging": level_surge(sheet.motion.get("surge_m_per_s")) > 0,
        "rocking": any(sheet.motion.get(f"{axis}_amplitude_deg") for axis in AXES),
        "vibrating": any(sheet.motion.get(f"vibration_{k}") for k in ("ug_rms", "deg_per_h_rms")),
    }
    return next((word for word, is_so in words.items() if is_so), "still")


def _iter_motion(sheet: Sheet) -> Iterator[str]:
    """Yield the numbers of the motion that the advice assumes."""
    for axis in AXES:
        if amplitude := sheet.motion.get(f"{axis}_amplitude_deg"):
            yield f"{axis} {amplitude} deg every {sheet.motion[f'{axis}_period_s']:g} s"
    if surge := sheet.motion.get("surge_m_per_s"):
        yield f"surge {surge} m/s rms over {sheet.motion['surge_time_s']:g} s"
    if lever_arm := sheet.motion.get("lever_arm_m"):
        yield f"lever arm {lever_arm} m"


def _describe_turns(advice: Advice) -> str:
    if advice.turns is None:
        return "the sheet turns the base, and the numbers above are with it"
    (parked, *turned), best = advice.turns.options, advice.turns.best
    if best.sigma_arcmin > _PAYS * parked.sigma_arcmin:
        return "hardly pays: the noise and not the biases decide, or there is no time for it"
    parts = [f"no turn {format_angle(advice.heading.rms_arcmin)}"]
    for one in turned:
        if one.sigma_arcmin <= parked.sigma_arcmin and one.name in ("half turn", best.name):
            rms, _ = rms_and_q95_of_noisy_direction(one.sigma_arcmin * ARCMIN)
            half = f"one 180 deg turn at {one.motion['turn_times_s'][0]:g} s"
            name = half if one.name == "half turn" else one.name
            parts.append(f"{name} {format_angle(rms / ARCMIN)}")
    return f"on a {_name_motion(advice.sheet)} base: {', '.join(parts)}"


def format_angle(arcmin: float) -> str:
    """Return an angle, arcmin, in degrees where it is large."""
    if arcmin < 100:
        return f"{arcmin:.1f}'" if arcmin < 20 else f"{arcmin:.0f}'"
    return f"{arcmin / 60:.1f} deg" if arcmin < 600 else f"{arcmin / 60:.0f} deg"

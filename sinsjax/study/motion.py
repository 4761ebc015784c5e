"""The motion of a simulated base: its turns in whole samples, or its attitude from a file."""

import hashlib
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sinsjax.errors import InputError
from sinsjax.methods.registry import METHODS
from sinsjax.records.reference import Reference, read_reference
from sinsjax.study.schema import TURN_KEYS, EarthSection, MotionSection
from sinsjax.study.study import Study
from sinsjax.units import DEG
from sinsjax.value_types import ROUNDING, otherwise

_MOST_PER_SAMPLE = 0.1
"""Fastest turn, rad per sample: coning and sculling compensation leave little of such a turn."""

DEFAULTS = {
    key: otherwise(MotionSection, key)
    for key in ("turn_angles_deg", "turn_rate_deg_per_s", "turn_ramp_s")
}
"""Defaults of a study with turns."""

_MANY_TURNS_DEG = 720.0  # as many as some methods need


class Turn(NamedTuple):
    """One turn in whole samples."""

    begin: int  # sample at which the ramp up begins
    length: int  # samples from there to the beginning of the ramp down
    ramp: int  # samples of a ramp
    angle_deg: float
    rate_deg_per_s: float  # after the ramp


class TurnError(ValueError):
    """Turns that no base can make, or that samples do not resolve: the key to change, and why."""


def turns_in_samples(rate_hz: float, end_s: float, values: Mapping[str, Any]) -> list[Turn]:
    """Return the turns of a run of some length in whole samples; none begins after the end.

    Begin, length and ramp of a turn are rounded to samples, and its rate is adjusted for its exact
    angle, unless the run ends within the turn. The values are those of `TURN_KEYS`; a `TurnError`
    refuses turns that overlap or are too fast for the samples.
    """
    times_s = values["turn_times_s"] or ()
    angle, rate, ramp_s = (
        values[key] if values[key] is not None else default for key, default in DEFAULTS.items()
    )
    angles = angle if isinstance(angle, tuple) else (angle,) * len(times_s)
    if len(angles) != len(times_s):
        text = f"has {len(angles)} angles for {len(times_s)} turns (give one for all, or one each)"
        raise TurnError("turn_angles_deg", text)
    if rate * DEG / rate_hz > _MOST_PER_SAMPLE * (1 + ROUNDING):
        most = math.floor(_MOST_PER_SAMPLE * rate_hz / DEG * 10) / 10
        hint = f"at most {most:g} deg/s at rate_hz = {rate_hz:.12g}"
        text = f"{rate:.12g} deg/s is faster than the samples resolve ({hint})"
        raise TurnError("turn_rate_deg_per_s", text)
    end, ramp = math.ceil(end_s * rate_hz * (1 - ROUNDING)), max(1, round(ramp_s * rate_hz))
    turns = []
    for time_s, angle_deg in zip(times_s, angles, strict=True):
        begin, whole = round(time_s * rate_hz), abs(angle_deg) / rate * rate_hz
        length, exact = math.ceil(whole), math.copysign(rate, angle_deg)
        if begin + whole < end:
            length = max(1, round(whole))
            exact = angle_deg * rate_hz / length
        turns.append(Turn(begin, length, ramp, angle_deg, exact))
    if values["turn_repeat_s"] is not None and turns:
        period = max(1, round(values["turn_repeat_s"] * rate_hz))
        repeats = range(1 + max(0, end - 1 - turns[0].begin) // period)
        _refuse_overlap(rate_hz, [*turns, turns[0]._replace(begin=turns[0].begin + period)])
        turns = [t._replace(begin=t.begin + n * period) for n in repeats for t in turns]
    turns = [turn for turn in turns if turn.begin < end]
    _refuse_overlap(rate_hz, turns)
    return turns


def _refuse_overlap(rate_hz: float, turns: list[Turn]) -> None:
    for turn, following in zip(turns, turns[1:], strict=False):
        end = turn.begin + turn.length + turn.ramp
        if end > following.begin:
            begin_s, end_s, next_s = (n / rate_hz for n in (turn.begin, end, following.begin))
            text = f"the turn at {begin_s:.12g} s ends at {end_s:.12g} s, after the next one begins"
            hint = "leave more time, or turn faster"
            raise TurnError("turn_times_s", f"{text}, at {next_s:.12g} s ({hint})")


def data_end_s(study: Study) -> float:
    """Return the length of the data that the longest run reads, s."""
    return max(s.records_read for s in study.distinct_spans) * study.record_every / study.rate_hz


def _turned_points(study: Study, *keys: str) -> Iterator[dict[str, Any]]:
    """Yield the combinations of some keys and `TURN_KEYS` in which the base is turned."""
    if not study.is_recorded:
        points = study.combinations(*keys, *TURN_KEYS)
        yield from (point for point in points if point["turn_times_s"])


def check_turns(study: Study) -> None:
    """Refuse turns that overlap or are too fast for the samples."""
    for point in _turned_points(study):
        try:
            turns_in_samples(study.rate_hz, data_end_s(study), point)
        except TurnError as error:
            study.refuse(*error.args)


def turn_ignoring_method_warnings(study: Study) -> Iterator[str]:
    """Yield one line per method of the study that cannot use its turns."""
    useless, end_s = dict[str, str](), data_end_s(study)
    for point in _turned_points(study, "method"):
        name, turning = point["method"], METHODS[point["method"]].turning
        turns = turns_in_samples(study.rate_hz, end_s, point)
        is_few = sum(abs(turn.angle_deg) for turn in turns) < _MANY_TURNS_DEG
        if turning == "none" or (turning == "many" and is_few):
            useless[name] = " unless it makes many" if turning == "many" else ""
    good = ", ".join(name for name, method in METHODS.items() if method.turning == "any")
    for name, few in useless.items():
        text = f"{name} does not average gyro biases over the turns of a base{few} (use {good})"
        yield f"[alignment] method: {text}"


_LONGEST_STEP = 5.0
"""Longest step of time without a gap, in medians of all steps."""


def read_attitude_file(study: Study) -> Reference | None:
    """Return the attitude of the base over time, if the study has a file of it.

    Raises:
        InputError: the file cannot be read, is unsorted, has gaps or does not cover the data.
    """
    if not (name := study.motion and study.motion.attitude_file):
        return None
    attitude = read_reference(name)
    time_s, end_s = attitude.time_s, data_end_s(study)
    if time_s[0] > 0 or time_s[-1] < end_s * (1 - 1e-9):
        text = f"covers {time_s[0]:.12g} to {time_s[-1]:.12g} s, but the study needs 0 to"
        raise InputError(f"{name}: {text} {end_s:.12g} s (shorten the runs, or give a longer file)")
    steps = np.diff(time_s)
    if steps.max() > _LONGEST_STEP * np.median(steps):
        at = int(steps.argmax())
        text = f"has a gap of {steps[at]:.6g} s after {time_s[at]:.12g} s"
        raise InputError(f"{name}: {text} (fill it in; other steps are {np.median(steps):.6g} s)")
    return attitude


def attitude_digest(study: Study) -> str | None:
    """Return a digest of the file of the base's attitude, as a part of the study's identity."""
    name = study.motion.attitude_file if study.motion else None
    try:
        return name and hashlib.sha256(Path(name).read_bytes()).hexdigest()[:16]
    except OSError as error:
        raise InputError(f"{name}: cannot be read: {error.strerror}") from None


def refuse_drawn_motion(study: Study) -> None:
    """Refuse a drawn place or motion together with a file of the attitude."""
    for key in study.drawn_keys if study.gives("attitude_file") else ():
        if key in EarthSection.model_fields or key in MotionSection.model_fields:
            text = "cannot be drawn with attitude_file in [motion]"
            study.refuse(key, f"{text} (give it one value, or sweep it)")

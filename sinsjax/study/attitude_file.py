"""The file of a simulated base's attitude: reading, identity, and the rules of its key."""

import hashlib
from functools import lru_cache
from pathlib import Path

import numpy as np

from sinsjax.errors import InputError
from sinsjax.records.reference import Reference, read_reference
from sinsjax.study.schema import EarthSection, MotionSection
from sinsjax.study.study import Study
from sinsjax.study.turns import data_end_s

_LONGEST_STEP = 5.0
"""Longest step of time without a gap, in medians of all steps."""
_LEAST_MOTION_DEG = 0.5
"""Range of yaw from which a file within two radian turns is taken to be in radians."""


def attitude_file(study: Study) -> str | None:
    """Return the file of the base's attitude, if the study has one."""
    return None if study.motion is None else study.motion.attitude_file


def read_attitude(study: Study) -> Reference | None:
    """Return the attitude of the base over time, if the study has a file of it.

    Raises:
        InputError: the file cannot be read, is unsorted, has gaps, does not cover the data or
            seems to be in radians.
    """
    name = attitude_file(study)
    if name is None:
        return None
    attitude = _read(name, *_time_and_size(name))
    time_s, angles = attitude.time_s, attitude.attitude_deg
    end_s, steps = data_end_s(study), np.diff(time_s)
    if time_s[0] > 0 or time_s[-1] < end_s * (1 - 1e-9):
        text = f"covers {time_s[0]:.12g} to {time_s[-1]:.12g} s, but the study needs 0 to"
        raise InputError(f"{name}: {text} {end_s:.12g} s (shorten the runs, or give a longer file)")
    if steps.max() > _LONGEST_STEP * np.median(steps):
        at = int(steps.argmax())
        text = f"has a gap of {steps[at]:.6g} s after {time_s[at]:.12g} s"
        raise InputError(f"{name}: {text} (fill it in; other steps are {np.median(steps):.6g} s)")
    small = np.abs(angles).max() <= 2 * np.pi
    if small and np.ptp(angles[:, 2]) >= _LEAST_MOTION_DEG and not study.study.unchecked:
        hint = "give degrees; [study] unchecked = true accepts them"
        raise InputError(f"{name}: all angles are within 2 pi, are they in radians? ({hint})")
    return attitude


def digest(study: Study) -> str | None:
    """Return a digest of the file's content, which is part of the study's identity."""
    name = attitude_file(study)
    return None if name is None else _digest(name, *_time_and_size(name))


def _time_and_size(name: str) -> tuple[int, int]:
    """Return what changes with a file."""
    try:
        state = Path(name).stat()
    except OSError as error:
        raise InputError(f"{name}: cannot be read: {error.strerror}") from None
    return state.st_mtime_ns, state.st_size


@lru_cache(maxsize=4)
def _read(name: str, time_ns: int, size: int) -> Reference:
    return read_reference(name)


@lru_cache(maxsize=16)
def _digest(name: str, time_ns: int, size: int) -> str:
    return hashlib.sha256(Path(name).read_bytes()).hexdigest()[:16]


def refuse_drawn_motion(study: Study) -> None:
    """Refuse a drawn place or motion together with a file of the attitude."""
    for key in study.drawn_keys if attitude_file(study) else ():
        if key in EarthSection.model_fields or key in MotionSection.model_fields:
            text = "cannot be drawn with attitude_file in [motion]"
            study.refuse(key, f"{text} (give it one value, or sweep it)")

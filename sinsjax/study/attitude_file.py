"""The file of a simulated base's attitude: reading, identity, and the rules of its key."""

import hashlib
from pathlib import Path

import numpy as np

from sinsjax.errors import InputError
from sinsjax.records.reference import Reference, read_reference
from sinsjax.study.schema import EarthSection, MotionSection
from sinsjax.study.study import Study
from sinsjax.study.turns import data_end_s

_LONGEST_STEP = 5.0
"""Longest step of time without a gap, in medians of all steps."""


def attitude_file(study: Study) -> str | None:
    """Return the file of the base's attitude, if the study has one."""
    return None if study.motion is None else study.motion.attitude_file


def read_attitude(study: Study) -> Reference | None:
    """Return the attitude of the base over time, if the study has a file of it.

    Raises:
        InputError: the file cannot be read, is unsorted, has gaps or does not cover the data.
    """
    name = attitude_file(study)
    if name is None:
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


def digest(study: Study) -> str | None:
    """Return a digest of the file's content, which is part of the study's identity."""
    name = attitude_file(study)
    try:
        return name and hashlib.sha256(Path(name).read_bytes()).hexdigest()[:16]
    except OSError as error:
        raise InputError(f"{name}: cannot be read: {error.strerror}") from None


def refuse_drawn_motion(study: Study) -> None:
    """Refuse a drawn place or motion together with a file of the attitude."""
    for key in study.drawn_keys if attitude_file(study) else ():
        if key in EarthSection.model_fields or key in MotionSection.model_fields:
            text = "cannot be drawn with attitude_file in [motion]"
            study.refuse(key, f"{text} (give it one value, or sweep it)")

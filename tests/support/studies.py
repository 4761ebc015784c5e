"""Small studies for the tests: a swinging base with the papers' sensors."""

from typing import Any

import numpy as np
import pytest

from sinsjax.errors import InputError
from sinsjax.records import Record, Reference
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import study_from_dict
from sinsjax.study.study import Study

BASE: dict[str, dict[str, Any]] = {
    "study": {"duration_s": 6.0, "rate_hz": 100.0, "draws": 3, "window_s": [2, 6]},
    "earth": {"latitude_deg": 32.0},
    "motion": {
        "yaw_center_deg": 10.0,
        "pitch_amplitude_deg": 1.8,
        "pitch_period_s": 6.0,
        "roll_amplitude_deg": 2.4,
        "roll_period_s": 8.0,
        "yaw_amplitude_deg": 2.8,
        "yaw_period_s": 10.0,
    },
    "sensors": {
        "gyro_bias_deg_per_h": 0.1,
        "gyro_noise_deg_per_h": 0.1,
        "accel_bias_ug": 500.0,
        "accel_noise_ug": 500.0,
    },
    "alignment": {"phi_e0_deg": 5.0, "phi_n0_deg": 5.0, "phi_u0_deg": 30.0},
}

STILL = {f"{angle}_amplitude_deg": 0.0 for angle in ("pitch", "roll", "yaw")}
"""A base whose runs have a limit, however short they are."""


def small_tables(**changes: Any) -> dict[str, Any]:
    """`BASE` with sections changed key by key; lists and new sections are taken as given.

    A key of `BASE` that is changed to None is left out.
    """
    data: dict[str, Any] = {name: dict(section) for name, section in BASE.items()}
    for name, change in changes.items():
        if isinstance(change, dict) and name in data:
            merged = data[name] | change
            data[name] = {k: v for k, v in merged.items() if v is not None or k not in BASE[name]}
        else:
            data[name] = change
    return data


def small_study(**changes: Any) -> Study:
    """The study of `small_tables`."""
    return study_from_dict(small_tables(**changes))


def swing_deg(time_s: np.ndarray) -> np.ndarray:
    """(n, 3) pitch, roll and yaw of `BASE` at some times."""
    motion = BASE["motion"]
    sways = [
        motion[f"{angle}_amplitude_deg"] * np.sin(2 * np.pi * time_s / motion[f"{angle}_period_s"])
        for angle in ("pitch", "roll", "yaw")
    ]
    return np.column_stack(sways) + [0.0, 0.0, motion["yaw_center_deg"]]


def with_truth(record: Record) -> StoredRecord:
    """A record of six seconds of `BASE`, with its true attitude."""
    time_s = np.arange(0, 6.01, 0.01)
    return StoredRecord(record, Reference(time_s, swing_deg(time_s), "true.csv"))


def refusal(**tables: Any) -> str:
    """The one line with which a small study with these changes is refused."""
    with pytest.raises(InputError) as caught:
        small_study(**tables)
    line = str(caught.value)
    assert len(line.splitlines()) == 1
    return line.removeprefix("study: ")

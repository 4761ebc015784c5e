"""Studies of nothing but their required keys, as a beginner writes them, and their refusals."""

import copy
from typing import Any

import pytest

from sinsjax.errors import InputError
from sinsjax.study.load import study_from_dict
from sinsjax.study.study import Study
from support.studies import with_paper_values

SIMULATED: dict[str, Any] = {
    "study": {"duration_s": 900, "rate_hz": 100},
    "earth": {"latitude_deg": 32.0},
    "motion": {"yaw_center_deg": 0},
}
RECORDED: dict[str, Any] = {
    "study": {"duration_s": 300.0, "rate_hz": 100.0},
    "record": {"format": "psins"},
}
COMPASS = SIMULATED | {"alignment": {"method": "compass"}}
TABULAR: dict[str, Any] = {
    "format": "csv",
    "quantity": "rates",
    "gyro_columns": ["gx", "gy", "gz"],
    "accel_columns": ["ax", "ay", "az"],
    "gyro_unit": "deg_per_h",
    "accel_unit": "m_per_s2",
}


def merge_tables(base: dict[str, Any], **tables: Any) -> dict[str, Any]:
    """Return sections with some keys of others added."""
    data = copy.deepcopy(base)
    for name, table in tables.items():
        old = data.get(name)
        data[name] = old | table if isinstance(old, dict) and isinstance(table, dict) else table
    return data


def build_study(base: dict[str, Any] = SIMULATED, **tables: Any) -> Study:
    """Return the study of `merge_tables`; filters have paper 1's Q and feedback."""
    return study_from_dict(with_paper_values(merge_tables(base, **tables)), "s.toml")


def refusal_lines(base: dict[str, Any] = SIMULATED, **tables: Any) -> list[str]:
    """Return the lines of the error without the file's name, which must begin each."""
    with pytest.raises(InputError) as caught:
        build_study(base, **tables)
    assert all(line.startswith("s.toml: ") for line in caught.value.lines)
    return [line.removeprefix("s.toml: ") for line in caught.value.lines]


def refusal_line(base: dict[str, Any] = SIMULATED, **tables: Any) -> str:
    """Return the single line of the error without the file's name, which must begin it."""
    (line,) = refusal_lines(base, **tables)
    return line

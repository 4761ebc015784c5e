"""Studies of nothing but their required keys, as a beginner writes them."""

import copy

from sinsjax.study.load import study_from_dict
from support.studies import with_paper_values

SIMULATED = {
    "study": {"duration_s": 900, "rate_hz": 100},
    "earth": {"latitude_deg": 32.0},
    "motion": {"yaw_center_deg": 0},
}
RECORDED = {
    "study": {"duration_s": 300.0, "rate_hz": 100.0},
    "record": {"format": "psins"},
}
COMPASS = SIMULATED | {"alignment": {"method": "compass"}}
TABULAR = {
    "format": "csv",
    "quantity": "rates",
    "gyro_columns": ["gx", "gy", "gz"],
    "accel_columns": ["ax", "ay", "az"],
    "gyro_unit": "deg_per_h",
    "accel_unit": "m_per_s2",
}


def merge_tables(base, **tables):
    """Return sections with some keys of others added."""
    data = copy.deepcopy(base)
    for name, table in tables.items():
        old = data.get(name)
        data[name] = old | table if isinstance(old, dict) and isinstance(table, dict) else table
    return data


def build_study(base=SIMULATED, **tables):
    """Return the study of `merge_tables`; filters have paper 1's Q and feedback."""
    return study_from_dict(with_paper_values(merge_tables(base, **tables)))

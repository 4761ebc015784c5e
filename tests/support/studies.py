"""Small studies for the tests: a swinging base with the papers' sensors."""

import numpy as np

from sinsjax.arena.export import simulated_record
from sinsjax.methods.registry import METHODS
from sinsjax.records import Reference
from sinsjax.records.reference import StoredRecord
from sinsjax.study.keys import alternative_keys
from sinsjax.study.load import study_from_dict
from support.record_files import write_psins

BASE = {
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
"""A base whose runs have a bias floor, however short they are."""


PAPER = {"q_accel_ug": 500.0, "q_gyro_deg_per_h": 0.1, "q_reading": "per_step"}
"""Q as paper 1 prints it, in [filter]."""

FEEDBACK, PAPER_FEEDBACK_S = "feedback_interval_s", 1.0
"""The feedback of paper 1, in [alignment]."""


def with_paper_values(tables):
    """Give a study with filters paper 1's Q and feedback, except for what it gives itself.

    Tables that are not a study, and a study shorter than a feedback interval, are not changed.
    """
    alignment, filter_, axes = (tables.get(name, {}) for name in ("alignment", "filter", "axes"))
    if not all(isinstance(table, dict) for table in (alignment, filter_)):
        return tables
    axes, cases = axes if isinstance(axes, dict) else {}, tables.get("cases", [])
    varied = (axes, *axes.values(), *(cases if isinstance(cases, list) else []))  # some are zips
    varied = [table for table in varied if isinstance(table, dict)]
    lists = [table["method"] for table in varied if "method" in table]
    lists = [of for of in lists if not isinstance(of, dict)]  # a zip of that name
    methods = [name for of in lists for name in (of if isinstance(of, list) else [of])]
    methods = methods or [alignment.get("method", "kalman5")]
    if not any("filter" in METHODS[name].sections for name in methods if name in METHODS):
        return tables
    given = {*alignment, *filter_}.union(*varied)
    given |= {other for key in given for other in alternative_keys(key)}
    paper = {key: value for key, value in PAPER.items() if key not in given}
    out = tables | {"filter": paper | filter_}
    duration_s = tables.get("study", {}).get("duration_s")
    short = isinstance(duration_s, int | float) and duration_s < PAPER_FEEDBACK_S
    if FEEDBACK not in given and not short:
        out["alignment"] = {FEEDBACK: PAPER_FEEDBACK_S} | alignment
    return out


def small_tables(**changes):
    """Return `BASE` with sections changed key by key; lists and new sections replace others.

    A key of `BASE` that is changed to None is left out. Filters have `with_paper_values`.
    """
    data = {name: dict(section) for name, section in BASE.items()}
    for name, change in changes.items():
        if isinstance(change, dict) and name in data:
            merged = data[name] | change
            data[name] = {k: v for k, v in merged.items() if v is not None or k not in BASE[name]}
        else:
            data[name] = change
    return with_paper_values(data)


def small_study(**changes):
    """Return the study of `small_tables`."""
    return study_from_dict(small_tables(**changes))


def recorded_study(**changes):
    """Return a study of two seconds of a record of `BASE`, with sections changed key by key."""
    tables = {
        "study": {"duration_s": 2.0, "window_s": [0, 2]},
        "earth": {"latitude_deg": 32.0},
        "record": {"format": "psins"},
        "coarse": {"coarse_duration_s": 3.0},
    }
    tables |= {name: tables.get(name, {}) | section for name, section in changes.items()}
    return study_from_dict(with_paper_values(tables), "swing")


def swing_deg(time_s):
    """Return pitch, roll and yaw of `BASE` at some times, (n, 3), deg."""
    motion = BASE["motion"]
    sways = [
        motion[f"{angle}_amplitude_deg"] * np.sin(2 * np.pi * time_s / motion[f"{angle}_period_s"])
        for angle in ("pitch", "roll", "yaw")
    ]
    return np.column_stack(sways) + [0.0, 0.0, motion["yaw_center_deg"]]


def add_true_reference(record):
    """Return a record of six seconds of `BASE` with its true attitude as reference."""
    time_s = np.arange(0, 6.01, 0.01)
    return StoredRecord(record, Reference(time_s, swing_deg(time_s), "true.csv"))


def write_swing_record(folder):
    """Write a simulated record of `BASE`, swing.imu, and its true attitude, true.csv."""
    record, true = add_true_reference(simulated_record(small_study()))
    write_psins(record, folder / "swing.imu")
    rows, header = np.c_[true.time_s, true.attitude_deg], "time_s,pitch_deg,roll_deg,yaw_deg"
    np.savetxt(folder / "true.csv", rows, delimiter=",", header=header, comments="")


DISTURBANCES = {
    "motion": {
        "surge_m_per_s": [0.1, 0.2, 0.05],
        "lever_arm_m": [1.0, -0.5, 2.0],
        "vibration_ug_rms": 5000.0,
        "vibration_deg_per_h_rms": 30.0,
    },
    "sensors": {
        "gyro_instability_deg_per_h": 0.05,
        "gyro_instability_time_s": 3.0,
        "accel_instability_ug": [20.0, 30.0, 10.0],
        "gyro_rrw_deg_per_h_per_sqrt_h": 1.0,
        "accel_rrw_ug_per_sqrt_h": 100.0,
        "gyro_quantisation_arcsec": 0.1,
        "accel_quantisation_um_per_s": [10.0, 0.0, 50.0],
    },
}
DRAWN_DISTURBANCES = {
    "surge_m_per_s": {"uniform": [0.0, 0.2]},
    "surge_time_s": {"uniform": [2.0, 8.0]},
    "lever_arm_m": {"normal": [0.0, 1.0]},
    "gyro_instability_deg_per_h": {"values": [0.01, 0.1]},
    "accel_quantisation_um_per_s": {"uniform": [0.0, 50.0]},
}


def disturbed_tables(**changes):
    """Return changes of `small_tables` with everything that disturbs, less what they draw."""
    tables = {
        name: {key: value for key, value in table.items() if key not in changes.get("drawn", {})}
        for name, table in DISTURBANCES.items()
    }
    required = {"filter": {"r_velocity_m_per_s": 0.1}}  # if the surge is drawn
    return tables | required | changes

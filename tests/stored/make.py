"""How the stored results directories were made: once, by sinsjax 1.0.0, and never again.

    XLA_FLAGS=--xla_cpu_max_isa=SSE4_2 python make.py    # in the folder to write to

They show that what one version wrote is read, reported and continued by the next. Whoever must
remake one has changed a file format: that needs a new `SCHEMA_VERSION` and a line in the changelog.
Manifests name no machine, and files that belong to one (locks, figures) are left out.
"""

import copy
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pyarrow.csv

import sinsjax
from sinsjax.platform import runtime

NAMES = ("draws", "methods", "extended", "killed", "tuned", "record", "aligned", "exported")

BASE: dict[str, dict[str, Any]] = {
    "study": {
        **{"duration_s": 12.0, "rate_hz": 20.0, "record_interval_s": 1.0, "draws": 4, "seed": 5},
        **{"settle_bands_arcmin": [600.0, 120.0], "window_s": [8.0, 12.0], "dwell_s": 2.0},
        **{"success_band_arcmin": 300.0, "level_band_arcmin": 20.0, "report_times_s": [6.0]},
        **{"consistency_after_s": 3.0, "steady_after_s": 7.0, "diverged_deg": 20.0},
    },
    "earth": {"latitude_deg": 45.0},
    "motion": {"yaw_center_deg": 20.0, "pitch_amplitude_deg": 1.0, "pitch_period_s": 3.0},
    "sensors": {
        **{"gyro_bias_deg_per_h": 0.02, "gyro_arw_deg_per_sqrt_h": 1e-4},
        **{"accel_bias_ug": 50.0, "accel_vrw_ug_per_sqrt_hz": 5.0},
    },
    "alignment": {"phi_e0_deg": 0.5, "phi_n0_deg": -0.5, "phi_u0_deg": 10.0},
    "filter": {"r_velocity_m_per_s": 0.001, "r_reading": "psd", "p0_yaw_deg": 30.0},
}
CHANGES: dict[str, dict[str, Any]] = {
    "draws": {
        "study": {"curves": True, "record_interval_s": 2.0},
        "axes": {"phi_u0_deg": [5.0, 40.0], "reset_times_s": [[], [4.0, 7.0]]},
        "drawn": {"yaw_center_deg": {"uniform": [-180.0, 180.0]}},
    },
    "methods": {"study": {"draws": 2}, "axes": {"method": ["kalman_sincos", "level"]}},
    "extended": {"axes": {"p0_yaw_deg": [10.0, 40.0]}},
    "killed": {"study": {"draws": 128}, "axes": {"feedback_interval_s": [0.5, 1.0]}},
    "tuned": {
        "tune": {
            **{"objective": "final_error", "searches": ["sobol"], "sobol_points": 4},
            "objective_band_arcmin": 300.0,
            **{"tune_draws": 2, "evaluation_draws": 4},
            "variables": {"reset_times_s": [{"low": 2.0, "high": 10.0}]},
            "baseline": {"reset_times_s": []},
        },
    },
    "record": {"study": {"duration_s": 8.0, "window_s": [6.0, 8.0]}},
    "exported": {
        "study": {
            **{"draws": 2, "duration_s": 2.0, "window_s": [1.0, 2.0], "report_times_s": [1.0]},
            **{"record_interval_s": 0.5, "dwell_s": 0.5},
        },
        "alignment": {"method": "inertial"},
        "filter": {},
    },
}
RECORDED: dict[str, Any] = {
    "record": {
        **{"format": "csv", "quantity": "increments", "axes_order": "rfu", "start_s": [0.0, 1.0]},
        **{"gyro_unit": "rad", "accel_unit": "m_per_s", "time_column": "time_s"},
        "gyro_columns": ["gyro_x", "gyro_y", "gyro_z"],
        "accel_columns": ["accel_x", "accel_y", "accel_z"],
    },
    "coarse": {"coarse_method": "inertial", "coarse_duration_s": 3.0},
}


def settings_of(name: str) -> dict[str, Any]:
    """Return the settings of a study, by section."""
    settings = copy.deepcopy(BASE)
    for section, change in CHANGES[name].items():
        settings[section] = settings.get(section, {}) | change
    if "filter" in CHANGES[name]:
        del settings["filter"]
    for key in settings.get("drawn", {}):
        settings["motion"].pop(key)
    for key in settings.get("axes", {}):
        for section in ("motion", "alignment", "filter"):
            settings[section].pop(key, None)
    settings["study"]["name"] = name
    return settings


def make(name: str) -> None:
    """Write a results directory into the working directory."""
    study = sinsjax.study_from_dict(settings_of(name))
    if name == "tuned":
        sinsjax.tune(study, name)
    elif name == "record":
        _write_record(study)
    elif name == "exported":
        _write_scores(study)
    elif name == "killed":
        _kill_after_a_part()
        sinsjax.run_into(study, name, chunk_runs=128)
    else:
        sinsjax.run_into(study, name)
    if name == "extended":
        sinsjax.run_into(study.replace({"study.draws": 6}), name, resume=True)


def _kill_after_a_part() -> None:
    """Let this process kill itself as soon as it has written the first part of two."""
    replace = Path.replace

    def replaced(self: Path, target: Path) -> Path:
        path = replace(self, target)
        if path.parent.name == "summary":
            os.kill(os.getpid(), signal.SIGKILL)
        return path

    Path.replace = replaced


def _write_record(study: sinsjax.Study) -> None:
    """Write a record and its reference, and align it from two times."""
    record = sinsjax.simulated_record(study)
    time_s = np.arange(1, len(record.dtheta) + 1) / record.rate_hz
    rows = np.column_stack([time_s, record.dtheta, record.dv])
    names = "time_s,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"
    Path("record").mkdir()
    np.savetxt("record/log.csv", rows, "%.6g", ",", header=names, comments="")
    pitch_deg = np.sin(2 * np.pi * time_s / 3)
    rows = np.column_stack([time_s, pitch_deg, 0 * time_s, 20 + 0 * time_s])
    names = "time_s,pitch_deg,roll_deg,yaw_deg"
    np.savetxt("record/reference.csv", rows, "%.6g", ",", header=names, comments="")
    settings = settings_of("record") | RECORDED
    del settings["motion"], settings["sensors"]
    settings["study"] |= {"name": "aligned", "duration_s": 4.0, "window_s": [2.0, 4.0]}
    settings["study"] |= {"steady_after_s": 2.0, "report_times_s": [2.0]}
    settings["filter"] |= {"q_accel_ug_per_sqrt_hz": 5.0, "q_gyro_arw_deg_per_sqrt_h": 1e-4}
    settings["filter"] |= {"q_reading": "psd"}
    del settings["study"]["draws"], settings["study"]["seed"]
    aligned = sinsjax.study_from_dict(settings)
    stored = sinsjax.load_increments(aligned, "record/log.csv", "record/reference.csv")
    sinsjax.run_into(aligned, "aligned", stored)


def _write_scores(study: sinsjax.Study) -> None:
    """Export the draws, level by their mean specific force as a foreign program, and score it."""
    folder = sinsjax.export_study(study, "exported")
    first = pyarrow.csv.read_csv(folder / "initial.csv").to_pylist()
    lines = ["run_id,time_s,pitch_deg,roll_deg,yaw_deg,study"]
    for run in first:
        record = pyarrow.csv.read_csv(folder / run["file"]).to_pandas().to_numpy()
        x, y, z = record[:, -3:].mean(axis=0)
        pitch_deg, roll_deg = np.degrees([np.arctan2(y, z), np.arctan2(-x, z)])
        angles = f"{pitch_deg:.9f},{roll_deg:.9f},21.5"
        lines.append(f"{run['run_id']},{run['end_s']},{angles},{run['study']}")
    (folder / "results.csv").write_text("\n".join(lines) + "\n")
    sinsjax.score_results(folder, folder / "results.csv", name="leveller")


def main(*names: str) -> None:
    """Make what is asked for in this process, or everything in a process each."""
    if names:
        sound = runtime.describe_environment
        facts = {"platform": "Linux", "cpu": "x86_64", "xla_flags": os.environ.get("XLA_FLAGS", "")}
        with mock.patch.object(runtime, "describe_environment", lambda: sound() | facts):
            make(*names)
        return
    if existing := [name for name in NAMES if Path(name).exists()]:
        sys.exit(f"{existing[0]}: is there already, and stays as it is")
    for name in CHANGES:
        subprocess.run([sys.executable, __file__, name], check=name != "killed")
    for path in Path().glob("**/*"):
        if path.name in (".lock", ".writer", ".figures.json"):
            path.unlink()
        elif path.name == "figures":
            shutil.rmtree(path)


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Align the records of a sinsjax export with python-ins (package ``python-ins``, module pyins).

    python python_ins_runs.py DIR SIGMA OUT

Its INS filter with 15 states gets the true position and a velocity of zero with SIGMA m/s once a
second. DIR is an export with ``--format csv --frame ned``.
"""

import sys
from pathlib import Path

import pandas as pd
from pyins import filters, inertial_sensor, measurements
from scipy.spatial.transform import Rotation

DEG_PER_H, UG = 4.848136811e-6, 9.80665e-6
LEVEL, YAW = 15.0, 80.0  # deg


def main(folder: str, sigma: str, out: str) -> None:
    """Align all runs."""
    runs = pd.read_csv(Path(folder) / "initial.csv")
    gyro = inertial_sensor.EstimationModel(bias_sd=0.1 * DEG_PER_H, noise=4.848e-8)
    accel = inertial_sensor.EstimationModel(bias_sd=500 * UG, noise=50 * UG)
    with open(out, "w", encoding="utf-8") as file:
        print("study,run_id,time_s,yaw_deg,pitch_deg,roll_deg", file=file)
        for run in runs.itertuples():
            imu = pd.read_csv(Path(folder) / run.file)
            imu.columns = ["time", "theta_x", "theta_y", "theta_z", "dv_x", "dv_y", "dv_z"]
            imu.insert(1, "dt", 1 / run.rate_hz)
            imu = imu.set_index("time")
            imu.index = imu.index.to_numpy().round(6)
            roll, pitch, heading = Rotation.from_quat(
                [run.q_x, run.q_y, run.q_z, run.q_w]
            ).as_euler("xyz", degrees=True)
            start = pd.Series(
                {
                    **{"lat": run.latitude_deg, "lon": 0.0, "alt": run.height_m},
                    **{"VN": 0.0, "VE": 0.0, "VD": 0.0},
                    **{"roll": roll, "pitch": pitch, "heading": heading},
                },
                name=0.0,
            )
            whole = [t for t in imu.index if abs(t - round(t)) < 1e-6]
            still = pd.DataFrame({"VN": 0.0, "VE": 0.0, "VD": 0.0}, index=whole)
            found = filters.run_feedback_filter(
                start,
                *(1.0, 1.0, LEVEL, YAW),
                imu,
                gyro,
                accel,
                [measurements.NedVelocity(still, float(sigma))],
                time_step=1.0,
            )
            rows = found.trajectory.loc[whole, ["heading", "pitch", "roll"]]
            for time, row in zip(whole, rows.to_numpy(), strict=True):
                print(run.study, run.run_id, round(time), *row, sep=",", file=file)


if __name__ == "__main__":
    main(*sys.argv[1:])

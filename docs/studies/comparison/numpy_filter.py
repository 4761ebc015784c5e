"""The smallest program that can enter: a linear filter of five states, NumPy alone.

python numpy_filter.py DIR OUT      (DIR: an export with --format psins)
"""

import csv
import sys
from pathlib import Path
from typing import Any

import numpy as np

WIE = 7.2921151467e-5  # rad/s
GYRO, ACCEL, VELOCITY = 4.848e-8, 4.903e-4, 0.01  # rad/sqrt(s), m/s/sqrt(s), m/s/sqrt(Hz)
ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")


def rotation(v: Any) -> Any:
    """Return the matrix of a rotation vector."""
    angle = np.linalg.norm(v) + 1e-300
    x, y, z = v / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def align(imu: Any, c: Any, latitude: float, gravity: float) -> Any:
    """Yield time and attitude matrix (body to east, north, up) every second."""
    dt, v, f = imu[0, 6], np.zeros(2), np.eye(5)
    earth = WIE * np.array([0, np.cos(latitude), np.sin(latitude)])
    p = np.diag(np.square([1, 1, *np.radians([15, 15, 80])]))  # velocity EN, misalignment ENU
    q = np.diag(np.square([ACCEL, ACCEL, GYRO, GYRO, GYRO])) * dt
    f[2, 3], f[2, 4], f[3, 2], f[4, 2] = dt * np.array([earth[2], -earth[1], -earth[2], earth[1]])
    for k, row in enumerate(imu, 1):
        dv = c @ (row[3:6] + np.cross(row[:3], row[3:6]) / 2)
        v, c = v + dv[:2], rotation(-earth * dt) @ c @ rotation(row[:3])
        f[0, 3:], f[1, 2:5:2] = [-gravity * dt, dv[1]], [gravity * dt, -dv[0]]
        p = f @ p @ f.T + q
        gain = p[:, :2] @ np.linalg.inv(p[:2, :2] + np.eye(2) * VELOCITY**2 / dt)
        x, p = gain @ v, p - gain @ p[:2]
        v, c = v - x[:2], rotation(x[2:]) @ c  # fed back at once
        if k % round(1 / dt) == 0:
            yield row[6], c


def main(folder: str, out: str) -> None:
    """Align every run of an export."""
    rows = list(csv.DictReader((Path(folder) / "initial.csv").read_text().splitlines()))
    with open(out, "w") as file:
        csv.writer(file).writerow(["study", "run_id", "time_s", *ANGLES])
        for run in rows:
            yaw, pitch, roll = (np.radians(float(run[name])) for name in ANGLES)
            start = rotation([0, 0, yaw]) @ rotation([pitch, 0, 0]) @ rotation([0, roll, 0])
            place = np.radians(float(run["latitude_deg"])), float(run["gravity_m_per_s2"])
            for time, c in align(np.loadtxt(Path(folder) / run["file"]), start, *place):
                angles = [np.arctan2(-c[0, 1], c[1, 1]), np.arcsin(c[2, 1])]
                angles += [np.arctan2(-c[2, 0], c[2, 2])]
                csv.writer(file).writerow([run["study"], run["run_id"], time, *np.degrees(angles)])


if __name__ == "__main__":
    main(*sys.argv[1:])

"""A base whose attitude is that of a file."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.studies import refusal_line, small_study

import sinsjax
from sinsjax.arena.simulated_record import simulated_record
from sinsjax.errors import InputError
from sinsjax.execution.prepare import prepare_job
from sinsjax.study.identity import fingerprint
from sinsjax.units import DEG, DEG_PER_H

pytestmark = pytest.mark.optimised(False)

TIMES = np.arange(0, 6.05, 0.05)
ANGLES = np.column_stack(
    [
        170 + 20 * np.sin(TIMES),  # through 180
        2 * np.sin(2 * TIMES),
        3 * np.cos(TIMES),
    ]
)
NO_ANGLES = {"yaw_center_deg": None} | {
    f"{angle}_{part}": None
    for angle in ("pitch", "roll", "yaw")
    for part in ("amplitude_deg", "period_s")
}


def written(folder, times=TIMES, angles=ANGLES, name="attitude.csv"):
    yaw, pitch, roll = angles.T
    rows = np.column_stack([times, (yaw + 180) % 360 - 180, pitch, roll])
    path = folder / name
    np.savetxt(path, rows, "%.17g", ",", header="time_s,yaw_deg,pitch_deg,roll_deg", comments="")
    return str(path)


def with_file(path, **changes):
    return small_study(motion=NO_ANGLES | {"attitude_file": path}, **changes)


@pytest.mark.nightly
def test_gyros_measure_the_attitude_between_rows(tmp_path):
    errors = {"gyro_bias_deg_per_h": 0.0, "gyro_noise_deg_per_h": 0.0}
    study = with_file(written(tmp_path), sensors=errors)
    record = simulated_record(study)
    latitude = 32 * DEG
    earth = 15.041067 * DEG_PER_H * np.array([0, np.cos(latitude), np.sin(latitude)])
    given = Rotation.from_euler("ZXY", ANGLES, degrees=True)
    steps = [Rotation.from_rotvec(row) for row in record.dtheta]
    c = given[0]
    for n in range(1, len(TIMES)):
        for step in steps[5 * (n - 1) : 5 * n]:
            c = c * step
        turned = Rotation.from_rotvec(-earth * TIMES[n])  # of n in inertial space
        difference = (turned * c * given[n].inv()).magnitude()
        assert difference < 2e-6  # coning within samples of 0.01 s is left


def test_study_with_file_has_no_floor(tmp_path):
    assert not any(sinsjax.run(with_file(written(tmp_path))).summary["has_floor"].to_pylist())


def test_identity_has_the_content_of_the_file(tmp_path):
    study = with_file(written(tmp_path))
    before = fingerprint(study)
    assert fingerprint(study) == before
    written(tmp_path, angles=ANGLES + 1e-3)
    assert fingerprint(study) != before


BAD = {
    "short": (TIMES[:100], ANGLES[:100], "covers 0 to 4.95 s, but the study needs 0 to 6 s"),
    "unsorted": (TIMES[::-1], ANGLES, "time_s does not increase"),
    "gap": (np.delete(TIMES, range(30, 40)), np.delete(ANGLES, range(30, 40), 0), "has a gap of"),
    "radians": (TIMES, np.radians(ANGLES), "are they in radians?"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_file_is_one_line(name, tmp_path):
    times, angles, text = BAD[name]
    study = with_file(written(tmp_path, times, angles))
    with pytest.raises(InputError) as caught:
        prepare_job(study)
    assert text in str(caught.value) and len(caught.value.lines) == 1


def test_missing_file_is_one_line():
    with pytest.raises(InputError, match=r"nowhere\.csv: cannot be read"):
        prepare_job(with_file("nowhere.csv"))


def test_file_excludes_angles_turns_and_draws():
    given = NO_ANGLES | {"attitude_file": "a.csv"}
    for key, value in {
        "roll_center_deg": 1.0,
        "turn_times_s": [1.0],
        "yaw_center_deg": 3.0,
    }.items():
        line = refusal_line(motion=given | {key: value})
        assert line.startswith(f"[motion] {key}: conflicts with attitude_file in [motion]")
    law = {"latitude_deg": {"uniform": [10.0, 20.0]}}
    line = refusal_line(motion=given, earth={"latitude_deg": None}, drawn=law)
    assert line.startswith("[drawn] latitude_deg: cannot be drawn with attitude_file")
    line = refusal_line(axes={"attitude_file": ["a.csv", "b.csv"]})
    assert "attitude_file: cannot be swept (use one study per file)" in line

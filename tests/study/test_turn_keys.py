"""Turns of the base: by keys, by a file of attitude, and as `init record --from` finds them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.studies import STILL, small_study
from support.turning_logs import DEG, DEG_PER_H

import sinsjax as package
from sinsjax import InputError
from sinsjax.execution.prepare import prepare_job
from sinsjax.study.load import fingerprint
from sinsjax.study.motion import turn_ignoring_method_warnings

pytestmark = [pytest.mark.optimised(False), pytest.mark.usefixtures("drawn_on_request")]

NO_ERRORS = {"gyro_bias_deg_per_h": 0.0, "gyro_noise_deg_per_h": 0.0}
FAST = {"turn_times_s": [1.0], "turn_rate_deg_per_s": 90.0, "turn_ramp_s": 0.5}
THERE_AND_BACK = {"turn_times_s": [0.0, 3.0], "turn_angles_deg": [400.0, -400.0]}
THERE_AND_BACK |= {"turn_rate_deg_per_s": 200.0, "turn_ramp_s": 0.2}


# Keys


def turn_rates(duration_s: float, **turns: Any) -> np.ndarray:
    """Return the rate of the samples about the vertical without Earth's, deg/s."""
    study = small_study(
        study={"duration_s": duration_s, "window_s": None},
        sensors=NO_ERRORS,
        motion=STILL | {f"turn_{key}": value for key, value in turns.items()},
    )
    rates = np.asarray(package.simulated_record(study).dtheta)[:, 2] * 100 / DEG
    return rates - 15.041067 / 3600 * np.sin(32 * DEG)


def test_turn_has_exact_angle_in_whole_samples():
    turns = {"times_s": [1.004], "angles_deg": -100.0, "rate_deg_per_s": 7.0, "ramp_s": 0.333}
    made = turn_rates(20.0, **turns)
    assert sum(made) / 100 == pytest.approx(-100.0, abs=1e-4)
    assert np.flatnonzero(np.abs(made) > 1e-3)[0] >= 100
    assert made.min() == pytest.approx(-6.99790062981, abs=1e-4)


def test_turns_repeat_until_the_end_and_the_last_keeps_its_rate():
    turns = {"times_s": [0.0, 5.0], "angles_deg": [90.0, -90.0], "rate_deg_per_s": 45.0}
    made = turn_rates(37.0, **turns, repeat_s=12.0)
    signs = np.sign(np.round(made, 2))
    starts = np.flatnonzero(np.diff(signs, prepend=0) * signs > 0)
    np.testing.assert_allclose(starts / 100, [0, 5, 12, 17, 24, 29, 36], atol=0.1)
    assert made.max() == pytest.approx(45.0, abs=1e-4)


@pytest.mark.parametrize(
    ("method", "motion", "warned"),
    [
        ("kalman5", FAST, True),
        ("inertial", FAST, True),
        ("inertial", FAST | THERE_AND_BACK, False),
        ("kalman10", FAST, False),
        ("kalman5", {}, False),
    ],
)
def test_methods_that_do_not_use_turns_are_named(method, motion, warned):
    study = small_study(motion=motion, alignment={"method": method, "phi_u0_deg": 0.0})
    lines = list(turn_ignoring_method_warnings(study))
    assert len(lines) == warned
    assert all(line.startswith(f"[alignment] method: {method} does not") for line in lines)


# Files of attitude

TIMES = np.arange(0, 6.05, 0.05)
ANGLES = np.column_stack(  # yaw, through 180, pitch, roll
    [170 + 20 * np.sin(TIMES), 2 * np.sin(2 * TIMES), 3 * np.cos(TIMES)]
)
NO_ANGLES = {"yaw_center_deg": None} | {
    f"{angle}_{part}": None
    for angle in ("pitch", "roll", "yaw")
    for part in ("amplitude_deg", "period_s")
}


def with_file(folder: Path, times: np.ndarray = TIMES, angles: np.ndarray = ANGLES) -> Any:
    yaw, pitch, roll = angles.T
    rows = np.column_stack([times, (yaw + 180) % 360 - 180, pitch, roll])
    path = folder / "attitude.csv"
    np.savetxt(path, rows, "%.17g", ",", header="time_s,yaw_deg,pitch_deg,roll_deg", comments="")
    return small_study(motion=NO_ANGLES | {"attitude_file": str(path)}, sensors=NO_ERRORS)


def test_gyros_measure_the_attitude_between_rows(tmp_path):
    record = package.simulated_record(with_file(tmp_path))
    earth = 15.041067 * DEG_PER_H * np.array([0, np.cos(32 * DEG), np.sin(32 * DEG)])
    given = Rotation.from_euler("ZXY", ANGLES, degrees=True)
    c = given[0]
    for n, increments in enumerate(np.reshape(record.dtheta, (-1, 5, 3)), 1):
        for increment in increments:
            c = c * Rotation.from_rotvec(increment)
        turned = Rotation.from_rotvec(-earth * TIMES[n])  # of n in inertial space
        difference = (turned * c * given[n].inv()).magnitude()
        assert difference < 2e-6  # coning within samples of 0.01 s is left


def test_identity_has_the_turns_and_the_content_of_the_file(tmp_path):
    turned = small_study(motion=FAST)
    assert fingerprint(small_study()) != fingerprint(turned)
    study = with_file(tmp_path)
    before = fingerprint(study)
    assert fingerprint(study) == before
    with_file(tmp_path, angles=ANGLES + 1e-3)
    assert fingerprint(study) != before


@pytest.mark.parametrize(
    ("times", "angles", "text"),
    [
        (TIMES[:100], ANGLES[:100], "covers 0 to 4.95 s, but the study needs 0 to 6 s"),
        (TIMES[::-1], ANGLES, "time_s does not increase"),
        (*(np.delete(table, range(30, 40), 0) for table in (TIMES, ANGLES)), "has a gap of"),
    ],
    ids=["short", "unsorted", "gap"],
)
def test_bad_file_is_one_line(times, angles, text, tmp_path):
    study = with_file(tmp_path, times, angles)
    with pytest.raises(InputError) as caught:
        prepare_job(study)
    assert text in str(caught.value) and len(caught.value.lines) == 1
    Path(study.motion.attitude_file).unlink()
    with pytest.raises(InputError, match=r"attitude\.csv: cannot be read"):
        prepare_job(study)

"""The reference of a record from what its runs hold."""

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from docs.studies.car_test import page as car_test


def test_the_reference_comes_back_from_attitude_and_misalignment():
    angles = np.array([[0.9, 0.2, -90.6], [-3.0, 4.0, 170.0]])  # pitch, roll, yaw, deg
    true = Rotation.from_euler("ZXY", angles[:, [2, 0, 1]], degrees=True)
    phi = np.array([[5.0, -8.0, 300.0], [0.0, 2.0, -90.0]])
    guess = Rotation.from_rotvec(np.deg2rad(phi / 60)).inv() * true  # C_true = exp(phi x) C_hat
    yaw, pitch, roll = guess.as_euler("ZXY", degrees=True).T
    curves = pa.table(
        {"pitch_deg": pitch, "roll_deg": roll, "yaw_deg": yaw}
        | {f"phi_{a}_arcmin": phi[:, i] for i, a in enumerate("enu")}
    )
    np.testing.assert_allclose(car_test.reference_attitude(curves), angles, atol=1e-10)

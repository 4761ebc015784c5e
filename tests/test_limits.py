"""What constant biases leave of an alignment: closed forms against averages, and against runs."""

from typing import Any

import jax
import numpy as np
import pytest
from engine import ARCMIN
from naive import DEG
from scipy.spatial.transform import Rotation
from studies import small_study

from sinsjax import scenario, simulate
from sinsjax.limits import mean_attitude
from sinsjax.trajectory import Motion, Sway

DEG_PER_H = DEG / 3600


def motion(**angles: tuple[float, float, float, float]) -> Motion:
    """Center, amplitude (deg), period (s) and phase (deg) of each angle, still ones left out."""
    still = (0.0, 0.0, 10.0, 0.0)
    return Motion(
        *(
            Sway(*(np.float64(a) for a in (c * DEG, amplitude * DEG, period, phase * DEG)))
            for c, amplitude, period, phase in (angles.get(k, still) for k in Motion._fields)
        )
    )


MOTIONS = {
    "still": motion(pitch=(5, 0, 10, 0), roll=(-8, 0, 7, 20), yaw=(200, 0, 10, 3)),
    "paper": motion(pitch=(1, 1.8, 6, 0), roll=(0, 2.4, 8, 10), yaw=(40, 2.8, 10, 0)),
    "large": motion(pitch=(10, 60, 6.1, 0), roll=(-20, 100, 7.3, 40), yaw=(130, 180, 9.7, 70)),
    "in step": motion(pitch=(10, 60, 8, 0), roll=(-20, 80, 8, 40), yaw=(130, 120, 8, 70)),
    "pitch with yaw": motion(pitch=(0, 60, 8, 30), roll=(5, 80, 7.1, 40), yaw=(30, 120, 8, 70)),
    "roll with yaw": motion(pitch=(0, 60, 7.1, 30), roll=(5, 80, 8, 40), yaw=(30, 120, 8, 70)),
    "pitch with roll": motion(pitch=(0, 60, 8, 30), roll=(5, 80, 8, 40), yaw=(30, 120, 7.1, 0)),
}


@pytest.mark.parametrize("name", MOTIONS)
def test_the_mean_attitude_is_that_over_many_periods(name: str) -> None:
    one = MOTIONS[name]
    t = np.linspace(0, 71_000, 300_007, endpoint=False)
    angles = [s.center + s.amplitude * np.sin(2 * np.pi * t / s.period + s.phase) for s in one]
    pitch, roll, yaw = angles
    turned = Rotation.from_euler("ZXY", np.column_stack([yaw, pitch, roll])).as_matrix()
    weights = np.hanning(len(t))  # over no whole number of all periods
    want = np.tensordot(weights, turned, 1) / weights.sum()
    np.testing.assert_allclose(mean_attitude(one), want, rtol=0, atol=1e-6)
    np.testing.assert_allclose(jax.jit(mean_attitude)(one), mean_attitude(one), rtol=0, atol=1e-14)


def biases_of(**changes: Any) -> tuple[Any, Any]:
    """Group and mean biases of a small study."""
    (part,) = scenario.parts(small_study(**changes))
    return part.group, part.group.world.biases


def limit_of(group: Any) -> Any:
    """Limits of a group's variants."""
    world = group.world
    params = jax.tree.map(lambda a: a[0], group.variants)
    return simulate.limit(group.static, world.pass_records, params, world.site, world.biases)


def test_biases_turn_with_the_vehicle() -> None:
    """Heading 90 deg: east is body -y, north is body x; swayed by J0 of the amplitude."""
    sensors = {"gyro_bias_deg_per_h": [0.1, 0.2, 0.3], "accel_bias_ug": [300.0, 500.0, 0.0]}
    still = {f"{angle}_amplitude_deg": 0.0 for angle in ("pitch", "roll")}
    sways = {"yaw_center_deg": 90.0, "yaw_amplitude_deg": 90.0} | still
    group, (eps, nabla) = biases_of(motion=sways, sensors=sensors)
    shrunk = 0.47200121576823484  # J0(pi/2)
    want = np.array([-0.2 * shrunk, 0.1 * shrunk, 0.3]) * DEG_PER_H
    np.testing.assert_allclose(eps, want, rtol=1e-12)
    np.testing.assert_allclose(nabla[:2], np.array([-500, 300]) * 9.8e-6 * shrunk, rtol=1e-12)


def test_papers_limit_accuracy() -> None:
    """[P1] section 2.4.1 prints -27.0248'; small angles, both terms and 15.041 deg/h -25.877'."""
    still = {f"{angle}_amplitude_deg": 0.0 for angle in ("pitch", "roll", "yaw")}
    group, _ = biases_of(motion={"yaw_center_deg": 0.0} | still)
    phi = limit_of(group).phi
    omega_n = 15.041067 * np.cos(32 * DEG)
    want = -np.arctan2(0.1, omega_n + 0.1) + 500e-6 * np.tan(32 * DEG)
    assert phi.z == pytest.approx(want, abs=0.01 * ARCMIN)
    assert phi.z / ARCMIN == pytest.approx(-25.8769, abs=0.25)
    np.testing.assert_allclose((phi.x, phi.y), (-500e-6, 500e-6), rtol=0.005)

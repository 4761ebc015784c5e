"""Q in units of densities, and the heading in compass convention."""

import numpy as np
import pytest
from support.studies import small_study

from sinsjax.engine import build
from sinsjax.errors import InputError
from sinsjax.execution import run
from sinsjax.study.identity import fingerprint
from sinsjax.study.load import study_from_dict, study_to_tables

OLD = {"q_reading": "psd", "q_gyro_deg_per_h": 0.18, "q_accel_ug": 60.0}
GYRO = {"q_gyro_deg_per_h_per_sqrt_hz": 0.18, "q_gyro_arw_deg_per_sqrt_h": 0.003}


def compute_q(**filter_: float | str) -> np.ndarray:
    (part,) = build.parts(small_study(filter=filter_))
    return np.array(part.group.variants.method.q)[:, 0]


@pytest.mark.parametrize("key", GYRO)
def test_density_keys_give_same_q_as_psd_units(key: str) -> None:
    """An angle random walk of N deg/sqrt(h) adds N^2 t/3600 deg^2 in t seconds."""
    new = compute_q(q_reading="psd", q_accel_ug_per_sqrt_hz=60.0, **{key: GYRO[key]})
    np.testing.assert_allclose(new, compute_q(**OLD), rtol=1e-12)
    np.testing.assert_allclose(new[2:], np.deg2rad(0.003) ** 2 / 3600 * 0.01, rtol=1e-12)
    np.testing.assert_allclose(new[:2], (60e-6 * 9.8) ** 2 * 0.01, rtol=1e-12)


def test_psd_and_per_sample_noise_give_same_q() -> None:
    """At 100 Hz a sample has ten times the density; as it is, it has a hundred times the sigma."""
    sample = {"q_gyro_deg_per_h": 1.8, "q_accel_ug": 600.0}
    of_a_sample = compute_q(q_reading="per_sample", **sample)
    np.testing.assert_allclose(of_a_sample, compute_q(**OLD), rtol=1e-12)
    np.testing.assert_allclose(compute_q(q_reading="per_step", **sample), 100.0**2 * of_a_sample)


def test_density_key_can_be_swept() -> None:
    values = [0.001, 0.003]
    study = small_study(filter={"q_reading": "psd"}, axes={"q_gyro_arw_deg_per_sqrt_h": values})
    (part,) = build.parts(study)
    np.testing.assert_allclose(
        part.group.variants.method.q[4], (np.deg2rad(values) / 60) ** 2 * 0.01, rtol=1e-12
    )


def test_study_with_densities_round_trips_with_same_fingerprint() -> None:
    study = small_study(filter={"q_reading": "psd", "q_gyro_arw_deg_per_sqrt_h": 0.003})
    assert study.filter is not None and study.filter.q_gyro_deg_per_h is None
    assert fingerprint(study_from_dict(study_to_tables(study))) == fingerprint(study)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        (
            {"filter": {"q_reading": "psd", "q_gyro_deg_per_h": 1.0, **GYRO}},
            "study: [filter] q_gyro_deg_per_h: conflicts with q_gyro_deg_per_h_per_sqrt_hz in"
            " [filter] (give one of them)",
        ),
        (
            {"filter": {"q_accel_ug_per_sqrt_hz": 1.0}},
            "study: [filter] q_accel_ug_per_sqrt_hz: requires q_reading = 'psd', not 'per_step'",
        ),
        (
            {
                "filter": {"q_gyro_arw_deg_per_sqrt_h": 0.1},
                "axes": {"q_reading": ["psd", "per_sample"]},
            },
            "study: [filter] q_gyro_arw_deg_per_sqrt_h: requires q_reading = 'psd', not"
            " 'per_sample'",
        ),
    ],
)
def test_conflicting_or_misplaced_density_keys_are_refused(changes: dict, line: str) -> None:
    with pytest.raises(InputError) as caught:
        small_study(**changes)
    assert str(caught.value) == line


@pytest.mark.slow
@pytest.mark.optimised(False)
def test_heading_is_clockwise_from_north() -> None:
    study = small_study(axes={"yaw_center_deg": [10.0, -100.0]}, alignment={"phi_u0_deg": 0.0})
    made = run.run(study, curves=True)
    for table in made:
        yaw, heading = (np.array(table[f"{name}_deg"]) for name in ("yaw", "heading"))
        assert ((heading >= 0) & (heading < 360)).all()
        np.testing.assert_allclose(np.cos(np.deg2rad(heading + yaw)), 1, atol=1e-12)
    assert set(np.round(np.array(made.summary["heading_deg"]), -1)) == {350.0, 100.0}


def test_heading_of_east_is_90_and_just_west_of_north_is_zero() -> None:
    from sinsjax.engine.metrics import Observation
    from sinsjax.execution import tables
    from sinsjax.types import Vec3

    zero = np.zeros(3)
    seen = Observation(
        Vec3(zero, zero, zero), Vec3(zero, zero, zero), zero, zero, np.r_[1e-30, 0.0, -np.pi / 2]
    )
    told = tables.TableBuilder(small_study())._angle_columns(seen)["heading_deg"]
    assert told.to_pylist() == [0.0, 0.0, 90.0]

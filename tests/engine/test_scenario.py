"""Studies become SI numbers: swept, drawn or fixed, every run is that of a study of its values."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.studies import STILL, small_study, small_tables

import sinsjax
from sinsjax.errors import InputError
from sinsjax.records import Record, Reference
from sinsjax.records.reference import StoredRecord, reference_attitudes
from sinsjax.study.keys import SECTION_OF
from sinsjax.study.load import study_from_dict
from sinsjax.study.values import drawn_values

pytestmark = pytest.mark.optimised(False)

DEG = np.pi / 180


def test_euler_misalignment_is_rotation_rz_rx_ry() -> None:
    """C_n'^n = Rz(U) Rx(E) Ry(N), [P1] section 1; phi is its rotation vector."""
    phi = sinsjax.one_run(small_study(alignment={"misalignment": "euler"})).params.phi
    want = Rotation.from_euler("ZXY", [30, 5, 5], degrees=True).as_rotvec()
    np.testing.assert_allclose(phi, want, atol=1e-15)


DRAWS = 5
ALL = {
    "latitude_deg": {"uniform": [-60.0, 60.0]},
    "yaw_center_deg": {"uniform": [0.0, 360.0]},
    "pitch_center_deg": {"values": [-5.0, 5.0]},
    "roll_amplitude_deg": {"uniform": [0.0, 3.0]},
    "roll_period_s": {"uniform": [3.0, 8.0]},
    "yaw_phase_deg": {"uniform": [-180.0, 180.0]},
    "gyro_bias_deg_per_h": {"normal": [0.0, 0.1]},
    "accel_bias_ug": {"values": [100.0, [50.0, -50.0, 20.0]]},
    "gyro_noise_deg_per_h": {"values": [0.5, 0.0, 0.2]},
    "accel_scale_ppm": {"normal": [0.0, 100.0]},
    "gyro_misalignment_arcsec": {"normal": [0.0, 20.0]},
    "phi_e0_deg": {"normal": [0.0, 3.0]},
    "phi_u0_deg": {"uniform": [-30.0, 30.0]},
    "vn0_m_per_s": {"normal": [0.0, 0.1]},
}


def drawn_tables(*keys: str, **changes: Any) -> dict[str, Any]:
    """Tables of a small study in which some keys are drawn."""
    data = small_tables(**{"study": {"draws": DRAWS}} | changes)
    for key in keys:
        data[SECTION_OF[key]].pop(key, None)
    return data | {"drawn": {"sampling": "sobol"} | {key: ALL[key] for key in keys}}


def fixed(data: dict[str, Any], values: dict[str, Any], *dropped: str) -> dict[str, Any]:
    """The same tables with fixed values of some keys, and without some sections."""
    out = {name: table for name, table in data.items() if name not in dropped}
    for key, value in values.items():
        out[SECTION_OF[key]] = out.get(SECTION_OF[key], {}) | {key: value}
    return out


def assert_same_run(got: dict[str, Any], want: dict[str, Any], *other: str) -> None:
    """Assert that rows agree to rounding, which grows over a run, but for some columns."""
    for name in want.keys() - {*other}:
        if isinstance(want[name], float):  # an angle of 1e-9 arcmin is nothing
            np.testing.assert_allclose(got[name], want[name], rtol=1e-7, atol=1e-8, err_msg=name)
        else:
            assert got[name] == want[name], name


THREE = {"axes": {"p0_yaw_deg": [40.0, 50.0, 80.0]}}
REPEATED = {"passes": {"stored_s": 2.0}}
COMPASS = {"alignment": {"method": "compass"}, "compass": {"level_time_s": 1.0}}
AT_REST = ["yaw_center_deg", "pitch_center_deg", "gyro_bias_deg_per_h", "phi_u0_deg"]


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("keys", "changes"),
    [
        (["latitude_deg"], {"earth": {"earth": "wgs84"}} | THREE),
        (AT_REST, {"motion": STILL} | THREE),
        (AT_REST, REPEATED | {"alignment": {"specific_force": "gravity"}}),
        (["latitude_deg", "yaw_center_deg", "phi_u0_deg"], REPEATED | COMPASS),
        ([*ALL], {"alignment": {"misalignment": "euler"}} | THREE),
    ],
    ids=["latitude", "at rest", "passes", "compass", "all"],
)
def test_run_with_drawn_values_equals_run_with_fixed_values(
    keys: list[str], changes: dict[str, Any]
) -> None:
    """And so do the records of its sensors."""
    data = drawn_tables(*keys, **changes)
    study = study_from_dict(data)
    drawn = drawn_values(study, DRAWS)
    runs = sinsjax.run(study).summary.to_pylist()
    for draw in (0, DRAWS - 1):
        values = {key: drawn[key][draw].tolist() for key in keys}
        single = study_from_dict(fixed(data, values, "drawn"))
        at = draw * study.n_variants
        assert_same_run(runs[at], sinsjax.run(single).summary.to_pylist()[at], *keys)
        for key, value in values.items():
            np.testing.assert_array_equal(runs[at][key], value)
        records = [sinsjax.simulated_record(one, draw) for one in (study, single)]
        for name in ("dtheta", "dv", "latitude_deg"):
            pair = (getattr(record, name) for record in records)
            np.testing.assert_allclose(*pair, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("needed", "fits"),
    [
        *((span, False) for span in ((105.5, 120), (80, 104), (120, 103))),
        *((span, True) for span in ((110, 120), (80, 100), (20, 30), (0, 100), (110, 200))),
    ],
)
def test_reference_gap_is_refused_if_needed_span_touches_it(needed: tuple, *, fits: bool) -> None:
    """A sample within the span is not enough: the ends lie between two, which may be far apart.

    The base turns by 6 deg/s; its reference has steps of 1 s, and gaps of 5 and 10 s.
    """
    time_s = np.arange(201.0)
    time_s = time_s[((time_s <= 5) | (time_s >= 10)) & ((time_s <= 100) | (time_s >= 109.5))]
    record = Record(dtheta=np.zeros((1, 3)), dv=np.zeros((1, 3)), rate_hz=100.0)
    stored = StoredRecord(record, Reference(time_s, np.outer(time_s, [0, 0, 6.0]), None))
    needed = np.array(needed, float)
    if not fits:
        with pytest.raises(InputError, match="has a gap of 10 s where the study needs it"):
            reference_attitudes(stored, needed)
        return
    found = Rotation.from_quat(reference_attitudes(stored, needed), scalar_first=True)
    left = Rotation.from_rotvec(np.outer(needed, [0, 0, 6 * DEG])).inv() * found
    np.testing.assert_allclose(left.magnitude(), 0, atol=1e-12)

"""Keys with a value a draw: every run is what a study of that value alone would have given."""

from typing import Any

import numpy as np
import pytest
from support.studies import BASE, PAPER, STILL

from sinsjax.engine import build
from sinsjax.execution import run
from sinsjax.study import sampling as draw_sampling
from sinsjax.study.keys import SECTION_OF
from sinsjax.study.load import study_from_dict
from sinsjax.study.schema import SensorsSection

pytestmark = pytest.mark.optimised(False)

DRAWS = 5
NOISE = {key: value for key, value in BASE["sensors"].items() if "bias" not in key}
ALL = {
    "latitude_deg": {"uniform": [-60.0, 60.0]},
    "yaw_center_deg": {"uniform": [0.0, 360.0]},
    "pitch_center_deg": {"grid": [-5.0, 5.0]},
    "roll_amplitude_deg": {"uniform": [0.0, 3.0]},
    "roll_period_s": {"uniform": [3.0, 8.0]},
    "yaw_phase_deg": {"uniform": [-180.0, 180.0]},
    "gyro_bias_deg_per_h": {"normal": [0.0, 0.1]},
    "accel_bias_ug": {"values": [100.0, [50.0, -50.0, 20.0]]},
    "accel_scale_ppm": {"normal": [0.0, 100.0]},
    "gyro_misalignment_arcsec": {"normal": [0.0, 20.0]},
    "phi_e0_deg": {"normal": [0.0, 3.0]},
    "phi_u0_deg": {"uniform": [-30.0, 30.0]},
    "vn0_m_per_s": {"normal": [0.0, 0.1]},
}


def drawn_study(keys: list[str], sampling: str = "random", **changes: Any) -> dict[str, Any]:
    """`BASE` with some keys drawn, as nested dictionaries."""
    data = {name: dict(section) for name, section in BASE.items()}
    data["study"]["draws"] = DRAWS
    for name, section in changes.items():
        data[name] = data.get(name, {}) | section
    for key in keys:
        data[SECTION_OF[key]].pop(key, None)
    data["drawn"] = {"sampling": sampling} | {key: ALL[key] for key in keys}
    return data


def fixed(data: dict[str, Any], values: dict[str, np.ndarray], draw: int) -> dict[str, Any]:
    """The same study without drawing, its keys having the values of one draw."""
    out = {name: dict(section) for name, section in data.items() if name != "drawn"}
    for key, column in values.items():
        out[SECTION_OF[key]][key] = column[draw].tolist()
    return out


AT_REST = ["yaw_center_deg", "pitch_center_deg", "gyro_bias_deg_per_h", "phi_u0_deg"]
EULER = {"alignment": {"misalignment": "euler"}}
THREE = {"axes": {"p0_yaw_deg": [40.0, 50.0, 80.0]}}
"""Variants; with as many everywhere the studies share what is compiled."""


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("keys", "sampling", "changes"),
    [
        (["gyro_bias_deg_per_h", "accel_scale_ppm", "gyro_misalignment_arcsec"], "random", THREE),
        (["latitude_deg"], "sobol", {"earth": {"earth": "wgs84"}} | THREE),
        (AT_REST, "random", {"motion": STILL} | THREE),
        (
            ["yaw_center_deg", "gyro_bias_deg_per_h", "phi_u0_deg"],
            "random",
            {"passes": {"stored_s": 2.0}, "alignment": {"specific_force": "gravity"}},
        ),
        (
            ["latitude_deg", "yaw_center_deg", "phi_u0_deg"],
            "random",
            {
                "passes": {"stored_s": 2.0},
                "alignment": {"method": "compass"},
                "compass": {"level_time_s": 1.0},
            },
        ),
        (["phi_e0_deg", "phi_u0_deg", "vn0_m_per_s"], "random", EULER | THREE),
        (list(ALL), "sobol", EULER | THREE),
    ],
)
def test_run_with_drawn_values_equals_run_with_fixed_values(
    keys: list[str], sampling: str, changes: dict[str, Any]
) -> None:
    data = drawn_study(keys, sampling, **changes)
    study = study_from_dict(data)
    values = draw_sampling.drawn_values(study, DRAWS)
    rows = run.run(study).summary
    for draw in (0, DRAWS - 1):
        alone = run.run(study_from_dict(fixed(data, values, draw))).summary
        run_id = draw * study.n_variants
        got, want = (table.slice(run_id, 1).to_pylist()[0] for table in (rows, alone))
        for key in keys:
            np.testing.assert_array_equal(got.pop(key), values[key][draw])
            want.pop(key, None)
        for name, value in want.items():
            if isinstance(value, float):
                # The engine's rounding grows over a run; an angle of 1e-9 arcmin is nothing.
                np.testing.assert_allclose(got[name], value, rtol=1e-7, atol=1e-8, err_msg=name)
            else:
                assert got[name] == value, name


@pytest.mark.nightly
@pytest.mark.optimised(True)
def test_drawn_rows_do_not_depend_on_chunks_or_draw_count() -> None:
    data = drawn_study(list(ALL), "sobol", study={"draws": 130}, **EULER, **THREE)
    whole = run.run(study_from_dict(data)).summary
    assert run.run(study_from_dict(data), chunk_runs=64).summary.equals(whole)
    fewer = study_from_dict(data | {"study": data["study"] | {"draws": 70}})
    assert run.run(fewer).summary.equals(whole.slice(0, 70 * 3))


@pytest.mark.nightly
def test_noise_level_can_be_drawn() -> None:
    data = drawn_study([], axes=THREE["axes"], filter=PAPER | {"q_reading": "psd"})
    for key in NOISE:
        del data["sensors"][key]
    data["drawn"] = {"gyro_noise_deg_per_h": {"values": [0.0, 0.5]}}
    study = study_from_dict(data)
    (part,) = build.parts(study)
    assert part.group.static.sensors.noisy
    last = run.run(study).summary["phi_u_arcmin"].to_pylist()[:: study.n_variants]
    # Draws 0, 2, 4 have none: nothing tells them apart.
    assert last[0] == last[2] == last[4] and len({last[0], last[1], last[3]}) == 3
    assert set(NOISE) <= set(SensorsSection.model_fields)


@pytest.mark.nightly
def test_simulated_record_of_draw_matches_study_of_its_values() -> None:
    study = study_from_dict(drawn_study(["yaw_center_deg", "latitude_deg", "gyro_bias_deg_per_h"]))
    values = draw_sampling.drawn_values(study, DRAWS)
    record = build.simulated_record(study, draw_id=3)
    assert record.latitude_deg == pytest.approx(values["latitude_deg"][3], abs=1e-12)
    data = fixed(drawn_study(list(values)), values, 3)
    alone = build.simulated_record(study_from_dict(data), draw_id=3)
    np.testing.assert_allclose(record.dtheta, alone.dtheta, rtol=0, atol=1e-14)
    np.testing.assert_allclose(record.dv, alone.dv, rtol=0, atol=1e-13)

"""The error budget against finite changes of each source, and the wrapped heading against draws."""

from typing import Any

import numpy as np
import pytest

import sinsjax
from sinsjax.advice.advise import (
    SOURCES,
    Budget,
    heading_budget,
    scale_source,
    sheet_problem,
    wrapped_error,
)
from sinsjax.advice.sheet import Sheet, read_sheet
from sinsjax.strapdown.processes import rounding_process

SENSORS = {
    **{"gyro_arw_deg_per_sqrt_h": 0.02, "gyro_instability_deg_per_h": 0.1},
    **{"accel_vrw_ug_per_sqrt_hz": 50.0, "accel_instability_ug": 40.0},
}
DRAWN = {
    "gyro_bias_deg_per_h": {"normal": [0.0, 0.2]},
    "accel_bias_ug": {"normal": [0.0, 500.0]},
}


def sheet(**tables: Any) -> Sheet:
    given = {"earth": {"latitude_deg": 50.0}, "sensors": SENSORS, "drawn": DRAWN}
    return read_sheet(given | tables)


def budget_of(given: Sheet, times_s: list[float], left_out: tuple[str, ...] = ()) -> Budget:
    return heading_budget(sheet_problem(given), times_s, left_out)


MANY = {
    "sensors": SENSORS
    | {"gyro_rrw_deg_per_h_per_sqrt_h": 0.5, "accel_rrw_ug_per_sqrt_h": 100.0}
    | {"gyro_quantisation_arcsec": 20.0, "accel_quantisation_um_per_s": 3000.0},
    "drawn": DRAWN
    | {"gyro_scale_ppm": {"normal": [0.0, 3000.0]}}
    | {"gyro_misalignment_arcsec": {"normal": [0.0, 2000.0]}}
    | {"accel_misalignment_arcsec": {"normal": [0.0, 300.0]}},
    "motion": {"surge_m_per_s": 0.05, "surge_time_s": 5.0, "vibration_ug_rms": 5000.0}
    | {"vibration_hz": 30.0, "vibration_damping": 0.05},
}


@pytest.mark.nightly(fast=("few",))
@pytest.mark.parametrize("case", ["few", "many"])
def test_shares_are_the_slopes_of_the_bound_and_add_up(case):
    given = sheet(**(MANY if case == "many" else {}))
    budget = budget_of(given, [60.0, 200.0])
    assert set(budget.sources) <= SOURCES.keys()
    if case == "many":
        assert {"surge", "gyro_walk", "accel_quantisation", "gyro_scale"} <= {*budget.sources}
    for time_s, row in zip(budget.times_s, budget.variance, strict=True):
        shares = budget.shares(time_s)
        assert sum(shares.values()) == pytest.approx(1)
        assert [*shares.values()] == sorted(shares.values(), reverse=True)
        assert np.all(row > 0)
    for k, source in enumerate(budget.sources):
        more, less = (
            budget_of(scale_source(given, source, factor), [60.0, 200.0]).sigma ** 2
            for factor in (1.02, 0.98)
        )
        slope = (more - less) / (2 * np.log(1.02 / 0.98))
        np.testing.assert_allclose(budget.variance[:, k], slope, rtol=0.02, atol=1e-6 * more.max())


@pytest.mark.parametrize("source", ["gyro_instability", "gyro_bias"])
def test_source_without_a_model_leaves_the_weights_of_the_others(source):
    given = sheet(motion={"turn_times_s": [90.0], "turn_angles_deg": [180.0]})
    known, unknown = budget_of(given, [200.0]), budget_of(given, [200.0], (source,))
    without = budget_of(scale_source(given, source, 0.0), [200.0])
    for name, share in zip(without.sources, without.variance[0], strict=True):
        k = unknown.sources.index(name)
        assert unknown.variance[0, k] == pytest.approx(share, rel=1e-9)
    assert without.sigma[0] < known.sigma[0] < unknown.sigma[0]


def test_bound_of_a_sheet_is_the_information_bound():
    given = sheet()
    motion, drawn = {"yaw_center_deg": 10.0}, dict(given.tables["drawn"])
    del drawn["yaw_center_deg"]
    method = {"alignment": {"method": "inertial"}}
    tables = given.study_tables(method | {"motion": motion, "drawn": drawn})
    study = sinsjax.study_from_dict(tables)
    bound = sinsjax.information_bound(study)["bound_u_arcmin"].to_pylist()
    found = np.degrees(budget_of(given, [60.0, 120.0, 300.0]).sigma) * 60
    np.testing.assert_allclose(found, bound, rtol=2e-3)


@pytest.mark.parametrize("sigma", [0.01, 0.2, 0.6, 3.0])
def test_wrapped_heading_is_that_of_a_vector_with_noise(sigma):
    rng = np.random.default_rng(1)
    x, y = 1 + sigma * rng.standard_normal(400_000), sigma * rng.standard_normal(400_000)
    angle = np.abs(np.arctan2(y, x))
    expected = np.sqrt(np.mean(angle**2)), np.quantile(angle, 0.95)
    assert wrapped_error(sigma) == pytest.approx(expected, rel=0.01)


def test_rounding_process_is_what_rounding_leaves():
    quantum, rng = 2.0, np.random.default_rng(2)
    total = np.cumsum(rng.normal(0, 50.0, 200_000))
    error = np.diff(quantum * np.round(total / quantum) - total)
    process = rounding_process(np.array([quantum] * 3))
    x = rng.standard_normal(200_001)  # y = c x + d w, and x becomes w
    made = process.scale[0] * (process.output[0] * x[:-1] + process.direct * x[1:])
    assert float(process.transition[0, 0]) == 0 and float(process.drive[0]) == 1
    assert made.var() == pytest.approx(error.var(), rel=0.02)
    pair = [np.mean(a[1:] * a[:-1]) for a in (made, error)]
    assert pair[0] == pytest.approx(pair[1], rel=0.03)

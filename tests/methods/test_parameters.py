"""The numbers of each method, from the units of a study."""

import copy
from typing import Any

import numpy as np
from support.batches import batch_of
from support.studies import with_paper_values

from sinsjax.methods import compass as design
from sinsjax.study.load import study_from_dict

G, R = 9.8, 6378165.0
BASE: dict[str, Any] = {
    "study": {"name": "some", "duration_s": 20.0, "rate_hz": 100.0, "draws": 1, "window_s": [4, 6]},
    "earth": {"latitude_deg": 32.057313, "radius_m": R},
    "motion": {"yaw_center_deg": 0.0},
    "alignment": {"method": "compass"},
}
PRINTED = {
    "level_gains": [0.06, 1040.33306122, 0.000081632653],
    "azimuth_gains": [0.02, 259.3332653, 4.082e-9, 0.02],
}
"""As [P2] section 3.1 prints them; the K3 of the level is 50 times what its formula gives."""


def numbers(**tables: Any) -> Any:
    """The method's numbers of a study: leaves (variants, ...)."""
    data = copy.deepcopy(BASE)
    for name, table in tables.items():
        data[name] = data.get(name, {}) | table if isinstance(table, dict) else table
    part = batch_of(study_from_dict(with_paper_values(data)))
    return part.params.method


def all_of(gains: Any) -> np.ndarray:
    return np.stack(gains, axis=-1)


def test_default_compass_gains_match_paper2_except_level_k3() -> None:
    made = numbers()
    np.testing.assert_allclose(all_of(made.level)[0][:2], PRINTED["level_gains"][:2], rtol=5e-11)
    np.testing.assert_allclose(made.level.k3, PRINTED["level_gains"][2] / 50, rtol=1e-8)
    np.testing.assert_allclose(all_of(made.azimuth)[0], PRINTED["azimuth_gains"], rtol=1e-4)


def test_compass_gains_follow_sigma_and_damping() -> None:
    compass = {"level_sigma_per_s": 0.03, "level_damping": 0.6}
    made = numbers(compass=compass | {"azimuth_sigma_per_s": 0.02, "azimuth_damping": 0.8})
    earth = {"gravity": G, "radius": R}
    np.testing.assert_allclose(all_of(made.level)[0], design.level_gains(0.03, 0.6, **earth))
    np.testing.assert_allclose(all_of(made.azimuth)[0], design.azimuth_gains(0.02, 0.8, **earth))


def test_compass_schedules_in_seconds_become_samples() -> None:
    times = numbers(
        compass={"level_time_s": 3.21},
        cases=[
            {"sigma_factors": [4.0, 2.0, 1.0], "sigma_times_s": [5.0, 7.5]},
            {"sigma_factors": [3.0], "sigma_times_s": []},
        ],
    )
    np.testing.assert_array_equal(times.azimuth_from, [321, 321])
    np.testing.assert_array_equal(times.pace.samples, [[500, 750], [np.inf, np.inf]])
    # A piece that never begins has some value.
    np.testing.assert_array_equal(times.pace.values, [[4, 2, 1], [3, 1, 1]])

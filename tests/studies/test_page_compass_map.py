import tomllib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from docs.studies.compass_map import map as error_map
from sinsjax.execution import run as study_run
from sinsjax.report.base import Source
from sinsjax.study.load import load_study, study_from_dict

CONFIG = Path(__file__).parents[2] / "configs" / "paper2_map.toml"
DRAWS = 4
FLOOR = -5.0
AXES = {
    "turn": ["velocity", "reflect"],
    "tape_s": [40, 80, 300],
    "azimuth_sigma_per_s": [0.01, 0.03],
}


def map_study(**changes):
    """The study of the map on a small grid; ``changes`` replace keys of sections."""
    data = tomllib.loads(CONFIG.read_text())
    data["study"]["draws"] = DRAWS
    data["cases"] = [data["cases"][0], data["cases"][2]]
    data["axes"] = AXES
    for name, change in changes.items():
        data[name] = data[name] | change if isinstance(change, dict) and name != "axes" else change
    return study_from_dict(data)


def source_of(study, errors):
    """Results that no engine made, with errors (arcmin) that broadcast to (draws, variants)."""
    shape = (study.n_draws, study.n_variants)
    run = np.arange(shape[0] * shape[1])
    summary = {
        "run_id": run,
        "draw_id": run // shape[1],
        "variant_id": run % shape[1],
        "phi_u_arcmin": FLOOR + np.broadcast_to(errors, shape).ravel(),
        "floor_arcmin": np.full(run.size, FLOOR),
    }
    return Source(Path("results"), study, "map.toml", pa.table(summary))


def test_the_least_error_is_that_of_the_best_schedule_and_sigma():
    study = map_study()
    errors = 1.0 + np.arange(study.n_variants) + 0.1 * np.arange(DRAWS)[:, None]
    errors[:, 14] = 0.5  # of the schedule 4, 2, 1: paper's turn, 80 s, 0.01 1/s
    errors[0, 8] = np.nan  # an unknown error is no small one
    grid = error_map.layout(source_of(study, errors))
    assert grid.axes["schedule"] == ((1.0,), (4.0, 2.0, 1.0))
    assert grid.axes["length"] == (40, 80, 300)
    errors_of = grid.columns["phi_u_arcmin"] - FLOOR
    least = error_map.least_errors(errors_of, grid.axes["turn"])
    assert least["velocity"][1].value == pytest.approx(0.5)
    assert least["velocity"][0].value == pytest.approx(np.sqrt(np.mean(errors[:, 0] ** 2)))
    assert least["reflect"][1].value == pytest.approx(np.sqrt(np.mean(errors[:, 9] ** 2)))


@pytest.mark.optimised(False)
def test_the_linear_loops_are_what_the_engine_does_without_noise():
    study = map_study(
        study={"rate_hz": 20.0, "draws": 1, "duration_s": 200.0, "window_s": [100, 200]},
        sensors={"gyro_noise_deg_per_h": 0.0, "accel_noise_ug": 0.0},
        alignment={"phi_e0_deg": 0.02, "phi_u0_deg": 0.3},
        axes=AXES | {"tape_s": [40.0]},
    )
    found = error_map.heading_errors(study_run.run(study).summary)
    expected = error_map.predict(study)
    # The east channel's part in the north one is left out of the linear loops.
    np.testing.assert_allclose(found, expected, atol=0.3, rtol=0.03)
    assert np.ptp(expected) > 20


def test_convergence_is_from_the_smallest_sigma_that_has_no_failure_above_it():
    within = np.array(
        [[True, False, True, True], [True] * 4, [True, True, True, False], [False] * 3 + [True]]
    )
    found = error_map.converges_from(within, (0.01, 0.02, 0.03, 0.04))
    np.testing.assert_array_equal(found, [0.03, 0.01, np.nan, 0.04])


def test_the_shipped_study_is_the_one_of_the_issue():
    study = load_study(CONFIG)
    assert {"velocity", "velocity_and_rate", "reflect"} <= set(study.axes["turn"])
    tapes = study.axes["tape_s"]
    assert (min(tapes), max(tapes)) == (20, 300) and 80 in tapes
    assert len(study.cases) >= 3 and study.n_draws >= 32
    assert study.study.settle_bands_arcmin == (6.0, 1.2)

import math
import tomllib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from support.stored import store

from docs.studies.compass_map import points as map_points
from docs.studies.compass_map.points import Point
from sinsjax.alignment.compass import design as loops
from sinsjax.execution import run as study_run
from sinsjax.report.base import Source, Table
from sinsjax.study.load import load_study, study_from_dict

CONFIG = Path(__file__).parents[2] / "configs" / "paper2_map.toml"
DRAWS = 4
FLOOR = -5.0
AXES = {
    "turn": ["velocity", "reflect"],
    "tape_s": [40, 80, 300],
    "azimuth_sigma_per_s": [0.01, 0.03],
}


pytestmark = pytest.mark.usefixtures("drawn_on_request")


def map_study(**changes):
    """The study of the map on a small grid; ``changes`` replace keys of sections."""
    data = tomllib.loads(CONFIG.read_text())
    data["study"]["draws"] = DRAWS
    data["cases"] = [data["cases"][0], data["cases"][2]]
    data["axes"] = AXES
    for name, change in changes.items():
        data[name] = data[name] | change if isinstance(change, dict) and name != "axes" else change
    return study_from_dict(data)


def source_of(study, errors, settle=100.0):
    """Results that no engine made: errors (arcmin) and settling times that broadcast to runs."""
    shape = (study.n_draws, study.n_variants)
    run = np.arange(shape[0] * shape[1])
    phi = FLOOR + np.broadcast_to(errors, shape).ravel()
    summary = {
        "run_id": run,
        "draw_id": run // shape[1],
        "variant_id": run % shape[1],
        "phi_u_arcmin": pa.array(phi, from_pandas=True),
        "floor_arcmin": np.full(run.size, FLOOR),
        "settle_6_s": pa.array(np.broadcast_to(settle, shape).ravel(), from_pandas=True),
    }
    return Source(Path("results"), study, "map.toml", pa.table(summary))


def write(directory, source):
    return store(directory, source.study, source.summary)


def tables(made):
    return [b for section in made.sections for b in section.blocks if isinstance(b, Table)]


def point(**changes):
    plain = Point(
        "constant", True, "reflect", 80.0, 0.01, 1.0, 95.0, np.zeros(4), np.ones(4), *3 * (0,)
    )
    return plain._replace(**changes)


# --- points -------------------------------------------------------------------------------------


def test_points_hold_their_runs():
    study = map_study()
    errors = np.arange(study.n_variants) + 0.1 * np.arange(DRAWS)[:, None]
    settle = np.where(errors == 5.0, np.nan, errors)
    points = map_points.points_of(source_of(study, errors, settle))
    assert len(points) == study.n_variants == 24
    here = points[5]
    assert (here.schedule, here.turn, here.tape_s, here.sigma) == (
        "constant",
        "velocity",
        300.0,
        0.03,
    )
    np.testing.assert_allclose(here.errors, errors[:, 5])
    np.testing.assert_array_equal(here.settle_s, [math.inf, *errors[1:, 5]])
    assert here.left == pytest.approx(5.15)
    assert here.rms.value == pytest.approx(np.sqrt(np.mean(errors[:, 5] ** 2)))
    last = points[-1]
    assert (last.schedule, last.constant, last.last_factor) == ("4, 2, 1", False, 1.0)
    assert here.constant


def test_an_unknown_error_is_infinite():
    found = point(errors=np.array([1.0, np.nan])).rms
    assert found.value == math.inf and math.isnan(found.low)


def test_the_radius_is_taken_to_the_power_of_the_cycles():
    study = map_study()
    points = map_points.points_of(source_of(study, 0.0))
    start = points[0].start
    omega_n = math.radians(15.041067) / 3600 * math.cos(math.radians(32.057313))
    tilted = 50e-6 * math.tan(math.radians(32.057313))
    floor = -math.radians(0.02) / 3600 / omega_n + tilted
    assert start == pytest.approx(60 * (1.5 - math.degrees(floor)), rel=1e-6)
    turn = loops.turn_matrix(-1, 1, 1)
    constant, scheduled = points[3], points[15]  # velocity, 80 s, 0.03
    assert (scheduled.turn, scheduled.tape_s, scheduled.sigma) == ("velocity", 80.0, 0.03)
    radii = loops.cycle_radius(0.03 * np.array([4.0, 2.0, 1.0]), 80.0, turn)
    assert constant.radius == scheduled.radius == pytest.approx(radii[2])
    assert constant.by_radius == pytest.approx(start * radii[2] ** (560 / 160))
    powers = np.array([80.0, 80.0, 400.0]) / 160  # from 40, 120 and 200 s on
    assert scheduled.by_radius == pytest.approx(start * np.prod(radii**powers))


def test_the_linear_loops_are_what_the_engine_does_without_noise():
    study = map_study(
        study={"rate_hz": 20.0, "draws": 1, "duration_s": 200.0, "window_s": [100, 200]},
        sensors={"gyro_noise_deg_per_h": 0.0, "accel_noise_ug": 0.0},
        alignment={"phi_e0_deg": 0.02, "phi_u0_deg": 0.3},
        axes=AXES | {"tape_s": [40.0]},
    )
    run = study_run.run(study)
    points = map_points.points_of(Source(Path("x"), study, "map.toml", run.summary))
    found, expected = (np.array([getattr(p, name) for p in points]) for name in ("left", "linear"))
    # The east channel's part in the north one is left out of the linear loops.
    np.testing.assert_allclose(found, expected, atol=0.3, rtol=0.03)
    assert np.ptp(expected) > 20


def test_convergence_is_from_the_smallest_sigma_that_has_no_failure_above_it():
    left = {0.01: 1.0, 0.02: 50.0, 0.03: -3.0, 0.04: 2.0}
    points = [point(sigma=sigma, linear=value) for sigma, value in left.items()]
    points.append(point(sigma=0.05, linear=99.0, constant=False))
    points.append(point(sigma=0.05, linear=99.0, tape_s=40.0))

    def linear(p):
        return p.linear

    assert map_points.converges_from(points, 80.0, 6.0, linear) == pytest.approx(0.03 * 80)
    assert map_points.converges_from(points, 80.0, 2.5, linear) == pytest.approx(0.04 * 80)
    assert map_points.converges_from(points, 40.0, 6.0, linear) is None


def test_agreement_is_about_the_band():
    here = point(errors=np.full(4, -5.0))
    assert map_points.agrees(here, 6.0, 5.9) and not map_points.agrees(here, 6.0, -6.1)
    assert map_points.agrees(here, 4.0, 70.0)


# --- report -------------------------------------------------------------------------------------


def test_the_shipped_study_is_the_one_of_the_issue():
    study = load_study(CONFIG)
    assert {"velocity", "velocity_and_rate", "reflect"} <= set(study.axes["turn"])
    tapes = study.axes["tape_s"]
    assert (min(tapes), max(tapes)) == (20, 300) and 80 in tapes
    assert len(study.cases) >= 3 and study.n_draws >= 32
    assert study.study.settle_bands_arcmin == (6.0, 1.2)

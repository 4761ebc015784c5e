import dataclasses
import io
import math
import tomllib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from rich.console import Console
from support.stored import store

from sinsjax import analysis, report
from sinsjax.alignment.compass import design as loops
from sinsjax.errors import InputError
from sinsjax.execution import run as study_run
from sinsjax.report import compass_map, map_points
from sinsjax.report.base import Source, Table
from sinsjax.report.compass_runs import bound_arcmin
from sinsjax.report.map_points import Point
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


@pytest.mark.usefixtures("drawn")
def test_a_page(tmp_path):
    study = map_study()
    noise = np.random.default_rng(1).normal(size=(DRAWS, study.n_variants))
    directory = write(tmp_path / "r", source_of(study, noise))
    page = tmp_path / "docs" / "compass_map.md"
    report.summarise([directory], Console(file=io.StringIO()), page)
    text = page.read_text()
    assert text.splitlines()[2].startswith("# A tape gone over again")
    assert "Not on this page: `configs/compass_80s_search.toml`" in text
    names = {path.name for path in (page.parent / "figures").iterdir()}
    assert names == {
        f"paper2_map_{n}.png" for n in ("heading_error", "settling_time", "by_tape", "prediction")
    }
    assert "velocity 0.993" in text  # the paper's turn with its sigma and its tape
    assert "reflect" in text and "(0.202 without the lag" in text


def test_the_best_point_of_each_turn_and_tape():
    study = map_study()
    errors = np.full((DRAWS, study.n_variants), 50.0)
    errors[:, 3] = [1.0, -1.0, 1.0, -1.0]  # velocity, 80 s, 0.03, constant
    errors[:, 2] = 20.0  # and at 0.01
    settle = np.full((DRAWS, study.n_variants), np.nan)
    settle[:3, 3] = [100.0, 110.0, 120.0]
    source = source_of(study, errors, settle)
    made = compass_map.report(source)
    best, agreement = tables(made)
    row = next(row for row in best.rows if row[:2] == ["velocity", "80"])
    bound = float(bound_arcmin(study, 80.0))
    assert bound == pytest.approx(0.952, abs=1e-3)
    share, median = analysis.proportion(3, 4), analysis.quantile(settle[:, 3])
    assert row[2:] == [
        "0.03",
        "constant",
        "1.00",  # of one size all, which tells nothing of others
        "0.95",
        f"{1 / bound:.2f}",
        f"75 [{100 * share.low:.0f}, {100 * share.high:.0f}]",
        analysis.format_estimate(median, digits=0),
        "2.4",
        "2.4",
    ]
    assert len(best.rows) == 6 and len(agreement.rows) == 2
    counts = agreement.rows[0]
    assert counts[:4] == ["velocity", "12", "12", "1"]
    assert "velocity from 2.4 to 2.4 (not at 40, 300 s); reflect never" in " ".join(made.headline)


def test_maps_show_the_points_and_the_predicted_radius(monkeypatch):
    drawn = {}

    def keep(panels, title, shown, **others):
        drawn[title] = (panels, shown, others)
        return plain

    from matplotlib.figure import Figure

    plain = Figure()
    monkeypatch.setattr("sinsjax.plots.heat_maps", keep)
    study = map_study()
    errors = np.broadcast_to(1.0 + np.arange(study.n_variants), (DRAWS, study.n_variants))
    settle = np.where(errors < 3, np.nan, errors)
    compass_map.report(source_of(study, errors, settle))
    (panels, shown, others), (times, _, _) = drawn.values()
    names = ["velocity: constant", "reflect: constant", "velocity: 4, 2, 1", "reflect: 4, 2, 1"]
    assert [name for name, _ in panels] == names
    # Rows are sigma, columns the tape; the study's last axis is sigma.
    np.testing.assert_allclose(panels[0][1], [[1, 3, 5], [2, 4, 6]])
    np.testing.assert_allclose(times[0][1], [[np.inf, 3, 5], [np.inf, 4, 6]])
    assert shown.log and shown.high == pytest.approx(95.3, abs=0.1)
    assert (others["rows"].key, others["columns"].key) == ("azimuth_sigma_per_s", "tape_s")
    radii = others["contours"].values
    assert len(radii) == 4 and np.ptp(radii[0]) > 0.5
    assert radii[0].max() <= 1.001 and np.all(radii[0][0, :16] > 0.99)


@pytest.mark.parametrize("key", AXES)
def test_a_key_that_is_missing_is_named(key):
    axes = {name: values for name, values in AXES.items() if name != key}
    study = map_study(axes=axes, passes={"tape_s": 80.0, "turn": "reflect"})
    with pytest.raises(InputError, match=f"layout compass_map needs {key} in"):
        compass_map.report(source_of(study, 0.0))


def test_incomplete_results_are_told():
    source = source_of(map_study(), 0.0)
    with pytest.raises(InputError, match="95 runs where the study has 96"):
        compass_map.report(dataclasses.replace(source, table=source.summary.slice(1)))


def test_the_shipped_study_is_the_one_of_the_issue():
    study = load_study(CONFIG)
    assert study.report.layout == "compass_map"
    assert {"velocity", "velocity_and_rate", "reflect"} <= set(study.axes["turn"])
    tapes = study.axes["tape_s"]
    assert (min(tapes), max(tapes)) == (20, 300) and 80 in tapes
    assert len(study.cases) >= 3 and study.n_draws >= 32
    assert study.study.settle_bands_arcmin == (6.0, 1.2)

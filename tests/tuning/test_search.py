"""Searches: points of designs, the studies of points, objectives, histories and results."""

import threading
from contextlib import nullcontext
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
import tomli_w
from support.studies import PAPER, STILL, small_study

import sinsjax
from sinsjax.errors import InputError
from sinsjax.execution.results import read_summary
from sinsjax.execution.tasks import Job
from sinsjax.study.load import load_study, study_from_dict
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study
from sinsjax.tuning import history, objective, search
from sinsjax.tuning.history import Evaluation, SearchResult
from sinsjax.tuning.search import SearchSession

pytestmark = pytest.mark.optimised(False)

TIMES = [{"low": 1.0, "high": 3.0}, {"low": 1.0, "high": 3.0}]
YAW = {"low": 10.0, "high": 90.0}


def tuned(
    variables: dict[str, Any], *, changes: dict[str, Any] | None = None, **tune: Any
) -> Study:
    tune = {"searches": ["sobol"], "variables": variables, "tune_draws": 2} | tune
    return small_study(tune=tune, **(changes or {}))


COUNTED = tuned({"reset_times_s": TIMES, "reset_count": {"candidates": [0, 1, 2]}})


def positions(study: Study, name: str) -> np.ndarray:
    """Return the points of a design, but the law's, by candidate and positions, 0 to 1."""
    space, points = SearchSpace.from_study(study), search.design_points(study, name)
    return np.array([[p.candidate, *space.to_box(p.values)] for p in points[2:]])


def test_grid_has_every_point_of_every_combination() -> None:
    found, places = positions(COUNTED.replace({"tune.grid_points": 3}), "grid"), [0.0, 0.5, 1.0]
    ones = [[1.0, place, np.nan] for place in places]
    twos = [[2.0, *both] for both in product(places, places)]
    np.testing.assert_array_equal(found, [[0.0, np.nan, np.nan], *ones, *twos])


def test_sobol_points_are_determined_by_seed_and_search() -> None:
    few, more = (
        positions(COUNTED.replace({"tune.sobol_points": count}), "sobol") for count in (4, 9)
    )
    assert few[:, 0].tolist() == [0, *[1] * 4, *[2] * 4]
    inside = few[:, 1:][np.isfinite(few[:, 1:])]
    assert inside.size == 4 + 2 * 4 and (inside >= 0).all() and (inside <= 1).all()
    np.testing.assert_array_equal(few[5:], more[10:14])
    other = search.sobol_boxes(COUNTED, "gradient", 2, 4)
    assert other.shape == (4, 2) and not np.isclose(other[:, :1], inside).any()


def test_derived_study_runs_all_variants_per_search_point() -> None:
    study = tuned(
        {"reset_times_s": TIMES},
        changes={
            "cases": [
                {"case": "near", "phi_e0_deg": 0.0, "phi_u0_deg": 5.0},
                {"case": "far", "phi_e0_deg": 3.0, "phi_u0_deg": 50.0},
            ],
            "axes": {"p0_yaw_deg": [40.0, 80.0], "cases": {"q_accel_ug": [1.0, 2.0]}},
            "study": {"curves": True, "seed": 2**63 - 1},
        },
        evaluation_draws=5,
    )
    points = {"grid 0": {"reset_times_s": (1.0,)}, "grid 4": {"reset_times_s": (1.0, 2.0)}}
    derived = search.derive_study(study, points, name="derived")
    assert (derived.tune, derived.study.name, derived.study.curves) == (None, "derived", False)
    assert (derived.n_draws, derived.study.seed) == (2, study.seed)
    assert derived.n_variants == 2 * study.n_variants == 16
    assert derived.values("case") == ["grid 0"] * 8 + ["grid 4"] * 8
    assert derived.reset_times() == [(1.0,)] * 8 + [(1.0, 2.0)] * 8
    pairs = {*zip(derived.values("phi_e0_deg"), derived.values("phi_u0_deg"), strict=True)}
    assert pairs == {(0.0, 5.0), (3.0, 50.0)}
    evaluated = search.derive_study(study, points, name="derived", evaluation=True)
    assert (evaluated.n_draws, evaluated.study.seed) == (5, 0)  # the next, after the largest


def test_record_is_tuned_and_evaluated_on_different_start_times() -> None:
    study = study_from_dict(
        {
            "study": {"duration_s": 6.0, "rate_hz": 100.0},
            "record": {"format": "psins", "start_s": [0.0, 10.0, 20.0, 30.0, 40.0]},
            "filter": PAPER,
            "tune": {"variables": {"p0_yaw_deg": YAW}, "searches": ["grid"]},
        }
    )
    for evaluation, starts in ((False, (0.0, 20.0, 40.0)), (True, (10.0, 30.0))):
        derived = search.derive_study(
            study, {"a": {"p0_yaw_deg": 1.0}}, name="x", evaluation=evaluation
        )
        assert derived.record is not None and derived.record.start_s == starts


def test_cost_counts_steps_of_all_runs() -> None:
    changes = {"axes": {"phi_u0_deg": [0.0, 5.0]}}
    assert search.total_steps(small_study(**changes)) == 2 * 3 * 600
    repeated = {"passes": {"stored_s": 4.0, "passes": 1}}
    assert search.total_steps(small_study(**changes, **repeated)) == 2 * 3 * 400


ROWS = pa.table(
    {
        "run_id": [5, 4, 3, 2, 1, 0],
        "settle_10_s": [6.0, None, 4.0, 3.0, None, 1.0],
        "settle_60_s": [None, 5.0, 4.0, 3.0, 2.0, 1.0],
        "phi_u_arcmin": [6.0, 5.0, None, 3.0, 2.0, 1.0],
        "floor_arcmin": [2.0, 2.0, 2.0, 2.0, 2.0, 2.0],
    }
)


@pytest.mark.parametrize("judged", ["floor", "truth"])
@pytest.mark.parametrize(
    ("tune", "values", "score"),
    [
        ({}, [[1, 3, 6], [6, 4, 6]], (10 / 3 + 16 / 3) / 2),
        ({"objective_across": "worst"}, [[1, 3, 6], [6, 4, 6]], 16 / 3),
        (
            {"objective": "settle_quantile", "objective_quantile": 0.6},
            [[1, 3, 6], [6, 4, 6]],
            (3 + 6) / 2,
        ),
        ({"objective_band_arcmin": 60.0}, [[1, 3, 5], [2, 4, 6]], 3.5),
        ({"objective": "failure_rate"}, [[0, 0, 1], [1, 0, 0]], 1 / 3),
        (
            {"objective": "final_error", "objective_across": "worst"},
            [[1, 1, 3], [0, np.inf, 4]],
            np.inf,
        ),
    ],
)
def test_objective_is_computed_from_summary_rows(
    tune: dict[str, Any], values: list[Any], score: float, judged: str
) -> None:
    """Two variants and three draws of a study of 6 s; rows in no order."""
    changes = {"axes": {"phi_u0_deg": [0.0, 5.0]}, "study": {"judged_from": judged}}
    study = tuned({"p0_yaw_deg": YAW}, changes=changes, **tune)
    assert study.tune is not None
    rows = ROWS
    if judged == "truth":
        rows = ROWS.rename_columns([n.replace("0_s", "0_truth_s") for n in ROWS.column_names])
        from_truth = pc.subtract(ROWS["phi_u_arcmin"], ROWS["floor_arcmin"])
        rows = rows.drop_columns(["phi_u_arcmin", "floor_arcmin"])
        rows = rows.append_column("phi_u_arcmin", from_truth)
    table = rows.select(objective.summary_columns(study.tune, study))
    found = objective.run_values(study.tune, study, table)
    np.testing.assert_array_equal(found, values)
    assert objective.score(study.tune, found) == pytest.approx(score)
    finite = np.array([[3.0, 4.0]])
    if study.tune.objective == "final_error":
        assert objective.score(study.tune, finite) == pytest.approx(12.5**0.5)


SEARCHED = [
    SearchResult(
        "grid",
        [Evaluation(0, 0, [np.nan, np.nan], 3.0, 7), Evaluation(1, 2, [1.5, 2.5], np.inf, 14)],
    ),
    SearchResult(
        "gradient",
        [
            Evaluation(0, 2, [2.5, 1.5], 1.0, 20, 0, 20.0, 2.0),
            Evaluation(1, 2, [2.0, 1.0], 4.0, 30, 0),
            Evaluation(1, 2, [2.5, 1.0], 3.5, 30, 1),
        ],
    ),
]


def test_history_round_trips_through_parquet(tmp_path: Path) -> None:
    space = SearchSpace.from_study(COUNTED)
    history.write_history(tmp_path, COUNTED, SEARCHED)
    again = history.read_searches(tmp_path, space)
    for written, read in zip(SEARCHED, again, strict=True):
        assert written.search == read.search
        for a, b in zip(written.evaluations, read.evaluations, strict=True):
            np.testing.assert_array_equal(a.values, b.values)
            assert a._replace(values=[]) == b._replace(values=[])
    table = sinsjax.read_history(tmp_path)
    assert table["reset_times_s[0]"].to_pylist() == [None, 1.5, 2.5, 2.0, 2.5]
    assert table["window_s"].to_pylist() == [None, None, 20.0, None, None]
    for name in ("window_s", "reset_times_s[0]"):
        assert table.schema.field(name).metadata[b"unit"] == b"s"
    (tmp_path / "history.parquet").write_text("no table")
    with pytest.raises(InputError, match=r"history\.parquet: "):
        history.read_searches(tmp_path, space)


def test_only_unrelaxed_evaluations_can_be_best() -> None:
    space = SearchSpace.from_study(COUNTED)
    grid, gradient = SEARCHED
    assert (grid.best.step, grid.cost, grid.point(space)) == (0, 14, {"reset_times_s": ()})
    assert (gradient.best.start, gradient.cost) == (1, 30)
    assert gradient.point(space) == {"reset_times_s": (1.0, 2.5)}


@pytest.mark.nightly
def test_grid_search_evaluates_mirrored_reset_times_once(tmp_path: Path) -> None:
    study = tuned(
        {"reset_times_s": TIMES},
        changes={
            "study": {"rate_hz": 20.0, "settle_bands_arcmin": [600], "judged_from": "floor"},
            "motion": STILL,
            "axes": {"phi_u0_deg": [5.0, 30.0]},
        },
        objective="final_error",
        grid_points=3,
    )
    session = SearchSession(
        Job(study, directory=tmp_path), lambda name: nullcontext(), threading.Event()
    )
    found = search.search_points(study, "grid", session)
    places = [1.0, 2.0, 3.0]
    _, *grid = found.evaluations  # the first is the law's
    assert [tuple(e.values) for e in grid] == list(product(places, places))
    costs = [e.cost // (2 * 2 * 120) for e in grid]
    assert costs == [2, 3, 4, 4, 5, 6, 6, 6, 7]
    rows = read_summary(tmp_path / "grid").to_pylist()
    assert sorted({row["case"] for row in rows}) == [f"grid {n}" for n in (0, 1, 2, 3, 5, 6, 9)]
    for e in grid:
        own = [row for row in rows if row["reset_times_s"] == sorted({*e.values})]
        errors = np.array([row["phi_u_arcmin"] - row["floor_arcmin"] for row in own])
        expected = np.sqrt(np.mean(errors.reshape(2, 2) ** 2, axis=0)).mean()
        assert e.objective == pytest.approx(expected)
    assert len({e.objective for e in grid}) == 6


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> sinsjax.TuningResults:
    variables = {"p0_yaw_deg": {"candidates": [0.01, 80.0]}}
    study = tuned(variables, searches=["grid"], objective="final_error", evaluation_draws=8)
    study = study.replace({"tune.baseline": {"p0_yaw_deg": 0.01}})
    folder = tmp_path_factory.mktemp("tuned")
    (folder / "mine.toml").write_text(tomli_w.dumps(study.to_dict()))
    return sinsjax.tune(folder / "mine.toml", folder / "out")


def test_tune_returns_the_best_point_and_the_study_with_it(results: sinsjax.TuningResults) -> None:
    assert results.best == {"p0_yaw_deg": 80.0} and results.search == "grid"
    assert results.study.filter.p0_yaw_deg == 80.0 and results.study.tune is None
    assert results.study == load_study(results.directory / "tuned.toml")
    assert results.study.seed == small_study().seed + 2  # the evaluation has the next one
    assert sinsjax.read_manifest(results.directory / "grid")["config"] == "mine.toml"


def test_tune_returns_objectives_on_fresh_draws(results: sinsjax.TuningResults) -> None:
    errors: dict[str, list[float]] = {"grid": [], "baseline": []}
    for row in read_summary(results.directory / "evaluation").to_pylist():
        errors[row["case"]].append(row["phi_u_arcmin"])
    rms = {key: np.sqrt(np.mean(np.square(values))) for key, values in errors.items()}
    assert results.score.value == pytest.approx(rms["grid"])
    assert results.baseline.value == pytest.approx(rms["baseline"]) and results.baseline.n == 8
    assert results.score.low < results.score.value < results.score.high < results.baseline.low
    assert "arcmin" in results.objective

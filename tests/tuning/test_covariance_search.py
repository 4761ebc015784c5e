"""Search by covariance analysis: its estimates, its finalists, resuming, refused studies."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from support.studies import STILL, small_study

import sinsjax
from sinsjax.errors import InputError
from sinsjax.execution import run
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study
from sinsjax.tuning import history, objective, search

pytestmark = pytest.mark.optimised(False)

TIMES = [{"low": 1.0, "high": 10.0}, {"low": 1.0, "high": 20.0}]
FEW = {
    **{"evolution_screen": 4, "evolution_steps": 2, "feedback_phases": 2},
}
"""Estimates and finalists are equally many runs in most tests, so one program serves all."""


def tuned(changes: dict[str, Any] | None = None, **tune: Any) -> Study:
    tune = {
        "searches": ["covariance"],
        "variables": {"reset_times_s": TIMES},
        "objective_band_arcmin": 60.0,
        **{"tune_draws": 4, "evaluation_draws": 4},
        **FEW,
    } | tune
    section = {"duration_s": 40.0, "window_s": [20, 40], "settle_bands_arcmin": [60.0]}
    motion = {"motion": STILL | {"yaw_center_deg": 10.0}}
    heading = {"phi_e0_deg": 0.1, "phi_n0_deg": 0.1, "phi_u0_deg": 2.0}
    sections = {"study": section, "alignment": heading | {"feedback_interval_s": 1.0}}
    return small_study(tune=tune, **(motion | sections | (changes or {})))


@pytest.fixture(autouse=True, scope="module")
def small_generations() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "GENERATION", 4)
        patch.setattr(objective, "SAMPLES", 1024)
        yield


@pytest.fixture(scope="module")
def found() -> history.SearchResult:
    return search.search_by_covariance(tuned())


def at_points(**tune: Any) -> tuple[Study, Study]:
    """Return a study with [tune], and the study of its runs at four points."""
    study = tuned(tune_draws=256, **tune)
    times = [(5.0, 12.0), (2.0, 3.0), (9.5, 18.0), (7.0, 8.0)]
    points = {str(number): {"reset_times_s": of} for number, of in enumerate(times)}
    return study, search.derive_study(study, points, name="derived")


@pytest.fixture(scope="module")
def summary() -> pa.Table:
    """Return the summary of the runs, the same for all objectives."""
    return run.run(at_points()[1], curves=False).summary


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["settle_mean", "settle_quantile", "failure_rate", "final_error"])
def test_estimated_objective_matches_draws(kind: str, summary: pa.Table) -> None:
    """Within four standard errors of 256 draws, at each of four points."""
    study, derived = at_points(objective=kind)
    assert study.tune is not None
    drawn = search.point_values(study, derived, summary)[:, 0]
    estimated = objective.estimate_values(study.tune, derived)
    assert estimated.shape[0] == 4 == drawn.shape[0]
    for samples, runs in zip(estimated, drawn, strict=True):
        score, expected = (objective.score(study.tune, v[None]) for v in (samples, runs))
        resampled = np.random.default_rng(0).choice(runs, (400, runs.size))
        spread = np.std([objective.score(study.tune, again[None]) for again in resampled])
        # Settling times are whole records.
        assert abs(score - expected) < 4 * spread + 0.3, kind


def test_shift_moves_all_resets_to_whole_samples() -> None:
    study = tuned()
    point = {"reset_times_s": (5.0, 12.34), "q_scale": 0.5}
    assert search.shift_resets(study, point, 0.0) is point
    assert search.shift_resets(study, point, 0.333)["reset_times_s"] == (5.33, 12.67)
    slower = point | {"feedback_interval_s": 10.0}
    assert search.shift_resets(study, slower, 0.5)["reset_times_s"] == (10.0, 17.34)
    assert search.shift_resets(study, {"q_scale": 0.5}, 0.5) == {"q_scale": 0.5}


@pytest.mark.nightly
def test_finalists_are_evaluated_with_tuning_draws(found: history.SearchResult) -> None:
    study = tuned()
    assert study.tune is not None
    space = SearchSpace.from_study(study)
    finalists = [e for e in found.evaluations if not e.estimated]
    assert (len(found.evaluations), len(finalists)) == (1 + 4 + 2 * 4 + 3, 3)
    best = sorted(e.objective for e in found.evaluations if e.estimated)
    assert best[0] <= best[1]
    phases = {
        f"{number} {k}": search.shift_resets(study, space.make_point(list(e.values), {}), k / 2)
        for number, e in enumerate(finalists)
        for k in range(2)
    }
    derived = search.derive_study(study, phases, name="again")
    values = search.point_values(study, derived, run.run(derived, curves=False).summary)
    for e, runs in zip(finalists, values.reshape(3, 2, -1), strict=True):
        assert e.objective == objective.score(study.tune, runs)
    assert found.best in finalists
    costs = [e.cost for e in found.evaluations]
    assert costs == sorted(costs) and costs[0] > 0


@pytest.mark.nightly
def test_same_seed_gives_same_search_result(found: history.SearchResult) -> None:
    assert search.search_by_covariance(tuned()) == found


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("variables", "changes", "finalists"),
    [
        (  # one variable, and resets that it does not move
            {"q_scale": {"low": 0.1, "high": 10.0, "scale": "log"}},
            {"resets": {"reset_times_s": [5.0, 12.0]}},
            4,
        ),
        ({"reset_times_s": TIMES, "reset_count": {"candidates": [0, 2]}}, {}, 3),
        ({"q_scale": {"candidates": [0.5, 2.0]}}, {}, 3),  # no variable
    ],
)
def test_covariance_search_works_with_any_number_of_variables(
    monkeypatch: pytest.MonkeyPatch,
    variables: dict[str, Any],
    changes: dict[str, Any],
    finalists: int,
) -> None:
    monkeypatch.setattr(search, "FINALISTS", finalists)
    study = tuned(changes, variables=variables)
    found = search.search_by_covariance(study)
    space = SearchSpace.from_study(study)
    assert not found.best.estimated
    for e in found.evaluations:
        point = space.make_point(list(np.nan_to_num(e.values)), space.combinations[e.candidate])
        assert search.derive_study(study, {"point": point}, name="point").n_variants == 1


def test_covariance_search_screens_candidates_without_variables_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        search,
        "score_points",
        lambda study, _, points, *__: search.PointScores([1.0] * len(points), study, None),
    )
    study = tuned(variables={"reset_times_s": TIMES, "reset_count": {"candidates": [0, 2]}})
    space = SearchSpace.from_study(study)
    screened = search.search_by_covariance(study).evaluations[:5]
    assert [e.candidate for e in screened] == [0, 1, 1, 1, 1]
    for e in screened:
        used = space.used_variables(space.combinations[e.candidate])
        assert np.flatnonzero(np.isfinite(e.values)).tolist() == used


@pytest.mark.nightly
def test_covariance_tuning_history_is_stored_and_resumed(
    found: history.SearchResult, tmp_path: Path
) -> None:
    study = tuned()
    sinsjax.tune(study, tmp_path / "out")
    rows = history.read_history(tmp_path / "out")
    assert rows["estimated"].to_pylist().count(False) == 3
    assert history.read_searches(tmp_path / "out", SearchSpace.from_study(study)) == [found]
    sinsjax.tune(study, tmp_path / "out", resume=True)
    assert history.read_history(tmp_path / "out").equals(rows)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        (
            {"axes": {"method": ["kalman5", "inertial"]}},
            "method: covariance analysis has no linear model of inertial",
        ),
        ({"passes": {"stored_s": 20.0}}, "[passes]: covariance analysis assumes new white noise"),
        (
            {"motion": {"vibration_ug_rms": 10.0}},
            "[motion] vibration_ug_rms: covariance analysis does not model vibration",
        ),
        (
            {"resets": {"reset_trigger": "innovation", "trigger_threshold": 9.0}},
            "[resets] reset_trigger: covariance analysis needs resets at given times",
        ),
        (
            {"drawn": {"ve0_m_per_s": {"uniform": [0.0, 3.0]}}},
            "[drawn] ve0_m_per_s: covariance analysis needs a normal distribution",
        ),
    ],
)
def test_features_outside_covariance_analysis_are_refused(
    tmp_path: Path, changes: dict[str, Any], line: str
) -> None:
    variables: dict[str, Any] = {"p0_level_deg": {"low": 1.0, "high": 10.0}}
    with pytest.raises(InputError) as caught:
        sinsjax.tune(tuned(changes, variables=variables), tmp_path / "out")
    assert line in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()

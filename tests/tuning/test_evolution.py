"""The search by covariance analysis: what it estimates, how it goes on, what it refuses."""

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
from sinsjax.tuning import estimates, evolution, history, objective, search

pytestmark = pytest.mark.optimised(False)

TIMES = [{"low": 1.0, "high": 10.0}, {"low": 1.0, "high": 20.0}]
FEW = {
    **{"evolution_screen": 4, "evolution_steps": 2, "feedback_phases": 2},
}
"""What is estimated and judged at once is as many runs in most tests: one program for all."""


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
    own = {"study": section, "alignment": heading | {"feedback_interval_s": 1.0}}
    return small_study(tune=tune, **(motion | own | (changes or {})))


@pytest.fixture(autouse=True, scope="module")
def small_generations() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evolution, "POINTS", 4)
        patch.setattr(estimates, "SAMPLES", 1024)
        yield


@pytest.fixture(scope="module")
def found() -> history.Found:
    return evolution.evolve(tuned())


def at_points(**tune: Any) -> tuple[Study, Study]:
    """A study that is tuned, and that of its runs at four points."""
    study = tuned(tune_draws=256, **tune)
    times = [(5.0, 12.0), (2.0, 3.0), (9.5, 18.0), (7.0, 8.0)]
    points = {str(number): {"reset_times_s": of} for number, of in enumerate(times)}
    return study, search.derive(study, points, name="derived")


@pytest.fixture(scope="module")
def summary() -> pa.Table:
    """Of the runs, which know nothing of the objective."""
    return run.run(at_points()[1], curves=False).summary


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["settle_mean", "settle_quantile", "failure_rate", "final_error"])
def test_estimated_objective_matches_draws(kind: str, summary: pa.Table) -> None:
    """Within four standard errors of 256 draws, at each of four points."""
    study, derived = at_points(objective=kind)
    assert study.tune is not None
    drawn = search.run_values(study, derived, summary)[:, 0]
    estimated = estimates.values(derived, study.tune)
    assert estimated.shape[0] == 4 == drawn.shape[0]
    for one, other in zip(estimated, drawn, strict=True):
        got = objective.score(study.tune, one[None])
        samples = np.random.default_rng(0).choice(other, (400, other.size))
        spread = np.std([objective.score(study.tune, again[None]) for again in samples])
        # Settling times are whole records.
        assert abs(got - objective.score(study.tune, other[None])) < 4 * spread + 0.3, kind


def test_shift_moves_all_resets_to_whole_samples() -> None:
    study = tuned()
    point = {"reset_times_s": (5.0, 12.34), "q_scale": 0.5}
    assert evolution.shifted(study, point, 0.0) is point
    assert evolution.shifted(study, point, 0.333)["reset_times_s"] == (5.33, 12.67)
    own = point | {"feedback_interval_s": 10.0}
    assert evolution.shifted(study, own, 0.5)["reset_times_s"] == (10.0, 17.34)
    assert evolution.shifted(study, {"q_scale": 0.5}, 0.5) == {"q_scale": 0.5}


def test_finalists_are_evaluated_with_tuning_draws(found: history.Found) -> None:
    study = tuned()
    assert study.tune is not None
    space = SearchSpace.from_study(study)
    judged = [look for look in found.looks if not look.estimated]
    assert (len(found.looks), len(judged)) == (4 + 2 * 4 + 3, 3)
    best = sorted(look.objective for look in found.looks if look.estimated)
    assert best[0] <= best[1]
    phases = {
        f"{number} {k}": evolution.shifted(study, space.make_point(list(look.values), {}), k / 2)
        for number, look in enumerate(judged)
        for k in range(2)
    }
    derived = search.derive(study, phases, name="again")
    values = search.run_values(study, derived, run.run(derived, curves=False).summary)
    for look, own in zip(judged, values.reshape(3, 2, -1), strict=True):
        assert look.objective == objective.score(study.tune, own)
    assert found.best in judged
    costs = [look.cost for look in found.looks]
    assert costs == sorted(costs) and costs[0] > 0


def test_same_seed_gives_same_search_result(found: history.Found) -> None:
    assert evolution.evolve(tuned()) == found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variables", "changes", "finalists"),
    [
        (  # of one variable, beside resets that none moves
            {"q_scale": {"low": 0.1, "high": 10.0, "scale": "log"}},
            {"resets": {"reset_times_s": [5.0, 12.0]}},
            4,
        ),
        ({"reset_times_s": TIMES, "reset_count": {"candidates": [0, 2]}}, {}, 3),
        ({"q_scale": {"candidates": [0.5, 2.0]}}, {}, 3),  # of none
    ],
)
def test_covariance_search_works_with_any_number_of_variables(
    monkeypatch: pytest.MonkeyPatch,
    variables: dict[str, Any],
    changes: dict[str, Any],
    finalists: int,
) -> None:
    monkeypatch.setattr(evolution, "FINALISTS", finalists)
    study = tuned(changes, variables=variables)
    found = evolution.evolve(study)
    space = SearchSpace.from_study(study)
    assert not found.best.estimated
    for look in found.looks:
        point = space.make_point(
            list(np.nan_to_num(look.values)), space.combinations[look.candidate]
        )
        assert search.derive(study, {"one": point}, name="one").n_variants == 1


def test_covariance_tuning_history_is_stored_and_resumed(
    found: history.Found, tmp_path: Path
) -> None:
    study = tuned()
    sinsjax.tune(study, tmp_path / "out")
    rows = history.read_history(tmp_path / "out")
    assert rows["estimated"].to_pylist().count(False) == 3
    assert history.read(tmp_path / "out", SearchSpace.from_study(study)) == [found]
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
            {"resets": {"reset_trigger": "nis", "trigger_threshold": 9.0}},
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

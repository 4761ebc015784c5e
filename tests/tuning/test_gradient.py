"""Gradient search: gradients against differences, parameters by variables, descents, cost."""

from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from scipy.stats import mstats
from support.studies import small_study

import sinsjax
from sinsjax.engine.scenario import Scenario
from sinsjax.errors import InputError
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study
from sinsjax.tuning import gradient, objective, search
from sinsjax.tuning.gradient import Slope, Softness, TunedParams

pytestmark = pytest.mark.optimised(False)


def log(low: float, high: float) -> dict[str, Any]:
    return {"low": low, "high": high, "scale": "log"}


def logs(**ends: tuple[float, float]) -> dict[str, Any]:
    return {key: log(*both) for key, both in ends.items()}


def linear(low: float, high: float) -> dict[str, Any]:
    return {"low": low, "high": high}


def tuned(variables: dict[str, Any], sections: dict[str, Any], **tune: Any) -> Study:
    tune = {"searches": ["gradient"], "tune_draws": 2, "variables": variables} | tune
    return small_study(**sections, tune=tune)


SHORT = {"duration_s": 60.0, "rate_hz": 10.0, "window_s": [20, 60], "settle_bands_arcmin": [300.0]}

STUDIES = {
    "kalman10": tuned(
        {
            "reset_times_s": [linear(10.0, 18.0), linear(22.0, 30.0)],
            **logs(reset_velocity_m_per_s=(0.01, 1.0), p0_velocity_m_per_s=(0.01, 1.0)),
            **logs(reset_level_deg=(0.1, 20.0), p0_level_deg=(0.5, 20.0)),
            **logs(reset_yaw_deg=(1.0, 90.0), p0_yaw_deg=(5.0, 90.0)),
            **logs(reset_accel_bias_ug=(100.0, 3000.0), p0_accel_bias_ug=(100.0, 3000.0)),
            **logs(reset_gyro_bias_deg_per_h=(0.5, 50.0), p0_gyro_bias_deg_per_h=(0.5, 50.0)),
            **logs(q_scale=(0.2, 5.0), q_accel_ug=(50.0, 5000.0), q_gyro_deg_per_h=(0.1, 10.0)),
            **logs(r_scale=(0.2, 5.0), r_velocity_m_per_s=(0.02, 1.0)),
            "feedback_time_constant_s": log(0.5, 20.0),
        },
        {
            "study": SHORT,
            "alignment": {"method": "kalman10", "phi_e0_deg": 2.0, "phi_n0_deg": 2.0},
            "filter": {"q_reading": "psd", "r_reading": "psd"},
            "axes": {"phi_u0_deg": [5.0, 30.0]},
        },
        objective="settle_quantile",
        objective_across="worst",
        objective_band_arcmin=300.0,
    ),
    "counted": tuned(
        {
            "reset_first_s": linear(8.0, 12.0),
            "reset_cycle_s": linear(10.0, 20.0),
            "q_accel_ug_per_sqrt_hz": log(50.0, 5000.0),
            "q_gyro_deg_per_h_per_sqrt_hz": log(0.1, 10.0),
        },
        {
            "study": SHORT,
            "filter": {
                "q_reading": "psd",
                "q_accel_ug_per_sqrt_hz": 500.0,
                "q_gyro_deg_per_h_per_sqrt_hz": 0.1,
            },
            "resets": {"reset_count": 2, "reset_first_s": 8.0, "reset_cycle_s": 10.0}
            | {"reset_kind": "yaw"},
        },
        objective="final_error",
    ),
    "compass": tuned(
        {
            "sigma_factors": [linear(1.0, 2.0), linear(0.5, 2.0), {"fixed": 0.7}],
            "azimuth_sigma_per_s": log(0.02, 0.05),
            "level_sigma_per_s": log(0.05, 0.2),
            "turn_smoothing_s": log(1.0, 8.0),
        },
        {
            "study": SHORT | {"duration_s": 120.0, "window_s": [60, 120]},
            "alignment": {"method": "compass", "phi_u0_deg": 2.0, "phi_e0_deg": 0.1}
            | {"phi_n0_deg": -0.1},
            "compass": {"level_time_s": 10.0, "sigma_times_s": [40.0, 80.0]}
            | {"sigma_factors": [1.0, 1.0, 1.0]},
            "passes": {"stored_s": 40.0},
        },
        objective="failure_rate",
        objective_band_arcmin=300.0,
    ),
}
VARIABLES = [
    (name, v.name)
    for name, study in STUDIES.items()
    for v in SearchSpace.from_study(study).variables
]


AROUND = np.array([-2.0, -1.0, 1.0, 2.0])


@cache
def gradients(name: str) -> dict[str, tuple[float, float]]:
    """Return the derivative by each variable, and central differences; every point has a lane.

    The error of the differences is of the fourth power of the step. The step of times is so small
    that no sample crosses the edge of a window, where the slope has a bend.
    """
    study = STUDIES[name]
    variables = SearchSpace.from_study(study).variables
    count = len(variables)
    box = np.tile(0.457 + 0.013 * np.arange(count), (1 + 4 * count, 1))
    times = [v.key in ("reset_times_s", "reset_first_s", "reset_cycle_s") for v in variables]
    step = np.where(times, 1e-4, 2e-3)
    for i in range(count):
        box[1 + 4 * i : 5 + 4 * i, i] += step[i] * AROUND
    slope = Slope(TunedParams(study, {}), starts=len(box), draws=2)
    score, by_box = slope(box, np.arange(2), Softness(5.0, 3.0))
    ends = score[1:].reshape(count, 4)
    difference = ends @ np.array([1.0, -8.0, 8.0, -1.0]) / (12 * step)
    rows = zip(variables, by_box[0], difference, strict=True)
    return {v.name: (float(ours), float(theirs)) for v, ours, theirs in rows}


@pytest.mark.nightly
@pytest.mark.parametrize(("name", "variable"), VARIABLES)
def test_gradients_match_finite_differences(name: str, variable: str) -> None:
    ours, theirs = gradients(name)[variable]
    assert theirs != 0 and ours == pytest.approx(theirs, rel=1e-4)


class MadeUpRuns(Slope):
    """Runs whose values are linear in the variables, with these slopes."""

    def __init__(self, study: Study, slopes: np.ndarray) -> None:
        assert study.tune is not None
        self._tune, self._slopes, self._programs = study.tune, slopes, [self]

    def run(self, box: np.ndarray, *_: Any) -> tuple[np.ndarray, np.ndarray]:
        values = 2.0 + np.einsum("vdp,sp->svd", self._slopes, box)
        return values, np.broadcast_to(self._slopes, (*values.shape, box.shape[1]))


@pytest.mark.parametrize("what", ["settle_quantile", "final_error"])
def test_gradient_of_objective_weights_runs_as_the_objective_does(what: str) -> None:
    """Two descents of two variants, three draws and two variables; the worst variant counts."""
    study = tuned({"p0_yaw_deg": log(5.0, 80.0)}, {}, objective=what, objective_across="worst")
    slope = MadeUpRuns(study, np.random.default_rng(3).normal(size=(2, 3, 2)))
    box, softness = np.array([[0.2, 0.7], [0.6, 0.4]]), Softness(5.0, 3.0)
    _, by_box = slope(box, np.arange(3), softness)
    for variable in range(2):
        step = np.where(np.arange(2) == variable, 1e-6, 0.0)
        ahead, behind = (slope(box + by, np.arange(3), softness)[0] for by in (step, -step))
        np.testing.assert_allclose(by_box[:, variable], (ahead - behind) / 2e-6, rtol=1e-5)


@pytest.mark.parametrize(
    ("what", "across"),
    [
        ("settle_mean", "mean"),
        ("settle_quantile", "mean"),
        ("final_error", "worst"),
    ],
)
def test_relaxed_score_is_near_hard_score(what: str, across: str) -> None:
    study = tuned({"p0_yaw_deg": log(5.0, 80.0)}, {}, objective=what, objective_across=across)
    assert study.tune is not None
    runs = np.random.default_rng(7).random((2, 3, 5)) + 0.5
    score, _ = objective.relaxed_score(study.tune, runs)
    if what == "settle_quantile":
        quantiles = [mstats.hdquantiles(row, [0.9])[0] for row in runs.reshape(-1, 5)]
        np.testing.assert_allclose(score, np.reshape(quantiles, (2, 3)).mean(axis=1), rtol=1e-9)
        return
    ratio = np.divide(score, [objective.score(study.tune, values) for values in runs])
    if across == "mean":
        np.testing.assert_allclose(ratio, 1.0, rtol=1e-12)
    else:  # a power mean of three is below the largest
        assert np.all((ratio < 1) & (ratio > 3 ** (-1 / 16)))


# The methods' parameters by the variables


COUNTED = {"study": SHORT, "resets": {"reset_count": 3, "reset_cycle_s": 10.0}}
TEN_STATES = COUNTED | {"alignment": {"method": "kalman10"}}
P0 = {"p0_gyro_bias_deg_per_h": log(1.0, 100.0)}
CYCLE = {"reset_cycle_s": linear(8.0, 16.0), "reset_count": {"candidates": [0, 1, 3]}}
FIRST = {"reset_count": 3, "reset_cycle_s": 10.0, "reset_first_s": 3.0}
CHOSEN = {
    "reset_times_s": [linear(4.0, 12.0), {"fixed": 20.0}, linear(24.0, 32.0)],
    "reset_count": {"candidates": [0, 1, 2, 3]},
}
MOVED: dict[str, Study] = STUDIES | {
    "reset covariance that follows p0": tuned(P0, TEN_STATES),
    "reset covariance that is given": tuned(
        P0, TEN_STATES | {"axes": {"reset_gyro_bias_deg_per_h": [2.0, 3.0]}}
    ),
    "first reset after a cycle, if there is one": tuned(CYCLE, COUNTED),
    "first reset that is given": tuned(CYCLE, COUNTED | {"resets": FIRST}),
    "times": tuned(CHOSEN, {"study": SHORT, "resets": {"reset_times_s": [5.0]}}),
}


@pytest.mark.parametrize("name", MOVED)
def test_params_at_a_point_are_those_of_the_study_with_its_keys(name: str) -> None:
    """At every combination of candidates; some have nothing to move."""
    study = MOVED[name]
    space = SearchSpace.from_study(study)
    for chosen in space.combinations:
        box = np.where(np.arange(len(space.variables)) % 2, 0.25, 0.75)
        tuned, (method,) = TunedParams(study, chosen), study.methods
        there = search.derive_study(
            study, {"point": space.make_point(space.to_values(box), chosen)}, name="point"
        )
        base = search.derive_study(study, {"base": tuned.point}, name="base")
        used = space.used_variables(chosen)
        got = tuned.at(method, Scenario(base, curves=False).keys(0), box[used])
        expected = Scenario(there, curves=False).batch(0).params.method
        assert jax.tree.structure(got) == jax.tree.structure(expected)
        for leaf, other in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(leaf, other, rtol=1e-12)


# The relaxed and the hard objective


def hard_scores(study: Study, box: np.ndarray) -> list[float]:
    """Return the objective at some positions, by ordinary runs."""
    points = search.points_at(SearchSpace.from_study(study), 0, box)
    return gradient.score_hard(study, None, points).scores


@pytest.mark.nightly
def test_relaxed_objective_converges_to_hard_objective() -> None:
    """Three descents and two variants; with gravity the draws share a covariance."""
    study = tuned(
        {"reset_times_s": [linear(6.0, 18.0)], "q_scale": log(0.1, 10.0)},
        {
            "study": SHORT
            | {"rate_hz": 50.0, "duration_s": 40.0, "window_s": [20, 40], "judged_from": "floor"},
            "sensors": {"gyro_bias_deg_per_h": 0.0, "accel_bias_ug": 0.0},
            "alignment": {"specific_force": "gravity", "phi_e0_deg": 2.0, "phi_n0_deg": 2.0},
            "axes": {"phi_u0_deg": [10.0, 30.0]},
        },
        objective_band_arcmin=300.0,
        tune_draws=3,
    )
    box = np.array([[0.1, 0.5], [0.6, 0.2], [0.35, 0.9]])
    hard = hard_scores(study, box)
    slope = Slope(TunedParams(study, {}), starts=3, draws=3)
    softening = (Softness(4.0, 4.0), Softness(2.0, 16.0), Softness(1.0, 64.0))
    off = [np.abs(slope(box, np.arange(3), softness)[0] - hard) for softness in softening]
    assert np.all(off[1].max() < 0.7 * off[0].max()) and off[2].max() < 0.35
    with_other_draws = slope(box, np.array([1, 2, 0]), softening[-1])[0]
    np.testing.assert_allclose(with_other_draws, slope(box, np.arange(3), softening[-1])[0])


# Descents


@pytest.mark.nightly
def test_descents_decrease_objective_and_stay_in_bounds() -> None:
    """Of a compass whose loop may be too slow or too fast; every step uses both draws.

    One ends at the global minimum, one at the edge, which is a local minimum.
    """
    study = tuned(
        {"azimuth_sigma_per_s": log(0.02, 0.08)},
        {
            "study": SHORT | {"duration_s": 120.0, "window_s": [60, 120], "judged_from": "floor"},
            "alignment": {"method": "compass", "phi_e0_deg": 0.0, "phi_n0_deg": 0.0},
            "compass": {"level_time_s": 10.0},
            "passes": {"stored_s": 120.0},
            "axes": {"phi_u0_deg": [1.0, 2.0]},
        },
        objective="final_error",
        descent_screen=4,
        descent_starts=2,
        descent_steps=8,
        descent_draws=2,
    )
    found = gradient.descend(study)
    values = np.array([e.values for e in found.evaluations])
    assert values.min() >= 0.02 and values.max() <= 0.08
    for start in range(2):
        way = [e.objective for e in found.evaluations if e.start == start]
        assert len(way) == 9 and way[-2] < way[0]
    assert found.best.objective < min(hard_scores(study, np.linspace(0, 1, 41)[:, None]))


def test_descent_steps_take_turns_over_the_tuning_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[list[int]] = []

    class FlatSlope(Slope):
        """A slope of zero that records which draws each step asks for."""

        draws, n_draws, cost = 2, 4, 1

        def __init__(self, *_: Any, **__: Any) -> None:
            pass

        def __call__(self, box: np.ndarray, draws: np.ndarray, _: Softness) -> tuple:
            seen.append(draws.tolist())
            return np.zeros(len(box)), np.zeros_like(box)

    monkeypatch.setattr(gradient, "Slope", FlatSlope)
    monkeypatch.setattr(
        gradient, "score_hard", lambda *of: search.PointScores([0.0] * len(of[2]), [0])
    )
    study = tuned(
        {"azimuth_sigma_per_s": log(0.02, 0.08)},
        {"study": SHORT, "alignment": {"method": "compass"}, "compass": {"level_time_s": 1.0}},
        descent_screen=1,
        descent_starts=1,
        descent_steps=4,
        descent_draws=2,
        tune_draws=4,
    )
    gradient.descend(study)
    assert seen == [[0, 1], [2, 3], [0, 1], [2, 3]]


@pytest.mark.nightly
def test_descent_runs_each_candidate_in_turn() -> None:
    """Unused variables have no value; a candidate without variables is scored once.

    The descent begins at the law's point, on a bound, and stays there: both are scored as one.
    """
    variables = {
        "reset_times_s": [linear(5.0, 15.0), linear(18.0, 30.0)],
        "reset_count": {"candidates": [0, 1]},
    }
    study = tuned(
        variables,
        {"study": SHORT, "resets": {"reset_times_s": [5.0]}},
        objective="final_error",
        tune_draws=3,
        descent_screen=1,
        descent_starts=1,
        descent_steps=2,
        descent_draws=2,
    )
    seen: list[tuple[int, int]] = []
    found = gradient.descend(study, on_progress=lambda p: seen.append((p.done, p.total)))
    assert seen == [(2, 4), (4, 4)]
    assert [e.candidate for e in found.evaluations] == [0, 1, 1, 1, 1]
    assert [e.start for e in found.evaluations] == [0, 0, 0, 0, None]
    np.testing.assert_array_equal(
        [np.isnan(e.values) for e in found.evaluations], [[True, True], *[[False, True]] * 4]
    )
    draw = 600  # steps
    costs = [3 * draw, 2 * draw * 3, 2 * draw * 3, 3 * draw, 0]
    assert [e.cost for e in found.evaluations] == list(np.cumsum(costs))
    assert [e.window_s for e in found.evaluations] == [None, 4.0, 1.0, None, None]
    hard = [e for e in found.evaluations if e.sharpness is None]
    assert [e.step for e in hard] == [2, 2, 2]


YAW = {"p0_yaw_deg": log(5.0, 80.0)}
TIMES = {"reset_times_s": [linear(1.0, 3.0)]}
TWO = {"reset_times_s": [2.0]}

REFUSED: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "[tune.variables] feedback_interval_s": ({"feedback_interval_s": linear(0.5, 2.0)}, {}),
    "[resets] reset_kind": (
        TIMES | {"reset_kind": {"candidates": ["full", "yaw", "scale"]}},
        {"resets": TWO},
    ),
    "[resets] reset_trigger": (
        YAW,
        {"resets": {"reset_trigger": "innovation", "trigger_threshold": 9.0}},
    ),
    "[resets] reset_at_feedback": (TIMES, {"resets": TWO | {"reset_at_feedback": True}}),
}


@pytest.mark.parametrize("key", REFUSED)
def test_study_without_gradient_is_refused_before_running(key: str, tmp_path: Path) -> None:
    variables, sections = REFUSED[key]
    study = tuned(variables, sections, searches=["sobol", "gradient"])
    with pytest.raises(InputError) as refused:
        sinsjax.tune(study, tmp_path / "out")
    assert str(refused.value).startswith(f"study: {key}")
    assert not (tmp_path / "out").exists()

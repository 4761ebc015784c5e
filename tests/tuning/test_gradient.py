"""Gradient search: gradients against differences, parameters by variables, descents, cost."""

import jax
import numpy as np
import optax
import pytest
from scipy.stats import mstats
from support.refusals import refusal_line
from support.studies import STILL, small_study

import sinsjax
from sinsjax.engine.scenario import Scenario
from sinsjax.study.search_space import SearchSpace
from sinsjax.tuning import gradient, objective, search
from sinsjax.tuning.gradient import DescentObjectives, Softness, TunedParams

pytestmark = pytest.mark.optimised(False)


def logs(**ends):
    return {key: {"low": low, "high": high, "scale": "log"} for key, (low, high) in ends.items()}


def linear(low, high):
    return {"low": low, "high": high}


def tuned(variables, sections, **tune):
    tune = {"searches": ["gradient"], "tune_draws": 2, "variables": variables} | tune
    return small_study(**sections, tune=tune)


SHORT = {"duration_s": 60.0, "rate_hz": 10.0, "window_s": [20, 60], "settle_bands_arcmin": [300.0]}

STUDIES = {
    "kalman10": tuned(
        logs(reset_velocity_m_per_s=(0.01, 1.0), p0_velocity_m_per_s=(0.01, 1.0))
        | logs(reset_level_deg=(0.1, 20.0), p0_level_deg=(0.5, 20.0))
        | logs(reset_yaw_deg=(1.0, 90.0), p0_yaw_deg=(5.0, 90.0))
        | logs(reset_accel_bias_ug=(100.0, 3000.0), p0_accel_bias_ug=(100.0, 3000.0))
        | logs(reset_gyro_bias_deg_per_h=(0.5, 50.0), p0_gyro_bias_deg_per_h=(0.5, 50.0))
        | logs(q_scale=(0.2, 5.0), q_accel_ug=(50.0, 5000.0), q_gyro_deg_per_h=(0.1, 10.0))
        | logs(r_scale=(0.2, 5.0), r_velocity_m_per_s=(0.02, 1.0))
        | logs(feedback_time_constant_s=(0.5, 20.0))
        | {"reset_times_s": [linear(10.0, 18.0), linear(22.0, 30.0)]},
        {
            "study": SHORT,
            "alignment": {"method": "kalman10", "phi_e0_deg": 2.0, "phi_n0_deg": 2.0},
            "filter": {"q_reading": "psd", "r_reading": "psd"},
            "axes": {"phi_u0_deg": [5.0, 30.0]},
        },
        **{"objective": "settle_quantile", "objective_across": "worst"},
        objective_band_arcmin=300.0,
    ),
    "compass": tuned(
        logs(azimuth_sigma_per_s=(0.02, 0.05), level_sigma_per_s=(0.05, 0.2))
        | logs(turn_smoothing_s=(1.0, 8.0))
        | {"sigma_factors": [linear(1.0, 2.0), linear(0.5, 2.0), {"fixed": 0.7}]},
        {
            "study": SHORT | {"duration_s": 120.0, "window_s": [60, 120]},
            "alignment": {"method": "compass"}
            | {"phi_e0_deg": 0.1, "phi_n0_deg": -0.1, "phi_u0_deg": 2.0},
            "compass": {"level_time_s": 10.0, "sigma_times_s": [40.0, 80.0]}
            | {"sigma_factors": [1.0, 1.0, 1.0]},
            "passes": {"stored_s": 40.0},
        },
        objective="failure_rate",
        objective_band_arcmin=300.0,
    ),
}


@pytest.mark.nightly
@pytest.mark.parametrize("name", STUDIES)
def test_gradients_match_finite_differences(name):
    """Central differences; every point has a lane.

    The step of times is so small that no sample crosses the edge of a window, where the slope has
    a bend.
    """
    variables = SearchSpace.from_study(STUDIES[name]).variables
    count = len(variables)
    box = np.tile(0.457 + 0.013 * np.arange(count), (1 + 4 * count, 1))
    step = np.where([v.key == "reset_times_s" for v in variables], 1e-4, 2e-3)
    for i in range(count):
        box[1 + 4 * i : 5 + 4 * i, i] += step[i] * np.array([-2.0, -1.0, 1.0, 2.0])
    slope = DescentObjectives(TunedParams(STUDIES[name], {}), starts=len(box), draws=2)
    score, by_box = slope(box, np.arange(2), Softness(5.0, 3.0))
    difference = score[1:].reshape(count, 4) @ np.array([1.0, -8.0, 8.0, -1.0]) / (12 * step)
    assert np.all(difference != 0)
    np.testing.assert_allclose(by_box[0], difference, rtol=1e-4)


class MadeUpRuns(DescentObjectives):
    """Runs whose values are linear in the variables, with these slopes."""

    def __init__(self, study, slopes):
        self._tune, self._slopes, self._programs = study.tune, slopes, [self]

    def run_each(self, box, *_):
        values = 2.0 + np.einsum("vdp,sp->svd", self._slopes, box)
        return values, np.broadcast_to(self._slopes, (*values.shape, box.shape[1]))


@pytest.mark.parametrize("what", ["settle_quantile", "final_error"])
def test_gradient_of_objective_weights_runs_as_the_objective_does(what):
    """Two descents of two variants, three draws and two variables; the worst variant counts."""
    study = tuned(logs(p0_yaw_deg=(5.0, 80.0)), {}, objective=what, objective_across="worst")
    slope = MadeUpRuns(study, np.random.default_rng(3).normal(size=(2, 3, 2)))
    box, draws, softness = np.array([[0.2, 0.7], [0.6, 0.4]]), np.arange(3), Softness(5.0, 3.0)
    _, by_box = slope(box, draws, softness)
    for variable, step in enumerate(1e-6 * np.eye(2)):
        ahead, behind = (slope(box + by, draws, softness)[0] for by in (step, -step))
        np.testing.assert_allclose(by_box[:, variable], (ahead - behind) / 2e-6, rtol=1e-5)


def test_relaxed_score_is_near_hard_score():
    runs = np.random.default_rng(7).random((2, 3, 5)) + 0.5

    def ratio(**tune):
        """Return the relaxed score over the hard one, at two points."""
        section = tuned(logs(p0_yaw_deg=(5.0, 80.0)), {}, **tune).tune
        hard = [objective.score(section, values) for values in runs]
        return np.divide(objective.relaxed_score(section, runs)[0], hard)

    np.testing.assert_allclose(ratio(objective="settle_mean"), 1.0, rtol=1e-12)
    worst = ratio(objective="final_error", objective_across="worst")
    assert np.all((worst < 1) & (worst > 3 ** (-1 / 16)))  # a power mean of three
    quantiles = [[mstats.hdquantiles(row, [0.9])[0] for row in point] for point in runs]
    expected = np.mean(quantiles, axis=1) / runs.max(axis=-1).mean(axis=1)
    np.testing.assert_allclose(ratio(objective="settle_quantile"), expected, rtol=1e-9)


MOVED = STUDIES | {
    "reset covariance that follows p0": tuned(
        logs(p0_gyro_bias_deg_per_h=(1.0, 100.0)) | {"reset_cycle_s": linear(8.0, 16.0)},
        {"study": SHORT, "resets": {"reset_count": 3, "reset_cycle_s": 10.0}}
        | {"alignment": {"method": "kalman10"}},
    ),
    "times": tuned(
        {"reset_times_s": [linear(4.0, 12.0), {"fixed": 20.0}, linear(24.0, 32.0)]}
        | {"reset_count": {"candidates": [0, 1, 2, 3]}},
        {"study": SHORT, "resets": {"reset_times_s": [5.0]}},
    ),
}


@pytest.mark.parametrize("name", MOVED)
def test_params_at_a_point_are_those_of_the_study_with_its_keys(name):
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


def test_descents_start_at_the_law_if_it_is_best_and_take_turns_over_the_draws(monkeypatch):
    """The law is among the points of the screen; it is scored on all draws at the end anyway."""
    length = {"duration_s": 20.0, "rate_hz": 20.0, "window_s": [10, 20]}
    study = tuned(
        {"reset_times_s": [linear(0.3, 5.0), linear(2.0, 19.0)]},
        {"study": length, "motion": STILL},
        **{"objective": "final_error", "tune_draws": 4, "descent_draws": 2},
        **{"descent_screen": 4, "descent_starts": 2, "descent_steps": 3},
    )
    law, *_ = search.grid_or_sobol_points(study, "sobol")
    seen = []

    def slope(_, box, draws, *__):
        seen.append(draws.tolist())
        return np.zeros(len(box)), np.ones(box.shape)

    def score(_, __, points, draws=None):
        scores = [abs(np.subtract(point.values, law.values)).sum() for point in points]
        return search.PointScores(scores, [0])

    monkeypatch.setattr(optax, "adam", lambda rate: optax.scale(0.1))
    monkeypatch.setattr(gradient.DescentObjectives, "__call__", slope)
    monkeypatch.setattr(gradient, "score_with_hard_resets", score)
    found = gradient.descend(study)
    assert seen == [[0, 1], [2, 3], [0, 1]]
    starts = [e for e in found.evaluations if e.step == 0]
    assert starts[0].values == pytest.approx(law.values) and len(starts) == 2
    ends = [e for e in found.evaluations if e.sharpness is None]
    assert [e.start for e in ends] == [0, 1, None]
    assert ends[-1].values == pytest.approx(law.values) and found.best == ends[-1]


def test_study_without_gradient_is_refused_before_running(tmp_path):
    resets = {"reset_times_s": [2.0], "reset_at_feedback": True}
    variables = {"reset_times_s": [linear(1.0, 3.0)]}
    study = tuned(variables, {"resets": resets}, searches=["sobol", "gradient"])
    line = refusal_line(sinsjax.tune, study, tmp_path / "out")
    assert line.startswith("[resets] reset_at_feedback: ")
    assert not (tmp_path / "out").exists()

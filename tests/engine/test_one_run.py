"""One run as a function: the engine's bits, mapped, differentiated, and honest about zeros."""

import warnings
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.batches import all_runs, assert_same, batch_of
from support.studies import (
    DRAWN_DISTURBANCES,
    STILL,
    disturbed_tables,
    small_study,
    small_tables,
    with_paper_values,
)

import sinsjax
from sinsjax.errors import InputError
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import study_from_dict
from sinsjax.units import ARCMIN, DEG

pytestmark = pytest.mark.optimised(False)

LENGTH: dict[str, Any] = {"duration_s": 10.0, "window_s": [2, 10], "draws": 3}
LENGTH["settle_bands_arcmin"] = [2000.0, 1000.0]
RESETS = {"reset_times_s": [3.0, 6.0]}
AXES = {"phi_u0_deg": [10.0, 30.0]}


@pytest.fixture(scope="module")
def study() -> Any:
    return small_study(study=LENGTH, resets=RESETS, axes=AXES)


@pytest.fixture(scope="module")
def run(study: Any) -> Any:
    return sinsjax.one_run(study, variant_id=1)


def changed(run: Any, **numbers: Any) -> Any:
    return run.params._replace(method=run.params.method._replace(**numbers))


def by_times(run: Any, samples: Any) -> Any:
    resets = run.params.method.resets._replace(samples=samples)
    return run(changed(run, resets=resets), run.draw(0)).last.phi.z


LONG = {"study": LENGTH | {"draws": 70}}
SEVERAL = LONG | {"axes": {"phi_u0_deg": [0.0, 30.0, 90.0]}}
GRAVITY = {"specific_force": "gravity"}
PASSES = {"passes": {"stored_s": 2.0, "passes": 3}}
DRAWN = {
    "motion": {"pitch_period_s": None},
    "drawn": {"pitch_period_s": {"uniform": [4.0, 8.0]}, "phi_n0_deg": {"uniform": [-5, 5]}},
    "alignment": {"phi_n0_deg": None},
}
MANY = {"p0_yaw_deg": list(np.linspace(10.0, 80.0, 70))}
SURGE = {"motion": STILL | {"surge_m_per_s": [0.1, 0.2, 0.05], "surge_model": "gauss_markov"}}
CASES: dict[str, dict[str, Any]] = {
    "filter": {"resets": RESETS, "axes": AXES},
    "compass": {"alignment": {"method": "compass"}},
    "drawn": DRAWN,
    "shared covariance": {"study": LENGTH | {"draws": 9}, "alignment": GRAVITY, "axes": MANY},
    "disturbed": disturbed_tables(**SEVERAL, drawn=DRAWN_DISTURBANCES),
    "disturbed, passes": disturbed_tables(**SEVERAL | PASSES),
    "disturbed, drawn, passes": disturbed_tables(
        **LONG | PASSES, drawn=DRAWN_DISTURBANCES, alignment=GRAVITY
    ),
    "disturbed, still": disturbed_tables(**SEVERAL | SURGE),
}


@pytest.mark.nightly  # tests/methods/test_level.py has a fast one
@pytest.mark.parametrize(
    "name", [pytest.param("filter", marks=pytest.mark.optimised(True)), *[*CASES][1:]]
)
def test_one_run_equals_run_of_any_chunk(name: str) -> None:
    """To the last bit, or to rounding if it is mapped over draws, where no run shares its P."""
    study = small_study(**{"study": LENGTH} | CASES[name])
    run = sinsjax.one_run(study, variant_id=study.n_variants - 1)
    whole, _ = all_runs(batch_of(study))
    assert_same(whole, all_runs(batch_of(study), devices=2, tiles_per_chunk=2)[0])
    last = study.n_variants - 1
    whole = jax.tree.map(lambda a: a[last :: study.n_variants], whole)
    mapped = jax.jit(jax.vmap(run, in_axes=(None, 0)))(run.params, run.draws)
    assert_same(mapped, whole, 1e-9)
    for number in (0, study.n_draws - 1):
        alone = run(run.params, run.draw(number))
        assert_same(alone, jax.tree.map(lambda a, n=number: a[n], whole))


@pytest.mark.nightly
def test_one_run_of_record_matches_study_at_each_start_time() -> None:
    made = sinsjax.simulated_record(small_study(study={"duration_s": 30.0}))
    tables = {name: small_tables()[name] for name in ("earth", "alignment", "filter")}
    tables["study"] = {"duration_s": 10.0, "rate_hz": 100.0}
    tables["record"] = {"format": "arrays", "start_s": [0.0, 5.0]}
    tables["coarse"] = {"coarse_method": "inertial", "coarse_duration_s": 10.0}
    given = study_from_dict(tables), StoredRecord(made, None)
    run = sinsjax.one_run(*given)
    for number, row in enumerate(sinsjax.run(*given).summary.to_pylist()):
        assert float(run(run.params, run.draw(number)).last.yaw / DEG) == row["yaw_deg"]


@pytest.mark.nightly
def test_derivatives_by_r_p0_and_q_match_finite_differences(run: Any) -> None:
    """Forward and reverse, through feedback and resets, by relative changes of the numbers."""
    method = run.params.method

    def errors(scales: Any) -> Any:
        r, yaw, q = scales
        numbers = {"r": method.r * r, "q": tuple(q * value for value in method.q)}
        numbers["p0"] = (*method.p0[:4], method.p0[4] * yaw)
        outcome = run(changed(run, **numbers), run.draw(0))
        last, means, stds = outcome.last, outcome.mean[:3], outcome.std[:3]
        return jnp.stack([*last.phi, *last.sigma, *means, *stds]) / ARCMIN

    step, one = 1e-4, np.ones(3)
    forward = jax.jit(lambda scales, way: jax.jvp(errors, (scales,), (way,)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        reverse = jax.jit(jax.grad(lambda scales: errors(scales)[2]))(one)
    for way, slope in zip(np.eye(3), reverse, strict=True):
        _, derivative = forward(one, way)
        up, down = (forward(one + sign * step * way, way)[0] for sign in (1, -1))
        secant = (up - down) / (2 * step)
        assert abs(secant[2]) > 1e-6
        np.testing.assert_allclose(derivative, secant, rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(slope, secant[2], rtol=1e-5)


def test_zero_gradient_by_reset_times_or_feedback_interval_warns(run: Any) -> None:
    """When it is traced, not when it has run."""
    method = run.params.method

    def by_interval(every: Any) -> Any:
        numbers = changed(run, feedback=method.feedback._replace(every=every))
        return run(numbers, run.draw(0)).last.phi.z

    for function, at, text in (
        (partial(by_times, run), method.resets.samples, "hard reset times"),
        (by_interval, method.feedback.every, "feedback intervals"),
    ):
        with pytest.warns(UserWarning, match=f"gradient by {text} is zero"):
            assert jax.eval_shape(jax.grad(function), at).shape == np.shape(at)


@pytest.mark.nightly
def test_reset_windows_have_gradient_by_reset_times(study: Any, run: Any) -> None:
    soft = sinsjax.one_run(study, variant_id=1, window_s=0.5)
    samples = soft.params.method.resets.samples
    value, slope = jax.jit(jax.value_and_grad(partial(by_times, soft)))(samples)
    assert np.isfinite(slope).all() and slope.all()
    hard = float(by_times(run, run.params.method.resets.samples))
    assert float(value) == pytest.approx(hard, rel=0.2)


def test_invalid_one_run_request_is_refused_in_one_line(study: Any, run: Any) -> None:
    compass = small_study(study=LENGTH, alignment={"method": "compass"})
    waiting = small_study(study=LENGTH, resets=RESETS | {"reset_at_feedback": True})
    tables = {"study": {"duration_s": 6.0, "rate_hz": 100.0}, "record": {"format": "psins"}}
    recorded = study_from_dict(with_paper_values(tables))
    for call, text in (
        (lambda: sinsjax.one_run(recorded), "reads a record, none is given"),
        (lambda: sinsjax.one_run(study, variant_id=2), "variant 2"),
        (lambda: run.draw(3), "draw 3"),
        (lambda: sinsjax.one_run(study, window_s=0.0), "window_s"),
        (lambda: sinsjax.one_run(compass, window_s=1.0), "window_s: 'compass'"),
        (lambda: sinsjax.one_run(waiting, window_s=1.0), r"window_s: \[resets\] reset_at_feedback"),
    ):
        with pytest.raises(InputError, match=text):
            call()

"""One run as a function: the engine's bits, mapped, differentiated, and honest about zeros."""

import warnings
from functools import partial
from typing import Any

import jax
import numpy as np
import pytest
from support.studies import small_study, small_tables

import sinsjax
from sinsjax.errors import InputError
from sinsjax.study.load import study_from_dict
from sinsjax.units import ARCMIN, DEG

pytestmark = pytest.mark.optimised(False)

LENGTH: dict[str, Any] = {"duration_s": 10.0, "window_s": [2, 10], "draws": 3}
RESETS = {"reset_times_s": [3.0, 6.0]}
AXES = {"phi_u0_deg": [10.0, 30.0]}


def rows_of(study: Any, variant_id: int, stored: Any = None) -> list[dict[str, Any]]:
    table = sinsjax.run(study, stored).summary.to_pylist()
    return [row for row in table if row["variant_id"] == variant_id]


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


CASES: dict[str, dict[str, Any]] = {
    "filter": {"resets": RESETS, "axes": AXES},
    "compass": {"alignment": {"method": "compass"}},
    "drawn": {
        "motion": {"pitch_period_s": None},
        "drawn": {"pitch_period_s": {"uniform": [4.0, 8.0]}, "phi_n0_deg": {"uniform": [-5, 5]}},
        "alignment": {"phi_n0_deg": None},
    },
}


OPTIMISED = [pytest.param("filter", marks=pytest.mark.optimised(True)), "compass", "drawn"]


@pytest.mark.nightly  # tests/methods/test_level.py has a fast one
@pytest.mark.parametrize("name", OPTIMISED)
def test_one_run_is_bit_identical_to_study_row(name: str) -> None:
    study = small_study(study=LENGTH, **CASES[name])
    variant_id = study.n_variants - 1
    run = sinsjax.one_run(study, variant_id=variant_id)
    for number, row in enumerate(rows_of(study, variant_id)):
        outcome = run(run.params, run.draw(number))
        found = [angle / ARCMIN for angle in outcome.last.phi]
        assert found == [row[f"phi_{axis}_arcmin"] for axis in "enu"]


@pytest.mark.nightly
def test_one_run_can_be_vmapped_over_draws() -> None:
    """Which have noise and numbers of their own."""
    run = sinsjax.one_run(small_study(study=LENGTH, **CASES["drawn"]))
    mapped = jax.jit(jax.vmap(run, in_axes=(None, 0)))(run.params, run.draws)
    for number in range(LENGTH["draws"]):
        found = run(run.params, run.draw(number)).last.phi
        together = [angle[number] for angle in mapped.last.phi]
        np.testing.assert_allclose(together, found, rtol=1e-9)


@pytest.mark.nightly
def test_one_run_of_record_matches_study_at_each_start_time(study: Any) -> None:
    stored = sinsjax.simulated_record(small_study(study=LENGTH | {"duration_s": 30.0}))
    time = np.arange(1, len(stored.dv) + 1) / stored.rate_hz
    stored = sinsjax.record_from_arrays(
        time, stored.dtheta, stored.dv, gyro_unit="rad", accel_unit="m_per_s"
    )
    tables = small_tables(study={"duration_s": 10.0, "rate_hz": None, "draws": None})
    tables = {name: tables[name] for name in ("study", "earth", "alignment", "filter")}
    tables["study"] = {"duration_s": 10.0}
    tables["record"] = {"format": "arrays", "start_s": [0.0, 5.0]}
    tables["coarse"] = {"coarse_method": "inertial", "coarse_duration_s": 10.0}
    recorded = study_from_dict(tables)
    run = sinsjax.one_run(recorded, stored)
    for number, row in enumerate(rows_of(recorded, 0, stored)):
        assert float(run(run.params, run.draw(number)).last.yaw / DEG) == row["yaw_deg"]


@pytest.mark.nightly
def test_forward_and_reverse_derivatives_by_r_match_finite_difference(run: Any) -> None:
    """Through feedback and resets."""

    def error(r: Any) -> Any:
        return run(changed(run, r=r), run.draw(0)).last.phi.z

    r = float(run.params.method.r)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        slope = jax.jit(jax.grad(error))(r)
    step = 1e-4 * r
    forward = jax.jit(lambda r: jax.jvp(error, (r,), (1.0,)))
    (above, _), (below, _), (_, tangent) = map(forward, (r + step, r - step, r))
    apart = (above - below) / (2 * step)
    assert apart
    for found in (slope, tangent):
        np.testing.assert_allclose(found, apart, rtol=1e-5)


def test_zero_gradient_by_reset_times_or_feedback_interval_warns(run: Any) -> None:
    samples = run.params.method.resets.samples
    with pytest.warns(UserWarning, match="gradient by hard reset times is zero"):
        slope = jax.eval_shape(jax.grad(partial(by_times, run)), samples)
    assert slope.shape == samples.shape
    with pytest.warns(UserWarning, match="gradient by feedback intervals is zero"):
        every = run.params.method.feedback.every
        feedback = run.params.method.feedback

        def by_interval(every: Any) -> Any:
            changed_ = changed(run, feedback=feedback._replace(every=every))
            return run(changed_, run.draw(0)).last.phi.z

        jax.eval_shape(jax.grad(by_interval), every)  # when it is traced, not when it has run


@pytest.mark.nightly
def test_reset_windows_have_gradient_by_reset_times(study: Any, run: Any) -> None:
    soft = sinsjax.one_run(study, variant_id=1, window_s=0.5)
    samples = soft.params.method.resets.samples
    value, slope = jax.jit(jax.value_and_grad(partial(by_times, soft)))(samples)
    assert np.isfinite(slope).all() and slope.all()
    hard = float(by_times(run, run.params.method.resets.samples))
    assert float(value) == pytest.approx(hard, rel=0.2)


@pytest.mark.nightly
def test_settling_times_have_gradient_only_with_soft_bands(study: Any, run: Any) -> None:
    def settling(run: Any, r: Any) -> Any:
        return run(changed(run, r=r), run.draw(0)).outside_until.sum()

    r = float(run.params.method.r)
    slopes = [
        float(jax.jit(partial(jax.jvp, partial(settling, one)))((r,), (r,))[1])
        for one in (run, sinsjax.one_run(study, variant_id=1, sharpness=8.0))
    ]
    assert slopes[0] == 0 and slopes[1] != 0


def test_invalid_one_run_request_is_refused_in_one_line(study: Any, run: Any) -> None:
    compass = small_study(study=LENGTH, alignment={"method": "compass"})
    waiting = small_study(study=LENGTH, resets=RESETS | {"reset_at_feedback": True})
    for call, text in (
        (lambda: sinsjax.one_run(study, variant_id=2), "variant 2"),
        (lambda: run.draw(3), "draw 3"),
        (lambda: sinsjax.one_run(study, window_s=0.0), "window_s"),
        (lambda: sinsjax.one_run(compass, window_s=1.0), "window_s: 'compass'"),
        (lambda: sinsjax.one_run(waiting, window_s=1.0), r"window_s: \[resets\] reset_at_feedback"),
    ):
        with pytest.raises(InputError, match=text):
            call()

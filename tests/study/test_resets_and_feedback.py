"""`reset_at_feedback` and `reset_restarts_feedback`, for resets between two feedbacks."""

from typing import Any

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.refusals import refused
from support.studies import refusal_line, small_study

from sinsjax.engine.scenario import Scenario
from sinsjax.execution import run as study_run
from sinsjax.execution.success import last_scheduled_reset_s
from sinsjax.methods.filters.keys import acting_reset_times
from sinsjax.study.identity import fingerprint
from sinsjax.study.load import study_to_toml

pytestmark = pytest.mark.optimised(False)

AT, RESTARTS = "reset_at_feedback", "reset_restarts_feedback"
TRIGGER = {
    "reset_trigger": "innovation",
    "trigger_window_s": 0.01,
    "trigger_threshold": 3e-4,
    "trigger_refractory_s": 0.3,
}
KEYS = {AT: [False, True, False, True], RESTARTS: [False, False, True, True]}
PLAIN, WAITING, RESTARTING, BOTH = range(4)


def rows(**tables: Any) -> list[list[dict[str, Any]]]:
    """Return the rows of a short study by variant, without identity and swept columns."""
    short = {"duration_s": 3.0, "window_s": [0, 3]}
    study = small_study(study=short, **tables)
    table = study_run.run(study).summary
    swept = {*study.axis_keys, "run_id", "variant_id", "reset_times_s", "reset_count"}
    variants = table["variant_id"].to_pylist()
    told = table.drop_columns([name for name in table.column_names if name in swept]).to_pylist()
    by_variant: list[list[dict[str, Any]]] = [[] for _ in range(study.n_variants)]
    for variant, row in zip(variants, told, strict=True):
        by_variant[variant].append(row)
    return by_variant


# What a study computes


def test_waiting_resets_have_params_of_resets_scheduled_at_next_feedback():
    def params(times: list[float], **resets: Any) -> list[np.ndarray]:
        tables = {"alignment": {"feedback_interval_s": 0.35}}
        study = small_study(**tables, resets={"reset_times_s": times} | resets)
        group = Scenario(study, curves=False).batch(0, range(1))
        return [np.asarray(leaf) for leaf in jax.tree.leaves(group.params)]

    first, second = params([1.05, 1.75]), params([1.05, 2.1])
    assert any((one != other).any() for one, other in zip(first, second, strict=True))
    for times, expected in (([0.71, 1.41], first), ([1.05, 1.77], second), ([1.05, 2.1], second)):
        for one, other in zip(params(times, **{AT: True}), expected, strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.nightly
@pytest.mark.parametrize(
    "method", [pytest.param("kalman5", marks=pytest.mark.optimised(True)), "kalman_sincos"]
)
def test_reset_feedback_keys_do_not_affect_other_variants(method):
    """With a covariance for each run, and with one for all draws."""
    tables = {"alignment": {"method": method, "feedback_interval_s": 0.6}}
    own = rows(**tables, resets={"reset_times_s": [1.0, 1.9]}, axes={"keys": KEYS})
    (alone,) = rows(**tables, resets={"reset_times_s": [1.0, 1.9]})
    assert own[PLAIN] == alone
    assert own[BOTH] == own[WAITING]
    assert own[PLAIN] != own[WAITING] != own[RESTARTING] != own[PLAIN]


@pytest.mark.nightly
def test_triggered_resets_wait_for_next_feedback():
    found = rows(
        alignment={"feedback_interval_s": 0.25},
        filter={"r_velocity_m_per_s": 1e-3},
        resets=TRIGGER | {"reset_times_s": [1.01]},
        axes={"keys": KEYS},
    )
    assert found[BOTH] == found[WAITING]
    assert found[PLAIN] != found[RESTARTING]
    for row in found[WAITING]:
        assert row["triggered_count"] > 1
        ticks = np.array([row["triggered_first_s"], row["triggered_last_s"]]) / 0.25
        np.testing.assert_array_equal(ticks, np.round(ticks))
    assert any(row["triggered_first_s"] % 0.25 for row in found[PLAIN])


# When resets come


@given(
    st.lists(st.integers(1, 5000), max_size=4, unique=True),
    st.integers(1, 700),
    st.sampled_from([100.0, 125.0, 199.8]),
)
@settings(max_examples=50)
def test_resets_are_delayed_to_next_feedback_only(samples, every, rate_hz):
    written = tuple(sample / rate_hz for sample in sorted(samples))
    later = acting_reset_times(rate_hz, written, None, None, None, True, every / rate_hz)
    for sample, time in zip(sorted(samples), later, strict=True):
        tick = round(time * rate_hz)
        assert time * rate_hz == pytest.approx(tick, rel=1e-12)
        assert tick % every == 0 and sample <= tick < sample + every
    assert acting_reset_times(rate_hz, written, None, None, None, False, every / rate_hz) == written


def test_scheduled_last_reset_includes_delay_to_feedback():
    """The columns show the schedule as written, including its axes."""
    study = small_study(
        alignment={"feedback_interval_s": 2.0}, resets={AT: True}, axes={"reset_times_s": [[], [3]]}
    )
    assert last_scheduled_reset_s(study).tolist() == [0.0, 4.0]
    assert study.reset_times() == [(), (3,)]
    assert last_scheduled_reset_s(small_study(alignment={"method": "compass"})).tolist() == [0.0]


# What is absent, and what is refused


@pytest.mark.parametrize("given_keys", [{}, {AT: False}, {RESTARTS: False}])
def test_default_reset_feedback_keys_keep_program_and_fingerprint(given_keys):
    study = small_study(resets=TRIGGER | {"reset_times_s": [1.0]} | given_keys)
    assert fingerprint(study) == fingerprint(small_study(resets=TRIGGER | {"reset_times_s": [1.0]}))
    params = Scenario(study, curves=False).batch(0, range(1)).params.method
    assert params.feedback.restarts is None and params.trigger.at_feedback is None


def test_reset_at_feedback_makes_reset_restarts_feedback_irrelevant():
    cases = [{AT: False, RESTARTS: True}, {AT: True, RESTARTS: False}, {AT: True, RESTARTS: True}]
    study = small_study(resets={"reset_times_s": [1.0]}, cases=cases)
    assert study.duplicate_of.tolist() == [0, 1, 1]
    assert small_study(axes={"keys": KEYS}).duplicate_of.tolist() == [0, 0, 0, 0]
    assert f"{AT} = true" in study_to_toml(small_study(resets={AT: True}))


@refused("""
alignment.feedback_interval_s = 4.0 & resets = {reset_at_feedback = true, reset_times_s = [5]}
    -> [resets] reset_at_feedback: 5 8 6
axes = {reset_at_feedback = [false, true], feedback_interval_s = [1.0, 4.0]}
    & resets = {reset_count = 2, reset_cycle_s = 2.5}
    -> [axes] reset_at_feedback: 5 8 6
coarse.coarse_duration_s = 2.0 & alignment.feedback_interval_s = 1.5
    & resets = {reset_at_feedback = true, reset_times_s = [3.0]}
    -> [resets] reset_at_feedback: 2 1.5
resets.reset_at_feedback = 1                 -> [resets] reset_at_feedback: 1
drawn.reset_restarts_feedback.values = [true]    -> [drawn] reset_restarts_feedback
""")
def test_invalid_reset_feedback_keys_are_refused(refusal):
    refusal.check(refusal_line(**refusal.tables))


def test_coarse_alignment_of_whole_intervals_or_replayed_is_accepted():
    for coarse, interval in (({}, 1.0), ({"coarse_then": "replay"}, 1.5)):
        small_study(
            coarse={"coarse_duration_s": 2.0} | coarse,
            alignment={"feedback_interval_s": interval},
            resets={AT: True, "reset_times_s": [3.0]},
        )

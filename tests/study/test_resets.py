"""When scheduled resets come, what waits for a feedback, and which variants have a trigger."""

from typing import Any

import jax
import numpy as np
import pytest
from support.batches import batch_of
from support.plain_studies import build_study
from support.studies import small_study

from sinsjax.execution.success import last_scheduled_reset_s
from sinsjax.study.load import load_study
from sinsjax.study.reset_plan import reset_schedule
from sinsjax.study.values import Variants

AT, RESTARTS = "reset_at_feedback", "reset_restarts_feedback"


def test_reset_times_follow_count_first_time_and_cycle():
    """A first one of its own; without it the cycle's multiples, as exactly as ever."""
    cycle = {"reset_cycle_s": 0.1}
    study = build_study(resets=cycle, axes={"reset_count": [0, 1, 3], "reset_first_s": [25, 7.5]})
    assert study.reset_times() == [
        *((), (), (25.0,), (7.5,)),
        (25.0, 25.0 + 0.1, 25.0 + 2 * 0.1),
        (7.5, 7.5 + 0.1, 7.5 + 2 * 0.1),
    ]
    (times,) = build_study(resets=cycle | {"reset_count": 3}).reset_times()
    assert times == (0.1, 0.2, 3 * 0.1)
    alone = build_study(resets={"reset_first_s": 25}, axes={"reset_count": [0, 1]})
    assert alone.reset_times() == [(), (25.0,)]


@pytest.mark.parametrize(("p0", "opened"), [(0.1, 1.0), (2.0, 2.0)])
def test_law_opens_velocity_to_one_metre_per_second_or_p0(p0, opened):
    study = load_study("paper1_resets", {"filter.p0_velocity_m_per_s": p0})
    plan = reset_schedule(study, heading_bound_deg=60.0)
    assert plan.settings["reset_velocity_m_per_s"] == opened


def test_waiting_resets_have_params_of_resets_scheduled_at_next_feedback():
    def params(times: list[float], **resets: Any) -> list[np.ndarray]:
        tables = {"alignment": {"feedback_interval_s": 0.35}}
        study = small_study(**tables, resets={"reset_times_s": times} | resets)
        return [np.asarray(leaf) for leaf in jax.tree.leaves(batch_of(study).params)]

    first, second = params([1.05, 1.75]), params([1.05, 2.1])
    assert any((one != other).any() for one, other in zip(first, second, strict=True))
    for times, expected in (([0.71, 1.41], first), ([1.05, 1.77], second), ([1.05, 2.1], second)):
        for one, other in zip(params(times, **{AT: True}), expected, strict=True):
            np.testing.assert_array_equal(one, other)


def test_scheduled_last_reset_includes_delay_to_feedback():
    """The columns show the schedule as written, including its axes."""
    study = small_study(
        alignment={"feedback_interval_s": 2.0}, resets={AT: True}, axes={"reset_times_s": [[], [3]]}
    )
    assert last_scheduled_reset_s(study).tolist() == [0.0, 4.0]
    assert study.reset_times() == [(), (3,)]
    assert last_scheduled_reset_s(small_study(alignment={"method": "compass"})).tolist() == [0.0]


def test_waiting_resets_restart_no_feedback_interval():
    cases = [{AT: False, RESTARTS: True}, {AT: True, RESTARTS: False}, {AT: True, RESTARTS: True}]
    study = small_study(resets={"reset_times_s": [1.0]}, cases=cases)
    assert study.duplicate_of.tolist() == [0, 1, 1]


def test_size_of_a_bias_is_that_of_its_largest_axis_whatever_its_sign():
    study = small_study(axes={"gyro_bias_deg_per_h": [[-0.3, 0.1, 0.0], -0.2, 0.0]})
    sizes = Variants(study, np.arange(3)).rms("gyro_bias_deg_per_h")
    np.testing.assert_array_equal(sizes, [0.3, 0.2, 0.0])

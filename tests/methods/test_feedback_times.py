"""Times of feedbacks whose interval is no whole number of samples."""

import jax.numpy as jnp

from sinsjax.methods.schedules import Due, FeedbackSchedule, next_feedback


def test_feedback_keeps_its_interval_between_samples() -> None:
    every = jnp.asarray(2.5)
    schedule, at, samples = FeedbackSchedule(every, jnp.asarray(1.0), None), every, []
    for n in range(1, 16):
        due = Due(n >= at, jnp.asarray(False))
        at = next_feedback(schedule, at, due, jnp.asarray(float(n)))
        samples += [n] if due.feedback else []
    assert samples == [3, 5, 8, 10, 13, 15]

"""The zero-velocity Kalman filters as studies know them; their keys are those of every filter."""

from functools import partial

from sinsjax.methods.description import Implementation
from sinsjax.methods.filters.config import FILTER_KEYS, describe_filter


def _load(model: str) -> Implementation:
    from sinsjax.methods.filters.parameters import filter_relaxation, parameters
    from sinsjax.methods.zero_velocity.method import build
    from sinsjax.strapdown.error_model import MODELS

    states = MODELS[model].states
    return Implementation(
        partial(build, MODELS[model]),
        partial(parameters, states),
        relaxation=filter_relaxation(states),
    )


KALMAN5 = describe_filter(
    name="kalman5",
    summary="Kalman filter of velocity and attitude errors, zero velocity measured",
    source="[P1] eq. (1)",
    reads=(*FILTER_KEYS, "specific_force"),
    load=partial(_load, "kalman5"),
)

KALMAN10 = describe_filter(
    name="kalman10",
    summary="the same with states of gyro and level accelerometer biases",
    source="[P1] eq. (1), biases as states",
    reads=(*FILTER_KEYS, "specific_force"),
    load=partial(_load, "kalman10"),
    without_effect=(),
    turning="any",
    gyro_bias_keys=(
        ("p0_gyro_bias_deg_per_h", "p0_yaw_deg"),
        ("reset_gyro_bias_deg_per_h", "reset_yaw_deg"),
    ),
)

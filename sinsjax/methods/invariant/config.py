"""The right-invariant filter as studies know it; its keys are those of every filter."""

from functools import partial

from sinsjax.methods.description import Implementation
from sinsjax.methods.filters.config import describe_filter


def _load() -> Implementation:
    from sinsjax.methods.filters.parameters import filter_relaxation, parameters
    from sinsjax.methods.invariant.method import STATES, build

    return Implementation(build, partial(parameters, STATES), relaxation=filter_relaxation(STATES))


INVARIANT = describe_filter(
    name="invariant",
    summary="right-invariant Kalman filter of a base at rest, fed back by the group",
    source="Barrau and Bonnabel (2017)",
    load=_load,
    step_s=15e-9,
)

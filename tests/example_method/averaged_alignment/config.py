"""The method of running averages as studies know it, without JAX."""

from pydantic import Field

from sinsjax.methods.description import COMMON_KEYS, INITIAL_KEYS, Description, Implementation
from sinsjax.value_types import Seconds, Section


class AveragedSection(Section):
    """[averaged]: memory of the averages."""

    averaging_time_s: Seconds = Field(1e4, description="time constant of the averages, s")


def _load() -> Implementation:
    from averaged_alignment.method import build, parameters

    return Implementation(build, parameters)


AVERAGED = Description(
    name="averaged",
    summary="attitude of a base at rest from running averages of specific force and rate",
    source="TRIAD; Britting (1971)",
    sections={"averaged": AveragedSection},
    reads=INITIAL_KEYS,
    without_effect=(*INITIAL_KEYS, *COMMON_KEYS),
    load=_load,
    has_covariance=False,
)

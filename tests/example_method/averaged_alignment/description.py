"""What studies know of the method, without JAX."""

from typing import Annotated

from pydantic import Field

from sinsjax.methods.description import INITIAL_KEYS, Description, Implementation
from sinsjax.value_types import Seconds, Section


class AveragedSection(Section):
    """[averaged]: how long a sample counts."""

    averaging_time_s: Annotated[Seconds, Field(description="time constant of the average, s")] = 1e4


def _load() -> Implementation:
    from averaged_alignment.method import averaged, numbers
    from averaged_alignment.relaxed import RELAXED

    return Implementation(averaged, numbers, relaxed=RELAXED)


AVERAGED = Description(
    name="averaged",
    summary="attitude from the averaged specific force and angular rate of a base at rest",
    source="TRIAD; Britting (1971)",
    sections={"averaged": AveragedSection},
    reads=INITIAL_KEYS,
    silent=INITIAL_KEYS,
    load=_load,
    has_covariance=False,
    step_s=2e-9,
)

"""[surge]: what a filter that knows of a surge believes of it."""

from pydantic import Field

from sinsjax.alignment.description import CheckedStudy
from sinsjax.alignment.triggers.section import has_trigger
from sinsjax.value_types import Seconds, Section, SpeedSigma


class SurgeSection(Section):
    """[surge]: the surge that a filter has states for; what the base does is in [motion]."""

    r_surge_m_per_s: SpeedSigma = Field(
        0.1, description="velocity of the base about zero, rms on each level axis, m/s"
    )
    r_surge_time_s: Seconds = Field(5.0, description="correlation time of that velocity, s")


def check_no_trigger(study: CheckedStudy) -> None:
    """Refuses triggers, which take the first two states for what is measured."""
    if not study.has("resets"):
        return
    for point in study.combinations("method", "reset_trigger"):
        if point["method"] == "kalman_surge" and has_trigger(point["reset_trigger"]):
            study.refuse("reset_trigger", "method kalman_surge takes resets at given times alone")

"""[surge]: the surge of the base that a filter with states for it assumes."""

from pydantic import Field

from sinsjax.methods.description import CheckedStudy
from sinsjax.methods.triggers.section import has_trigger
from sinsjax.value_types import Seconds, Section, SpeedSigma


class SurgeSection(Section):
    """[surge]: the surge of the base that a filter with states for it assumes."""

    r_surge_m_per_s: SpeedSigma = Field(
        0.1,
        description="rms velocity of the surge that the filter assumes along east and along"
        " north, m/s",
    )
    r_surge_time_s: Seconds = Field(
        5.0, description="correlation time of the surge velocity that the filter assumes, s"
    )


def check_no_trigger(study: CheckedStudy) -> None:
    """Refuse triggers, which assume that the first two states are measured."""
    if not study.has("resets"):
        return
    for point in study.combinations("method", "reset_trigger"):
        if point["method"] == "kalman_surge" and has_trigger(point["reset_trigger"]):
            text = "does not apply to method kalman_surge (use reset_times_s or reset_count)"
            study.refuse("reset_trigger", text)

"""Accelerometer levelling as studies know it: [level], params, description."""

from typing import Any

from pydantic import Field

from sinsjax.methods.level.method import build
from sinsjax.methods.method import Method, StudyKeys
from sinsjax.value_types import AccelSigma, Section


class LevelSection(Section):
    """[level]: assumption of accelerometer levelling."""

    level_accel_bias_ug: AccelSigma = Field(
        5000.0, description="accelerometer bias assumed in the 1 sigma of pitch and roll, ug"
    )


def params(keys: StudyKeys, xp: Any) -> Any:
    """Return the tilt by the assumed accelerometer bias, (variants,), rad."""
    return keys.column("level_accel_bias_ug", keys.micro_g) / keys.site.place.gravity


LEVEL = Method(
    name="level",
    summary="pitch and roll from the mean specific force, for gyros that cannot find north; no"
    " heading",
    source="accelerometer levelling, Groves (2013) section 5.6.2",
    sections={"level": LevelSection},
    build=build,
    params=params,
    needs_start=False,
    finds_heading=False,
    step_s=3e-9,
)

"""Accelerometer levelling as studies know it: [level], params, description."""

from typing import Any

from pydantic import Field

from sinsjax.methods.description import Implementation
from sinsjax.methods.parameters import Columns
from sinsjax.methods.without_start import describe_without_start
from sinsjax.value_types import AccelSigma, Section


class LevelSection(Section):
    """[level]: assumption of accelerometer levelling."""

    level_accel_bias_ug: AccelSigma = Field(
        5000.0, description="accelerometer bias assumed in the 1 sigma of pitch and roll, ug"
    )


def parameters(columns: Columns, site: Any, ug: float) -> Any:
    """Return the tilt by the assumed accelerometer bias, (variants,), rad."""
    return columns.column("level_accel_bias_ug", ug) / site.place.gravity


def _load() -> Implementation:
    from sinsjax.methods.level.method import build

    return Implementation(build, parameters)


LEVEL = describe_without_start(
    name="level",
    summary="pitch and roll from the mean specific force, for gyros that cannot find north; no"
    " heading",
    source="accelerometer levelling, Groves (2013) section 5.6.2",
    sections={"level": LevelSection},
    load=_load,
    has_floor=False,
    finds_heading=False,
    step_s=3e-9,
)

"""The triggers by name: this is where one is registered. Free of JAX."""

from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from typing import Any

_SCORES = "sinsjax.methods.triggers.scores"


@dataclass(frozen=True)
class TriggerDescription:
    """A trigger, as studies know it.

    Attributes:
        name: in ``[resets] reset_trigger``; in capitals, that of its `Trigger` in `scores`.
        summary: what it resets at, in half a line.
        fades: whether it makes P fade instead of resetting it.
    """

    name: str
    summary: str
    fades: bool = False

    @cached_property
    def trigger(self) -> Any:
        """What computes: a `base.Trigger`."""
        return getattr(import_module(_SCORES), self.name.upper())


TRIGGERS: dict[str, TriggerDescription] = {
    trigger.name: trigger
    for trigger in (
        TriggerDescription("innovation", "innovations summed over a window, normalised"),
        TriggerDescription("nis", "normalised innovation squared of a sample"),
        TriggerDescription("whiteness", "correlation of innovations over one sample in a window"),
        TriggerDescription("tilt_drift", "tilt drift about east against what P_UU allows"),
        TriggerDescription("levelled", "level corrected no faster than heading explains"),
        TriggerDescription("linearisation", "P_UU below what a linear model can know"),
        TriggerDescription("strong_tracking", "innovations above their covariance", fades=True),
        TriggerDescription("fading", "every sample, by the threshold", fades=True),
    )
}
"""Every trigger by the name of ``reset_trigger``."""

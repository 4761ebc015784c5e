"""The names of triggers, as a study gives them."""

from typing import Literal

TriggerName = Literal[
    "none",
    "innovation",
    "nis",
    "whiteness",
    "tilt_drift",
    "levelled",
    "linearisation",
    "strong_tracking",
    "fading",
]
"""The triggers of `triggers.scores`."""

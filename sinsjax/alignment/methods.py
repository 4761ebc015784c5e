"""Alignment methods by name; a study names one, the engine drives it through `base.Method`."""

from collections.abc import Callable
from functools import partial

from sinsjax.alignment.base import Method, Options
from sinsjax.alignment.compass import method as compass
from sinsjax.alignment.zero_velocity import method as zero_velocity
from sinsjax.strapdown.error_model import MODELS

METHODS: dict[str, Callable[[Options], Method]] = {
    **{name: partial(zero_velocity.build, model) for name, model in MODELS.items()},
    "compass": compass.build,
}
"""A builder for each method."""

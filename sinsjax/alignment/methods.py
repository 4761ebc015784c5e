"""Alignment methods by name; a study names one, the engine drives it through `base.Method`."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from sinsjax.alignment.base import Method, Options, Site
from sinsjax.alignment.compass import method as compass
from sinsjax.alignment.compass import parameters as compass_parameters
from sinsjax.alignment.parameters import Columns
from sinsjax.alignment.zero_velocity import method as zero_velocity
from sinsjax.alignment.zero_velocity import parameters as filter_parameters
from sinsjax.strapdown.error_model import MODELS


def _nothing(columns: Columns, site: Site) -> None:
    """Every value can be run."""


class Kind(NamedTuple):
    """What makes a method; called with options, it builds it.

    Attributes:
        build: from options to the method.
        parameters: from a study's columns, a site, and a micro-g in m/s^2 to the method's numbers.
        check: refuses columns whose numbers cannot be run.
    """

    build: Callable[[Options], Method]
    parameters: Callable[[Columns, Site, float], Any]
    check: Callable[[Columns, Site], None] = _nothing

    def __call__(self, options: Options) -> Method:
        """Build the method."""
        return self.build(options)


METHODS: dict[str, Kind] = {
    **{
        name: Kind(partial(zero_velocity.build, model), filter_parameters.parameters)
        for name, model in MODELS.items()
    },
    "compass": Kind(compass.build, compass_parameters.parameters, compass_parameters.check),
}
"""Every method."""

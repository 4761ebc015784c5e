"""A program outside sinsjax as the engine knows it: an attitude and its covariance, as given.

Its first attitude is that of the run; later ones are put into the state from outside. Runs are
judged from the bias floor of a method that does not estimate the biases.
"""

from typing import Any, NamedTuple

from sinsjax.maths.rotations import normalise
from sinsjax.methods.base import (
    AttitudeCovariance,
    Method,
    Options,
    RunEnd,
    Site,
    unknown_covariance,
)
from sinsjax.methods.floors import BiasFloor, MeanBiases, bias_floor
from sinsjax.strapdown.earth import Place
from sinsjax.types import Navigation, Quat, Sample, Scalar


class ExternalState(NamedTuple):
    """The solution of a program.

    Attributes:
        attitude: from b to n.
        covariance: of its misalignment; NaN if the program gives none.
    """

    attitude: Quat
    covariance: AttitudeCovariance


def build(options: Options) -> Method:
    """Return the method."""
    return Method(
        init=_init,
        step=_step,
        attitude=lambda state: state.attitude,
        covariance=lambda state: state.covariance,
        normalise=lambda state: state._replace(attitude=normalise(state.attitude)),
        floor=_bias_floor,
    )


def _init(params: Any, nav: Navigation) -> ExternalState:
    return ExternalState(nav.q, unknown_covariance(nav.ve))


def _step(
    params: Any, site: Site, state: ExternalState, sample: Sample, n: Scalar
) -> ExternalState:
    return state


def _bias_floor(params: Any, place: Place, biases: MeanBiases, end: RunEnd) -> BiasFloor:
    return bias_floor(place, biases)

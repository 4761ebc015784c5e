"""What linear loops predict for a run of a compass study: the heading error over update time.

The north channel alone, from the stated initial error, without noise: levelling ([P2] Fig. 1) with
the heading that it does not control, then azimuth ([P2] Fig. 2), pass by pass. A turn that reflects
the tilt goes by the low-passed specific force, which lags behind it.
"""

from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import jax
import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from sinsjax.alignment.compass import design as loops
from sinsjax.alignment.compass import method as compass
from sinsjax.alignment.compass import parameters as compass_parameters
from sinsjax.alignment.compass.design import Number
from sinsjax.engine.truth import site_of
from sinsjax.report.base import only
from sinsjax.study.study import Study
from sinsjax.study.variants import Variants
from sinsjax.units import ARCMIN, DEG

from .runs import limits_of

_LEVEL = np.ix_((0, 1, 3), (0, 1, 3))  # of x, see `_matrix`
_AZIMUTH = np.ix_((0, 1, 2, 4), (0, 1, 2, 4))
_WITHOUT_INTEGRAL = np.ix_((0, 1, 2, 4, 5, 6), (0, 1, 2, 4, 5, 6))


class Loops(NamedTuple):
    """The compass loops of one run as linear systems.

    Attributes:
        params: gains and when they change, numbers.
        earth: gravity and radius, SI.
        rate_n: omega_N, rad/s.
        rate_hz: samples a second.
        tape_s: length of a pass, s.
    """

    params: compass.LoopParams
    earth: dict[str, float]
    rate_n: float
    rate_hz: float
    tape_s: float

    @property
    def sigma(self) -> float:
        """Decay rate of the azimuth loop, 1/s, by its K1 = 2 sigma."""
        return float(self.params.azimuth.k1) / 2

    @property
    def smoothing_s(self) -> float:
        """Delay of the low-passed specific force, two equal stages, s."""
        return float(-2 / (np.log1p(-self.params.smoothing) * self.rate_hz))


def loops_of(one: Study) -> Loops:
    """The loops of a compass study of one variant."""
    return all_loops(one)[0]


def all_loops(study: Study) -> list[Loops]:
    """The loops of each variant of a compass study that sweeps keys of loops and passes alone."""
    variants = Variants(study, np.arange(study.n_variants))
    site, ug = site_of(study, variants, None)
    params = compass_parameters.parameters(variants, site, ug)
    leaves, structure = jax.tree.flatten(params)
    tapes = study.values("tape_s") if study.passes else [None] * study.n_variants
    return [
        Loops(
            params=jax.tree.unflatten(structure, [np.asarray(leaf)[i] for leaf in leaves]),
            earth=compass_parameters.earth_numbers(site),
            rate_n=float(site.place.rate_n),
            rate_hz=study.rate_hz,
            tape_s=study.duration_s if tape_s is None else tape_s,
        )
        for i, tape_s in enumerate(tapes)
    ]


def start_of(study: Study) -> NDArray:
    """Initial phi_E and phi_U of a study that sweeps neither, from their limits, (2,), deg."""
    limits = limits_of(study)
    begin = [only(study, f"phi_{axis}0_deg") for axis in "eu"]
    return np.asarray(begin) - np.array([limits.e, limits.u]) * ARCMIN / DEG


def heading_from_limit(one: Study, times_s: NDArray) -> NDArray:
    """As `heading_of`, for a simulated compass study of one variant from its initial error."""
    return heading_of(loops_of(one), start_of(one), times_s)


def heading_of(model: Loops, start: NDArray, times_s: NDArray) -> NDArray:
    """Heading error minus its limit of some loops.

    Args:
        model: the loops.
        start: of `start_of`.
        times_s: (n,) update times, s, ascending.

    Returns:
        (n,) deg, estimate minus truth.
    """
    state = np.zeros(7)
    state[1:3] = DEG * start
    level_s = float(model.params.azimuth_from) / model.rate_hz
    last = float(times_s[-1])
    changes = model.params.pace.samples / model.rate_hz
    turns = np.arange(1, np.ceil(last / model.tape_s)) * model.tape_s
    moments = np.unique([0.0, level_s, *changes, *turns, last])
    heading = np.empty(len(times_s))
    for since, until in pairwise(moments[moments <= last].tolist()):
        if since in turns:
            state = _turn(model.params.turn) @ state
        matrix = _matrix(model, since, levelling=since < level_s)
        here = (times_s > since) & (times_s <= until)
        steps = (np.append(times_s[here], until) - since).round(9)
        states = _flows(matrix.tobytes(), steps.tobytes()) @ state
        heading[here], state = states[:-1, 2], states[-1]
    return -heading / DEG


@lru_cache(maxsize=1024)  # passes of one kind share theirs, and so do turn rules
def _flows(matrix: bytes, steps: bytes) -> NDArray:
    """exp(A t) for each of some times t, shape (n, 7, 7)."""
    whole = np.frombuffer(matrix).reshape(7, 7) * np.frombuffer(steps)[:, None, None]
    return scipy.linalg.expm(whole)


def cycle_radius(
    sigma: Number, tape_s: Number, turn: compass.Reversal, *, damping: Number, smoothing_s: Number
) -> NDArray:
    """As `compass.design.cycle_radius`, with the turn as it is made: by a specific force that lags.

    Args:
        sigma: decay rate, 1/s.
        tape_s: length of a pass, s.
        turn: what happens between two passes.
        damping: of the azimuth loop.
        smoothing_s: delay of the low-passed specific force, two equal stages, s.

    Returns:
        Of the shape that the numbers broadcast to.
    """
    sigma, tape_s, damping, smoothing_s = np.broadcast_arrays(sigma, tape_s, damping, smoothing_s)
    earth = {"gravity": 1.0, "radius": 1.0}
    gains = loops.azimuth_gains(sigma, damping, **earth)
    made = _turn(turn)[_WITHOUT_INTEGRAL]
    azimuth = loops.azimuth_matrix(gains, rate_n=1.0, direction=1, **earth)
    matrix = np.zeros((*azimuth.shape[:-2], 6, 6))
    matrix[..., :4, :4] = azimuth
    matrix[..., 4, 1] = matrix[..., 5, 4] = 2 / smoothing_s
    matrix[..., 4, 4] = matrix[..., 5, 5] = -2 / smoothing_s
    forward = scipy.linalg.expm(matrix * tape_s[..., None, None])
    mirror = np.diag([-1.0, -1.0, 1.0, 1.0, -1.0, -1.0])  # time reversed: velocity, tilt, force
    cycle = made @ mirror @ forward @ mirror @ made @ forward
    return np.asarray(np.abs(np.linalg.eigvals(cycle)).max(-1))


def _turn(turn: compass.Reversal) -> NDArray:
    """What a turn makes of x."""
    velocity, integral, rate, reflection = turn
    left = 1 - 2 * reflection
    matrix = np.diag([velocity, 1.0, 1.0, integral, rate, left, left])
    matrix[1, 6] = -2 * reflection
    return matrix


def _matrix(model: Loops, time_s: float, *, levelling: bool) -> NDArray:
    """A of x' = A x from a time on, for x = [dV_N, phi_E, phi_U, I_N, w_cU, f_1/g, f_2/g].

    x counts from its limit; f_1 and f_2 are the stages of the low-passed north specific force.
    """
    direction = -1 if round(time_s / model.tape_s, 9) // 1 % 2 else 1
    matrix = np.zeros((7, 7))
    matrix[5, [1, 5]] = matrix[6, [5, 6]] = np.array([2, -2]) / model.smoothing_s
    if levelling:
        matrix[_LEVEL] = loops.level_matrix(model.params.level, **model.earth)
        matrix[1, 2] = -direction * model.rate_n
        return matrix
    pace = model.params.pace
    passed = np.searchsorted(pace.samples / model.rate_hz, time_s, side="right")
    gains = loops.at_pace(model.params.azimuth, pace.values[passed])
    matrix[_AZIMUTH] = loops.azimuth_matrix(
        gains, rate_n=model.rate_n, direction=direction, **model.earth
    )
    return matrix

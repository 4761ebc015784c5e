"""What linear loops predict for a run of a compass study: the heading error over update time.

The north channel alone, from the stated initial error, without noise: levelling ([P2] Fig. 1) with
the heading that it does not control, then azimuth ([P2] Fig. 2), pass by pass.
"""

from itertools import pairwise
from typing import NamedTuple

import jax
import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from sinsjax import loops, tunings
from sinsjax.alignment import compass
from sinsjax.report.limits import ingredients, only
from sinsjax.studies import Study
from sinsjax.units import ARCMIN, DEG
from sinsjax.worlds import Variants, site_of

_LEVEL = np.ix_((0, 1, 3), (0, 1, 3))  # of x = [dV_N, phi_E, phi_U, I_N, w_cU]
_AZIMUTH = np.ix_((0, 1, 2, 4), (0, 1, 2, 4))


class Limits(NamedTuple):
    """What attitude errors settle to for constant biases, deg; an error is estimate minus truth.

    Attributes:
        pitch: nabla_N/g.
        roll: -nabla_E/g.
        heading: eps_E/omega_N - (nabla_E/g) tan L, positive counter-clockwise.
        gyro: the first term of the heading's.
        accel: its second term.
    """

    pitch: float
    roll: float
    heading: float
    gyro: float
    accel: float


class Loops(NamedTuple):
    """The compass loops of one run as linear systems.

    Attributes:
        params: gains and when they change, numbers.
        earth: gravity and radius, SI.
        rate_n: omega_N, rad/s.
        rate_hz: samples a second.
        tape_s: length of a pass, s.
    """

    params: compass.Params
    earth: dict[str, float]
    rate_n: float
    rate_hz: float
    tape_s: float

    @property
    def sigma(self) -> float:
        """Decay rate of the azimuth loop, 1/s, by its K1 = 2 sigma."""
        return float(self.params.azimuth.k1) / 2

    @property
    def turn(self) -> NDArray:
        """What a turn makes of [dV_N, phi_E, phi_U, w_cU], see `loops.turn_matrix`."""
        velocity, _, rate, reflection = self.params.turn
        return loops.turn_matrix(velocity, 1 - 2 * reflection, rate)


def one_variant(study: Study, variant: int) -> Study:
    """The study of one variant alone.

    Args:
        study: a simulated study.
        variant: its number.
    """
    point = {key: values[variant] for key, values in study.variant_values().items()}
    return study.model_copy(update={"axes": {}, "cases": (point,) if point else ()})


def limits_of(one: Study) -> Limits:
    """The limits of a study of one variant, see `limits.ingredients`.

    Raises:
        InputError: its Earth is not one of constants.
    """
    parts = ingredients(one)
    errors = (parts.phi_e, parts.phi_n, parts.gyro + parts.accel, parts.gyro, parts.accel)
    return Limits(*(-angle * ARCMIN / DEG for angle in errors))


def loops_of(one: Study) -> Loops:
    """The loops of a compass study of one variant."""
    variants = Variants(one, np.array([0]))
    site, ug = site_of(one, variants, None)
    params = tunings.of_method(one, variants, site, ug)
    tape_s = only(one, "tape_s") if one.passes else None
    return Loops(
        params=jax.tree.map(lambda leaf: np.asarray(leaf)[0], params),
        earth={
            "gravity": float(site.place.gravity),
            "radius": float(1 / site.place.curvature_n),
        },
        rate_n=float(site.place.rate_n),
        rate_hz=one.study.rate_hz,
        tape_s=one.study.duration_s if tape_s is None else tape_s,
    )


def heading_from_limit(one: Study, times_s: NDArray) -> NDArray:
    """Heading error minus its limit as the linear loops have it.

    Args:
        one: a simulated compass study of one variant.
        times_s: (n,) update times, s, ascending.

    Returns:
        (n,) deg, estimate minus truth.
    """
    model, limits = loops_of(one), limits_of(one)
    begin = [only(one, f"phi_{axis}0_deg") for axis in "eu"]
    state = np.zeros(5)
    state[1:3] = DEG * (np.asarray(begin) + [limits.pitch, limits.heading])
    level_s = float(model.params.azimuth_from) / model.rate_hz
    last = float(times_s[-1])
    changes = model.params.pace.samples / model.rate_hz
    turns = np.arange(1, np.ceil(last / model.tape_s)) * model.tape_s
    moments = np.unique([0.0, level_s, *changes, *turns, last])
    heading = np.empty(len(times_s))
    velocity, integral, rate, reflection = model.params.turn
    turn = np.array([velocity, 1 - 2 * reflection, 1.0, integral, rate])
    for since, until in pairwise(moments[moments <= last]):
        if since in turns:
            state = turn * state
        matrix = _matrix(model, since, levelling=since < level_s)
        here = (times_s > since) & (times_s <= until)
        steps = np.append(times_s[here], until) - since
        states = scipy.linalg.expm(matrix * steps[:, None, None]) @ state
        heading[here], state = states[:-1, 2], states[-1]
    return -heading / DEG


def _matrix(model: Loops, time_s: float, *, levelling: bool) -> NDArray:
    """A of x' = A x with x = [dV_N, phi_E, phi_U, I_N, w_cU] from their limits, from a time on."""
    direction = -1 if round(time_s / model.tape_s, 9) // 1 % 2 else 1
    matrix = np.zeros((5, 5))
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

"""Conventions that results seem to have, if another reading explains them much better.

The results are read again with the yaw mirrored or turned by quarter turns, in radians, and with
quaternions inverted or with their scalar last. Each reading is compared with the truth and with the
median of sinsjax's methods on the same draws, whose errors are mostly those of the same noise and
biases, so even the sign of a small error shows.
"""

from collections.abc import Iterator

import jax
import numpy as np
from numpy.typing import NDArray

from sinsjax.arena.frames import from_angles, from_quaternion, to_angles
from sinsjax.arena.results_file import GivenResults
from sinsjax.maths.rotations import misalignment
from sinsjax.types import Quat
from sinsjax.units import ARCMIN, DEG

_BETTER, _MUCH_BETTER = 0.25, 0.1
"""Largest share of the error that a suspected reading has; the second where it is still bad."""

_LEAST = 30 * ARCMIN
"""Error from the truth from which another reading is suspected, rad."""

_YAWS = {
    "is yaw mirrored (positive the other way round)": (-1, 0.0),
    **{f"is yaw off by {turn} deg": (1, turn) for turn in (90, -90, 180)},
    "is yaw mirrored and from east": (-1, 90.0),
}
"""Signs of yaw, and turns, deg."""

_QUATERNIONS = {
    "is the scalar of the quaternions last": ([3, 0, 1, 2], 1),
    "are the quaternions from navigation to body axes": ([0, 1, 2, 3], -1),
    "is the scalar of the quaternions, from navigation to body axes, last": ([3, 0, 1, 2], -1),
}
"""Orders of quaternions, and the sign of their vectors."""

_misalignments = jax.jit(jax.vmap(misalignment))


def suspect(given: GivenResults, q_true: Quat, usual: NDArray) -> str | None:
    """Return what the results seem to be, in one sentence; None if nothing is suspected.

    Args:
        given: last row of each run.
        q_true: true attitudes there.
        usual: (runs, 3) misalignment of sinsjax's methods there, rad; not used if one is NaN.
    """
    expected = [np.zeros_like(usual), *([usual] if np.isfinite(usual).all() else [])]
    found = []
    for words, attitude in _iter_readings(given):
        for phi, least in zip(expected, (_LEAST, 0.0), strict=False):
            error, now = (_distance(q_true, q, phi) for q in (given.attitude, attitude))
            good = max(DEG, 3 * _norm(phi))
            if error > least and now <= min(_BETTER * error, max(good, _MUCH_BETTER * error)):
                found.append((now / error, words, now / ARCMIN, error / ARCMIN))
    if not found:
        return None
    _, words, now, error = min(found)
    median = "the median distance from the expected attitude"
    return f"{words}? Read so, {median} is {now:.3g} arcmin instead of {error:.3g}"


def _distance(q_true: Quat, attitude: Quat, phi: NDArray) -> float:
    """Return the median distance of misalignments from those that are expected, rad."""
    return _norm(np.stack(_misalignments(q_true, attitude), axis=-1) - phi)


def _norm(phi: NDArray) -> float:
    return float(np.median(np.linalg.norm(phi, axis=-1)))


def _iter_readings(given: GivenResults) -> Iterator[tuple[str, Quat]]:
    """Yield other readings of results: what they suppose, in words, and attitudes."""
    if given.has_quaternions:
        for words, (order, sign) in _QUATERNIONS.items():
            values = given.values[:, order] * [1, sign, sign, sign]
            yield words, from_quaternion(values, given.frame)
    else:
        yield "are the angles in radians", from_angles(given.values / DEG, given.frame)
    for words, (sign, turn) in _YAWS.items():
        changed = to_angles(given.attitude, given.frame)
        changed[:, 2] = sign * (changed[:, 2] - turn * DEG)
        yield words, from_angles(changed, given.frame)

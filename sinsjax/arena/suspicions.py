"""Conventions that results seem to have, if another reading explains them much better.

The results are read again with the yaw mirrored or turned by quarter turns, in the other unit of
angles, with pitch and roll exchanged, and quaternions inverted or with their scalar last. Each
reading is compared with the truth and with the methods of sinsjax on the same draws: their errors
are mostly those of the same noise and biases, so that even the sign of a small error shows.
"""

from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from sinsjax.arena.frames import from_angles, from_quaternion, to_angles
from sinsjax.arena.results_file import GivenResults
from sinsjax.maths.rotations import misalignment
from sinsjax.types import Quat
from sinsjax.units import ARCMIN, DEG

_BETTER = 0.25
"""Share of the error, of the results as they are, that a suspected reading has at most."""
_MUCH_BETTER = 0.1
"""The same where that reading is still bad."""
_LEAST = 30 * ARCMIN
"""Error from the truth from which another reading is suspected, rad."""
_SIMPLER = 2.0
"""Ratio of errors up to which the reading with fewer changes is named."""


class Reading(NamedTuple):
    """Another reading of the results.

    Attributes:
        changes: what it supposes, in words; empty for the results as they are.
        attitude: leaves (runs,).
    """

    changes: tuple[str, ...]
    attitude: Quat


def suspect(given: GivenResults, q_true: Quat, references: NDArray) -> str | None:
    """Return what the results seem to be, in one sentence; None if nothing is suspected.

    Args:
        given: last row of each run.
        q_true: true attitudes there.
        references: (methods, runs, 3) misalignment of methods of sinsjax at the end of the same
            runs, rad; NaN for runs that failed.
    """
    as_given, *others = ((r, _misalignment(q_true, r.attitude)) for r in _readings(given))
    anchors: list[tuple[NDArray, float, float]] = [(np.zeros(3), _LEAST, DEG)]
    for reference in references:
        if np.isfinite(reference).all():
            anchors.append((reference, 0.0, max(DEG, 3 * _distance(reference, np.zeros(3)))))
    best: tuple[float, Reading, float, float] | None = None
    for anchor, least, good in anchors:
        error = _distance(as_given[1], anchor)
        for reading, phi in others:
            other = _distance(phi, anchor)
            if error <= least or other > min(_BETTER * error, max(good, _MUCH_BETTER * error)):
                continue
            weight = other / error * _SIMPLER ** (len(reading.changes) - 1)
            if best is None or weight < best[0]:
                best = weight, reading, error, other
    if best is None:
        return None
    _, reading, error, other = best
    return (
        f"{' and '.join(reading.changes)}? Read so, the median distance from the expected attitude"
        f" is {other / ARCMIN:.3g} arcmin instead of {error / ARCMIN:.3g}"
    )


_misalignments = jax.jit(jax.vmap(misalignment))


def _misalignment(q_true: Quat, attitude: Quat) -> NDArray:
    return np.stack([np.asarray(a) for a in _misalignments(q_true, attitude)], axis=-1)


def _distance(phi: NDArray, anchor: NDArray) -> float:
    return float(np.median(np.linalg.norm(phi - anchor, axis=-1)))


def _readings(given: GivenResults) -> Iterator[Reading]:
    """Yield the results as they are, then all other readings."""
    yield Reading((), given.attitude)
    if given.quaternions is not None:
        q, frame = given.quaternions, given.frame
        other = "ned" if frame == "enu" else "enu"
        inverse = q * np.array([1, -1, -1, -1])
        last = np.roll(q, 1, axis=-1)
        text = "are the quaternions from navigation to body axes"
        scalar = "is the scalar of the quaternions last"
        yield Reading((text,), from_quaternion(inverse, frame))
        yield Reading((scalar,), from_quaternion(last, frame))
        both = last * np.array([1, -1, -1, -1])
        yield Reading((scalar, text), from_quaternion(both, frame))
        yield Reading((f"are the quaternions in the frame {other}",), from_quaternion(q, other))
    angles = given.angles if given.angles is not None else to_angles(given.attitude, given.frame)
    units = {"": 1.0}
    if given.unit == "deg":
        units["are the angles in radians"] = 1 / DEG
    if given.unit == "rad":
        units["are the angles in degrees"] = DEG
    yaws = {
        "": (1, 0.0),
        "is yaw mirrored (positive the other way round)": (-1, 0.0),
        **{f"is yaw off by {turn} deg": (1, turn) for turn in (90, -90, 180)},
        "is yaw mirrored and from east": (-1, 90.0),
    }
    levels = {
        "": lambda pitch, roll: (pitch, roll),
        "are pitch and roll exchanged": lambda pitch, roll: (roll, pitch),
        "has pitch the opposite sign": lambda pitch, roll: (-pitch, roll),
        "has roll the opposite sign": lambda pitch, roll: (pitch, -roll),
        "have pitch and roll the opposite sign": lambda pitch, roll: (-pitch, -roll),
    }
    for (unit, factor), (yaw, (sign, turn)), (level, changed) in product(
        units.items(), yaws.items(), levels.items()
    ):
        changes = tuple(filter(None, (unit, yaw, level)))
        if not changes:
            continue
        pitch, roll, heading = np.moveaxis(angles * factor, -1, 0)
        pitch, roll = changed(pitch, roll)
        heading = sign * heading - turn * DEG * (1 if sign > 0 else -1)
        yield Reading(changes, from_angles(np.stack([pitch, roll, heading], -1), given.frame))

"""The two conventions in which programs read records and return attitudes.

| frame | navigation | body | yaw | C_b^n |
| --- | --- | --- | --- | --- |
| ``enu`` | east, north, up | right, front, up | counter-clockwise | Rz(yaw) Rx(pitch) Ry(roll) |
| ``ned`` | north, east, down | front, right, down | clockwise | Rz(yaw) Ry(pitch) Rx(roll) |

Pitch is positive with the front up, roll with the right side down, and both conventions turn about
up (or down), then right, then front: only the sign of yaw differs. Quaternions are body to
navigation, scalar first.
"""

import jax
import numpy as np
from numpy.typing import NDArray

from sinsjax.maths.rotations import from_euler, to_euler
from sinsjax.types import Quat

FRAMES = ("enu", "ned")

_to_euler = jax.jit(jax.vmap(to_euler))
_from_euler = jax.jit(jax.vmap(from_euler))


def to_body_axes(vectors: NDArray, frame: str) -> NDArray:
    """Return vectors in the body axes of a frame, (..., 3), from right, front, up."""
    right, front, up = np.moveaxis(vectors, -1, 0)
    return np.stack([front, right, -up] if frame == "ned" else [right, front, up], axis=-1)


def to_angles(attitude: Quat, frame: str) -> NDArray:
    """Return pitch, roll and yaw in a frame, rad, (runs, 3)."""
    pitch, roll, yaw = (np.asarray(angle) for angle in _to_euler(attitude))
    return np.stack([pitch, roll, -yaw if frame == "ned" else yaw], axis=-1)


def from_angles(angles: NDArray, frame: str) -> Quat:
    """Return attitudes, leaves (runs,), from pitch, roll and yaw in a frame, rad, (runs, 3)."""
    pitch, roll, yaw = np.moveaxis(angles, -1, 0)
    attitude = _from_euler(pitch, roll, -yaw if frame == "ned" else yaw)
    return Quat(*(np.asarray(part) for part in attitude))


def to_quaternion(attitude: Quat, frame: str) -> NDArray:
    """Return quaternions in a frame, (runs, 4)."""
    w, x, y, z = attitude
    return np.stack([w, y, x, -z] if frame == "ned" else [w, x, y, z], axis=-1)


def from_quaternion(quaternion: NDArray, frame: str) -> Quat:
    """Return attitudes, leaves (runs,), from quaternions in a frame, (runs, 4), of any length."""
    unit = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(unit, -1, 0)
    return Quat(w, y, x, -z) if frame == "ned" else Quat(w, x, y, z)

"""The values that flow between modules: vectors, attitudes, increments, navigation.

Everything here describes *one* run. Batching adds leading axes to the leaves; nothing here knows.
"""

from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import jax
import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Int, UInt32

if TYPE_CHECKING:
    # Shapes are checked when the tests run; a static checker cannot follow them.
    Array: TypeAlias = Any
    Scalar: TypeAlias = Any
    Flag: TypeAlias = Any
    Count: TypeAlias = Any
    Word: TypeAlias = Any
else:
    Array = jax.Array | np.ndarray
    Scalar = Float[ArrayLike, ""]
    Flag = Bool[ArrayLike, ""]
    Count = Int[ArrayLike, ""]
    Word = UInt32[ArrayLike, ""]


class Vec3(NamedTuple):
    """A 3-vector as three scalars, so that a batch of runs becomes contiguous arrays."""

    x: Scalar
    y: Scalar
    z: Scalar


class Quat(NamedTuple):
    """A unit quaternion, scalar first; ``q_nb`` takes body vectors to navigation vectors."""

    w: Scalar
    x: Scalar
    y: Scalar
    z: Scalar


class Increments(NamedTuple):
    """Increments measured over one sample: angle (rad) and velocity (m/s), in b."""

    dtheta: Vec3
    dv: Vec3


class Sample(NamedTuple):
    """One inertial sample, ready for the mechanisation.

    Attributes:
        turn: body rotation over the sample as a quaternion (coning included).
        dv: velocity increment in the body frame at the sample's start (rotation and sculling
            included), m/s.
    """

    turn: Quat
    dv: Vec3


class Navigation(NamedTuple):
    """The navigation solution of one run.

    Attributes:
        q: attitude quaternion, body to navigation frame (ENU).
        ve: east velocity, m/s.
        vn: north velocity, m/s.
        latitude: radians.
        longitude: radians.
    """

    q: Quat
    ve: Scalar
    vn: Scalar
    latitude: Scalar
    longitude: Scalar

"""Attitudes integrated from the gyros of a record: quaternion arrays (..., 4), scalar first."""

import math

import numpy as np

from sinsjax.records.layout import FloatArray


def integrate_attitudes(dtheta: FloatArray) -> FloatArray:
    """Return quaternions (n + 1, 4) from the body axes at each time to those at the start.

    Args:
        dtheta: (n, 3) rotation increments, rad; two-sample coning is compensated.
    """
    n = len(dtheta)
    previous = np.concatenate([dtheta[:1], dtheta[:-1]])
    vector = dtheta + np.cross(previous, dtheta) / 12
    angle = np.linalg.norm(vector, axis=1, keepdims=True)
    # sin(a/2)/a by NumPy's sin(pi x)/(pi x), which is defined at zero.
    steps = np.hstack([np.cos(angle / 2), vector * np.sinc(angle / 2 / np.pi) / 2])
    # Products within all blocks at once, then of blocks: two short loops instead of a long one.
    size = math.isqrt(n) + 1
    padded = np.tile([1.0, 0.0, 0.0, 0.0], (size * size, 1))
    padded[:n] = steps
    blocks = padded.reshape(size, size, 4)
    for k in range(1, size):
        blocks[:, k] = multiply(blocks[:, k - 1], blocks[:, k])
    starts = np.tile([1.0, 0.0, 0.0, 0.0], (size, 1))
    for k in range(1, size):
        starts[k] = multiply(starts[k - 1], blocks[k - 1, -1])
    q = multiply(starts[:, None], blocks).reshape(-1, 4)[:n]
    return np.concatenate([[[1.0, 0.0, 0.0, 0.0]], q])


def multiply(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the Hamilton products of quaternions (..., 4)."""
    aw, ax, ay, az = (a[..., k] for k in range(4))  # np.moveaxis takes as long as the products
    bw, bx, by, bz = (b[..., k] for k in range(4))
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def rotate_vectors(q: FloatArray, v: FloatArray) -> FloatArray:
    """Return vectors (n, 3) rotated by quaternions (n, 4)."""
    across = 2 * np.cross(q[:, 1:], v)
    return v + q[:, :1] * across + np.cross(q[:, 1:], across)

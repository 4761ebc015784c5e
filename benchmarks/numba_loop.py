"""The alignment step as one scalar Numba loop over the samples of one run.

It computes `sinsjax.bench.baseline.align_with_numpy_loop` without its detours: a quaternion,
only the non-zero entries of A dt, measurements one after the other. Arrays are of fixed size and
made once, before the loop. Written on its own because Numba compiles no other two: it is what a
good scalar program costs.
"""

import numpy as np
from numba import njit

from sinsjax.bench.baseline import AlignmentSettings

ENTRIES = np.array(
    [
        *[(0, 0), (0, 1), (0, 3), (0, 4), (1, 0), (1, 2), (1, 4), (2, 1)],
        *[(2, 3), (2, 4), (3, 0), (3, 2), (3, 4), (4, 0), (4, 2), (4, 3)],
    ]
)
"""Rows and columns of the non-zero entries of A dt, [P1] eq. (3)."""


def align(
    increments: np.ndarray, c: np.ndarray, setting: AlignmentSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Takes and returns what `sinsjax.bench.baseline.align_with_numpy_loop` does."""
    s = setting
    earth = (s.dt, s.rate_n, s.rate_u, s.tan_latitude, 1 / s.radius)
    resets = np.array(s.resets, dtype=np.int64)
    scalars = (earth, s.r, s.feedback_every)
    return _loop(np.ascontiguousarray(increments), c, scalars, s.p0, s.q, resets)


@njit
def _loop(increments, c, scalars, p0, q, resets):
    (dt, rate_n, rate_u, tan, curvature), r, every = scalars
    attitude = _quaternion(c)
    ve, vn, x = 0.0, 0.0, np.zeros(5)
    p, half, a = np.diag(p0), np.empty((5, 5)), np.empty(len(ENTRIES))
    before = _sample(increments, 0)
    for n in range(1, len(increments) + 1):
        now = _sample(increments, n - 1)
        turn, dv = _compensated(now, before)
        before = now
        east = ve * curvature
        w = (-vn * curvature, rate_n + east, rate_u + east * tan)
        f = _rotated(attitude, dv)
        back = _cross(w, f)
        f = (f[0] - dt / 2 * back[0], f[1] - dt / 2 * back[1], f[2] - dt / 2 * back[2])
        coriolis = 2 * rate_u + east * tan
        _transition(a, f, w, (ve, vn), (dt, rate_u, tan, curvature))
        minus = (-dt * w[0], -dt * w[1], -dt * w[2])
        attitude = _product(_product(_exp(minus), attitude), _exp(turn))
        ve, vn = ve + f[0] + coriolis * dt * vn, vn + f[1] - coriolis * dt * ve
        _predict(x, p, half, a, q)
        _update(x, p, 0, ve, r)
        _update(x, p, 1, vn, r)
        reset = False
        for sample in resets:
            reset = reset or n == sample
        if reset or n % every == 0:
            ve, vn = ve - x[0], vn - x[1]
            attitude = _product(_exp((x[2], x[3], x[4])), attitude)
            x[:] = 0.0
        if reset:
            p[:] = 0.0
            for i in range(5):
                p[i, i] = p0[i]
    return _matrix(_product(_exp((x[2], x[3], x[4])), attitude)), p


@njit
def _sample(increments, n):
    row = increments[n]
    return (row[0], row[1], row[2]), (row[3], row[4], row[5])


@njit
def _cross(a, b):
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@njit
def _compensated(now, before):
    (theta, dv), (theta0, dv0) = now, before
    coning, rotation = _cross(theta0, theta), _cross(theta, dv)
    twice, one, two = _cross(theta, rotation), _cross(theta0, dv), _cross(dv0, theta)
    turn = (theta[0] + coning[0] / 12, theta[1] + coning[1] / 12, theta[2] + coning[2] / 12)
    return turn, (
        dv[0] + rotation[0] / 2 + twice[0] / 6 + (one[0] + two[0]) / 12,
        dv[1] + rotation[1] / 2 + twice[1] / 6 + (one[1] + two[1]) / 12,
        dv[2] + rotation[2] / 2 + twice[2] / 6 + (one[2] + two[2]) / 12,
    )


@njit
def _product(a, b):
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@njit
def _exp(v):
    angle = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    gain = 0.5 if angle < 1e-12 else np.sin(angle / 2) / angle
    return np.cos(angle / 2), gain * v[0], gain * v[1], gain * v[2]


@njit
def _rotated(q, v):
    t = _cross((q[1], q[2], q[3]), v)
    t = (2 * t[0], 2 * t[1], 2 * t[2])
    u = _cross((q[1], q[2], q[3]), t)
    return v[0] + q[0] * t[0] + u[0], v[1] + q[0] * t[1] + u[1], v[2] + q[0] * t[2] + u[2]


@njit
def _transition(a, f, w, velocity, place):
    (ve, vn), (dt, rate_u, tan, curvature) = velocity, place
    step, north = curvature * dt, vn * curvature * dt
    coriolis = (2 * rate_u + ve * tan * curvature) * dt
    a[0], a[1], a[2], a[3] = north * tan, coriolis, -f[2], f[1]
    a[4], a[5], a[6], a[7] = -2 * (rate_u + ve * tan * curvature) * dt, f[2], -f[0], -step
    a[8], a[9], a[10], a[11] = w[2] * dt, -w[1] * dt, step, -w[2] * dt
    a[12], a[13], a[14], a[15] = -north, tan * step, w[1] * dt, north


@njit
def _predict(x, p, half, a, q):
    new = (x[0], x[1], x[2], x[3], x[4])
    half[:] = p
    for e in range(len(ENTRIES)):
        i, j = ENTRIES[e]
        x[i] += a[e] * new[j]
        for k in range(5):
            half[i, k] += a[e] * p[j, k]
    p[:] = half
    for e in range(len(ENTRIES)):
        i, j = ENTRIES[e]
        for k in range(5):
            p[k, i] += a[e] * half[k, j]
    for i in range(5):
        p[i, i] += q[i]


@njit
def _update(x, p, m, z, r):
    column = (p[0, m], p[1, m], p[2, m], p[3, m], p[4, m])
    inverse = 1 / (column[m] + r)
    innovation = (z - x[m]) * inverse
    for i in range(5):
        x[i] += column[i] * innovation
        for j in range(5):
            p[i, j] -= column[i] * column[j] * inverse


@njit
def _quaternion(c):
    """The largest component first, so that nothing is divided by a small one."""
    squares = np.array(
        [
            1 + c[0, 0] + c[1, 1] + c[2, 2],
            1 + c[0, 0] - c[1, 1] - c[2, 2],
            1 - c[0, 0] + c[1, 1] - c[2, 2],
            1 - c[0, 0] - c[1, 1] + c[2, 2],
        ]
    )
    across = (c[2, 1] - c[1, 2], c[0, 2] - c[2, 0], c[1, 0] - c[0, 1])
    along = (c[0, 1] + c[1, 0], c[0, 2] + c[2, 0], c[1, 2] + c[2, 1])
    most = np.argmax(squares)
    s = np.sqrt(squares[most])
    if most == 0:
        return s / 2, across[0] / (2 * s), across[1] / (2 * s), across[2] / (2 * s)
    if most == 1:
        return across[0] / (2 * s), s / 2, along[0] / (2 * s), along[1] / (2 * s)
    if most == 2:
        return across[1] / (2 * s), along[0] / (2 * s), s / 2, along[2] / (2 * s)
    return across[2] / (2 * s), along[1] / (2 * s), along[2] / (2 * s), s / 2


@njit
def _matrix(q):
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )

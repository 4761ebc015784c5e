"""A body on the rotating Earth, navigated from increments with NumPy alone.

Attitude is composed in inertial space, where the rotations of samples simply multiply; the velocity
is integrated along all three axes of n. Nothing here comes from the mechanisation, the motion or
the housing that it is compared with. Vectors are (3, n) and quaternions (4, n), scalar first.
"""

import numpy as np

from oracles.naive import compensate


def cross(a, b):
    (ax, ay, az), (bx, by, bz) = a, b
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def multiply(a, b):
    """Hamilton products."""
    (s, x, y, z), (t, u, v, w) = a, b
    return np.stack(
        [
            s * t - x * u - y * v - z * w,
            s * u + x * t + y * w - z * v,
            s * v - x * w + y * t + z * u,
            s * w + x * v - y * u + z * t,
        ]
    )


def conjugate(q):
    return np.stack([q[0], *-q[1:]])


def of_vector(phi):
    """Quaternions of rotation vectors."""
    half = np.linalg.norm(phi, axis=0) / 2
    return np.stack([np.cos(half), *(phi * (np.sinc(half / np.pi) / 2))])


def rotate(q, v):
    u = q[1:]
    return v + 2 * cross(u, cross(u, v) + q[0] * v)


def angle_between(a, b):
    """Angles between attitudes, rad."""
    off = multiply(a, conjugate(b))
    return 2 * np.arctan2(np.linalg.norm(off[1:], axis=0), np.abs(off[0]))


def products(q):
    """Products q_0 q_1 ... q_k for every k."""
    q, step = q.copy(), 1
    while step < q.shape[1]:
        q[:, step:] = multiply(q[:, :-step], q[:, step:])
        step *= 2
    return q


def navigate(rows, q0, velocity, place, dt):
    """Attitude (4, n) and velocity (3, n) in n after each sample, from the truth at the start.

    Increments (n, 6) are compensated by the documented two-sample rule, with nothing before the
    first. ``velocity`` (3, n + 1) starts with the true one; the others are a first guess of what
    moves n over the Earth, corrected until it no longer changes. ``place`` has the rates of the
    Earth, gravity and the curvatures.
    """
    turns, pushes = (a[1:].T for a in compensate(np.concatenate([0 * rows[:1], rows])))
    n, earth = len(rows), np.array([[0.0], [place.rate_n], [place.rate_u]])
    in_inertial = multiply(np.asarray(q0)[:, None], products(of_vector(turns)))
    with_earth = of_vector(earth * dt * np.arange(1, n + 1))
    gravity = np.array([[0.0], [0.0], [-place.gravity * dt]])
    v, change = np.array(velocity), np.inf
    while change > 1e-9:
        mean = (v[:, 1:] + v[:, :-1]) / 2
        east, north = mean[0] * place.curvature_e, mean[1] * place.curvature_n
        over = np.stack([-north, east, east * place.tan_latitude])
        # From n to the start: the Earth's rotation, and before it that over the Earth, of 1e-5 rad.
        travelled = of_vector(np.cumsum(rotate(with_earth, over * dt), axis=1))
        q = multiply(conjugate(multiply(travelled, with_earth)), in_inertial)
        force = rotate(np.concatenate([np.asarray(q0)[:, None], q[:, :-1]], axis=1), pushes)
        # Axes at the middle of the sample: half the rotation of n.
        force = force - cross((earth + over) * (dt / 2), force)
        coriolis = cross(2 * earth + over, mean) * dt
        found = v[:, :1] + np.cumsum(force - coriolis + gravity, axis=1)
        change = np.abs(found - v[:, 1:]).max()
        v[:, 1:] = found
    return q, v[:, 1:]

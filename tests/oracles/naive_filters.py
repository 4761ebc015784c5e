"""Filters of other error models than [P1]'s, naively: the loop of `naive.closed_loop` for any."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from oracles.naive import Filter, exp, mechanise, update, updates


class Model(NamedTuple):
    """An error model: of x, the first two errors of velocity.

    Attributes:
        signs: of the states under time reversal.
        heading: numbers of the states that a reset of yaw touches.
        start: x before the first sample.
        predict: (x, p, f, earth, latitude, dt) -> x, p after a sample, without Q.
        feed: (share of x, c, v) -> c, v corrected.
        kept: numbers of the states that are not fed back.
        corrected: (x, c) -> attitude with all that is estimated taken out.
    """

    signs: np.ndarray
    heading: tuple[int, ...]
    start: np.ndarray
    predict: Callable
    feed: Callable
    kept: tuple[int, ...]
    corrected: Callable


class History(NamedTuple):
    """After every sample: attitude, velocity, estimate, covariance, corrected attitude."""

    c: np.ndarray
    v: np.ndarray
    x: np.ndarray
    p: np.ndarray
    corrected: np.ndarray


def closed_loop(
    model: Model, increments, dt, planet, *, latitude, c, v, filt: Filter, tape=None, count=None
) -> History:
    """Mechanise, predict, update, feed back and reset, sample after sample, over a tape."""
    n = len(filt.p0)
    x, p, h = model.start, np.diag(filt.p0), np.eye(n)[:2]
    flip, history = np.diag(model.signs), []
    for k, turn, dv, way, turns in updates(increments, tape, count):
        if turns:
            v, x, p = -v, flip @ x, flip @ p @ flip.T
        earth = planet._replace(rate=way * planet.rate)
        c, v, f = mechanise(c, v, turn, dv, earth, latitude, dt)
        x, p = model.predict(x, p, f, earth, latitude, dt)
        x, p = update(x, p + np.diag(filt.q), h, v, filt.r)
        due = k in filt.resets
        share = 1.0 if due else filt.gain if k % filt.every == 0 else 0.0
        fed = share * x
        fed[list(model.kept)] = 0.0
        if share:
            c, v = model.feed(fed, c, v)
            x = x - fed
        if due:
            p = _reset(p, filt, model.heading)
        history.append((c, v, x, p, model.corrected(x, c)))
    return History(*(np.array(column) for column in zip(*history, strict=True)))


def _reset(p, filt, heading):
    p0 = np.diag(filt.p0)
    if filt.kind == "full":
        return p0
    if filt.kind == "scale":
        return filt.factor * p
    out = p.copy()
    for i in heading:
        out[i, :] = out[:, i] = 0.0
    for i in heading:
        out[i, i] = p0[i, i]
    return out


def linear(a, x, p, dt):
    """X and p after dt of x' = A x."""
    phi = np.eye(len(x)) + a * dt
    return phi @ x, phi @ p @ phi.T


def upright(tilt):
    """The shortest rotation that takes u = (-t_N, t_E, u_z) to z, by Rodrigues' formula."""
    u = np.array([-tilt[1], tilt[0], np.sqrt(1 - tilt @ tilt)])
    axis = np.cross(u, [0.0, 0.0, 1.0])
    size = np.linalg.norm(axis)
    return np.eye(3) if size == 0 else exp(axis / size * np.arctan2(size, u[2]))


def about_up(angle):
    """Rotation matrix about the vertical."""
    return exp([0.0, 0.0, angle])


def sincos_matrix(planet, latitude):
    """A of dVE dVN tE tN s k, dense."""
    _, wn, wu = planet.rates(latitude, (0.0, 0.0))[0]
    c, g = 1 / planet.radii(latitude)[1], planet.g(latitude)
    return np.array(
        [
            [0, 2 * wu, 0, -g, 0, 0],
            [-2 * wu, 0, g, 0, 0, 0],
            [0, -c, 0, wu, -wn, 0],
            [c, 0, -wu, 0, 0, wn],
            [0] * 6,
            [0] * 6,
        ]
    )


def _sincos_corrected(x, c):
    levelled = upright(x[2:4]) @ c
    s, cosine = x[4], 1 - x[5]
    return levelled if np.hypot(s, cosine) < 0.05 else about_up(np.arctan2(s, cosine)) @ levelled


SINCOS = Model(
    np.array([-1.0, -1.0, 1.0, 1.0, 1.0, 1.0]),
    (4, 5),
    np.array([0.0] * 5 + [1.0]),
    lambda x, p, f, earth, latitude, dt: linear(sincos_matrix(earth, latitude), x, p, dt),
    lambda fed, c, v: (upright(fed[2:4]) @ c, v - fed[:2]),
    (4, 5),
    _sincos_corrected,
)

"""Filters of other error models than [P1]'s, naively: the loop of `naive.closed_loop` for any."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from oracles.naive import (
    Clock,
    Filter,
    error_matrix,
    exp,
    mechanise,
    reset,
    update,
    updates,
    wound_back,
)


class Model(NamedTuple):
    """An error model: of x, the first two errors of velocity.

    Attributes:
        signs: of the states under time reversal.
        heading: numbers of the states that a reset of yaw touches.
        start: x before the first sample.
        predict: (x, p, earth, latitude, dt) -> x, p after a sample, without Q.
        feed: (share of x, c, v) -> c, v corrected; v with the vertical velocity.
        kept: numbers of the states that are not fed back.
        corrected: (x, c) -> attitude with all that is estimated taken out.
        rewound: x -> x that begins the record again.
        measured: (2, n) what of x is the level velocity of the solution; None: the first two.
    """

    signs: np.ndarray
    heading: tuple[int, ...]
    start: np.ndarray
    predict: Callable
    feed: Callable
    kept: tuple[int, ...]
    corrected: Callable
    rewound: Callable = np.zeros_like
    measured: np.ndarray | None = None


class History(NamedTuple):
    """After every sample: attitude, velocity, estimate, covariance, corrected attitude."""

    c: np.ndarray
    v: np.ndarray
    x: np.ndarray
    p: np.ndarray
    corrected: np.ndarray


def closed_loop(
    model: Model, increments, dt, planet, *, latitude, c, v, filt: Filter, stored=None, count=None
) -> History:
    """Mechanise, predict, update, feed back and reset, sample after sample, over a record."""
    n = len(filt.p0)
    x, p, v = model.start, np.diag(filt.p0), np.array([*v, 0.0])
    h = np.eye(n)[:2] if model.measured is None else model.measured
    flip, history, rewind = np.diag(model.signs), [], filt.turn == "rewind"
    clock = Clock(filt)
    for k, turn, dv, way, turns in updates(increments, stored, count, rewind=rewind):
        if turns and rewind:
            c = wound_back(model.corrected(x, c), increments[:stored], dt, planet, latitude)
            v, x, p = np.zeros(3), model.rewound(x), np.diag(filt.p0)
        elif turns:
            v, x, p = -v, flip @ x, flip @ p @ flip.T
        earth = planet._replace(rate=way * planet.rate)
        w_ie, w_en = earth.rates(latitude, v[:2])
        upward = np.cross(2 * w_ie + w_en, [*v[:2], 0.0])[2]
        c, level, f = mechanise(c, v[:2], turn, dv, earth, latitude, dt)
        v = np.array([*level, v[2] + dt * (f[2] - planet.g(latitude) - upward)])
        x, p = model.predict(x, p, earth, latitude, dt)
        x, p = update(x, p + np.diag(filt.q), h, v[:2], filt.r)
        feedback, due = clock.look(k)
        share = 1.0 if due else filt.gain if feedback else 0.0
        fed = share * x
        fed[list(model.kept)] = 0.0
        if share:
            c, v = model.feed(fed, c, v)
            x = x - fed
        if due:
            p = reset(p, filt, model.heading)
        history.append((c, v, x, p, model.corrected(x, c)))
    return History(*(np.array(column) for column in zip(*history, strict=True)))


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


def _sincos_rewound(x):
    amplitude = np.hypot(x[4], 1 - x[5])
    return np.array([0.0] * 5 + [1.0 if amplitude < 0.05 else 1 - amplitude])


SINCOS = Model(
    np.array([-1.0, -1.0, 1.0, 1.0, 1.0, 1.0]),
    (4, 5),
    np.array([0.0] * 5 + [1.0]),
    lambda x, p, earth, latitude, dt: linear(sincos_matrix(earth, latitude), x, p, dt),
    lambda fed, c, v: (upright(fed[2:4]) @ c, v - np.array([*fed[:2], 0.0])),
    (4, 5),
    _sincos_corrected,
    _sincos_rewound,
)


def surging(time):
    """`SINCOS` with place and velocity of a surge, east and north, of this correlation time."""
    one, two, none = np.eye(2), np.zeros((2, 2)), np.zeros((2, 6))
    own = np.block([[two, one], [-one / time**2, -one / time]])

    def predict(x, p, earth, latitude, dt):
        a = np.zeros((10, 10))
        a[:6, :6], a[6:, 6:] = sincos_matrix(earth, latitude), own
        return linear(a, x, p, dt)

    return Model(
        np.array([*SINCOS.signs, 1.0, 1.0, -1.0, -1.0]),
        SINCOS.heading,
        np.array([*SINCOS.start, *[0.0] * 4]),
        predict,
        SINCOS.feed,
        (4, 5, 6, 7, 8, 9),
        SINCOS.corrected,
        lambda x: np.array([*SINCOS.rewound(x), *[0.0] * 4]),
        np.hstack([one, none, one]),
    )


def azimuth_rates(x, planet, latitude):
    """X' of dVE dVN tE tN a, nonlinear in a."""
    _, wn, wu = planet.rates(latitude, (0.0, 0.0))[0]
    c, g, t = 1 / planet.radii(latitude)[1], planet.g(latitude), np.tan(latitude)
    ve, vn, e, n, a = x
    return np.array(
        [
            2 * wu * vn - g * n,
            -2 * wu * ve + g * e,
            -c * vn + wu * n - wn * np.sin(a),
            c * ve - wu * e + wn * (1 - np.cos(a)),
            wn * (e * (1 + np.cos(a)) - n * np.sin(a)) / 2 + c * t * ve,
        ]
    )


def _slope(function, x):
    """Its derivative by complex steps."""
    steps = 1e-30j * np.eye(len(x))
    return np.array([function(x + step).imag / 1e-30 for step in steps]).T


def _extended(x, p, earth, latitude, dt):
    def after(x):
        return x + dt * azimuth_rates(x, earth, latitude)

    slope = _slope(after, x)
    return after(x), slope @ p @ slope.T


def unscented_transform(after, x, p, alpha, beta=2.0):
    """Mean and covariance by the textbook's weights, kappa = 0."""
    n = len(x)
    scaled = alpha**2 * n - n
    root = np.linalg.cholesky((n + scaled) * p)
    points = np.array([x, *(x + column for column in root.T), *(x - column for column in root.T)])
    means = np.full(2 * n + 1, 1 / (2 * (n + scaled)))
    means[0] = scaled / (n + scaled)
    spreads = means.copy()
    spreads[0] += 1 - alpha**2 + beta
    moved = np.array([after(point) for point in points])
    mean = means @ moved
    return mean, (spreads * (moved - mean).T) @ (moved - mean)


def _sigma_points(x, p, earth, latitude, dt):
    def after(x):
        return x + dt * azimuth_rates(x, earth, latitude)

    return unscented_transform(after, x, p, 0.5)


def _turned(x):
    return about_up(x[4]) @ upright(x[2:4])


EXTENDED, UNSCENTED = (
    Model(
        np.array([-1.0, -1.0, 1.0, 1.0, 1.0]),
        (4,),
        np.zeros(5),
        predict,
        lambda fed, c, v: (_turned(fed) @ c, v - np.array([*fed[:2], 0.0])),
        (),
        lambda x, c: _turned(x) @ c,
    )
    for predict in (_extended, _sigma_points)
)


def jacobian(phi):
    """The left Jacobian of the rotations: the mean of exp(s phi) over s from 0 to 1."""
    nodes, weights = np.polynomial.legendre.leggauss(20)
    return sum(0.5 * w * exp(0.5 * (1 + s) * phi) for s, w in zip(nodes, weights, strict=True))


def _by_the_group(fed, c, v):
    turn = exp(fed[2:5])
    v = turn @ v - jacobian(fed[2:5]) @ np.array([*fed[:2], 0.0])
    return turn @ c, np.array([*v[:2], 0.0])


def _at_rest(x, p, earth, latitude, dt):
    force = np.array([0.0, 0.0, earth.g(latitude)])
    return linear(error_matrix((0.0, 0.0), force, earth, latitude), x, p, dt)


INVARIANT = Model(
    np.array([-1.0, -1.0, 1.0, 1.0, 1.0]),
    (4,),
    np.zeros(5),
    _at_rest,
    _by_the_group,
    (),
    lambda x, c: exp(x[2:5]) @ c,
)

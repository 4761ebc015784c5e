"""Error models of filters other than [P1]'s, naively; `naive.closed_loop` runs them."""

import numpy as np

from oracles.naive import FIVE, Model, error_matrix, exp, linear


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
    lambda x, p, at: linear(sincos_matrix(at.earth, at.latitude), x, p, at.dt),
    lambda fed, c, v: (upright(fed[2:4]) @ c, v - np.array([*fed[:2], 0.0])),
    (4, 5),
    _sincos_corrected,
)


def surging(time):
    """`SINCOS` with place and velocity of a surge, east and north, of this correlation time."""
    one, two, none = np.eye(2), np.zeros((2, 2)), np.zeros((2, 6))
    own = np.block([[two, one], [-one / time**2, -one / time]])

    def predict(x, p, at):
        a = np.zeros((10, 10))
        a[:6, :6], a[6:, 6:] = sincos_matrix(at.earth, at.latitude), own
        return linear(a, x, p, at.dt)

    return Model(
        np.array([*SINCOS.signs, 1.0, 1.0, -1.0, -1.0]),
        SINCOS.heading,
        np.array([*SINCOS.start, *[0.0] * 4]),
        predict,
        SINCOS.feed,
        (4, 5, 6, 7, 8, 9),
        SINCOS.corrected,
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


def _extended(x, p, at):
    def after(x):
        return x + at.dt * azimuth_rates(x, at.earth, at.latitude)

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


def _sigma_points(x, p, at):
    def after(x):
        return x + at.dt * azimuth_rates(x, at.earth, at.latitude)

    return unscented_transform(after, x, p, 0.5)


def _turned(x):
    return about_up(x[4]) @ upright(x[2:4])


EXTENDED, UNSCENTED = (
    FIVE._replace(
        predict=predict,
        feed=lambda fed, c, v: (_turned(fed) @ c, v - np.array([*fed[:2], 0.0])),
        corrected=lambda x, c: _turned(x) @ c,
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


def _at_rest(x, p, at):
    force = np.array([0.0, 0.0, at.earth.g(at.latitude)])
    return linear(error_matrix((0.0, 0.0), force, at.earth, at.latitude), x, p, at.dt)


INVARIANT = FIVE._replace(predict=_at_rest, feed=_by_the_group)

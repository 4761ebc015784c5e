"""The triggers once more, naively: a list of all that was seen, and sums over its ends.

Written from what the triggers are said to do. Vectors and matrices are arrays, times in samples.
"""

from typing import NamedTuple

import numpy as np

from oracles.naive import Unwatched, error_matrix, error_matrix_10


class Numbers(NamedTuple):
    """Numbers of a trigger, those of the study."""

    threshold: float
    window: int = 1
    refractory: int = 0
    most: int = 10**9
    until: float = np.inf


class Seen(NamedTuple):
    """One sample: innovation r of covariance s, and correction since the last reset.

    phi is what of that is not yet fed back, ``p`` its believed covariance, ``honest`` that of a
    base at rest.
    """

    r: np.ndarray
    s: np.ndarray
    correction: np.ndarray
    phi: np.ndarray
    p: np.ndarray
    honest: np.ndarray


def normalised(r, s):
    """R' S^-1 r."""
    return r @ np.linalg.solve(s, r)


def innovation(seen, window, dt):
    """(sum r)' (sum S)^-1 (sum r)."""
    recent = seen[-window:]
    return normalised(sum(one.r for one in recent), sum(one.s for one in recent))


def linearisation(seen, window, dt):
    """Root of 1 and three shares of variance: known already, soon to be known, and left out."""
    now = seen[-1]
    e, n, u = np.diag(now.honest)
    weights = [
        min(1.0, (np.hypot(*level[:2]) / np.radians(0.1)) ** 2)
        for level in (now.correction, now.phi)
    ]
    already = u / now.p[2, 2] - 1
    soon = u * ((now.phi[0] / 2) ** 2 / e + (now.phi[1] / 2) ** 2 / n)
    left_out = now.correction[2] - np.sin(now.correction[2])
    left_out = left_out**2 / (now.p[2, 2] + np.radians(4) ** 2)
    return np.sqrt(1 + weights[0] * already + weights[1] * soon + left_out)


SCORES = {f.__name__: f for f in (innovation, linearisation)}


class Watcher(Unwatched):
    """A trigger that watches a filter with process noise q and measurement noise r."""

    def __init__(self, name, numbers, *, q, r, p0, dt):
        """Begin with the covariance of the start."""
        self.name, self.numbers, self.dt = name, numbers, dt
        self.q, self.r = np.diag(q), r * np.eye(2)
        self.trigger_counts, self.scores = [], []
        self.begin(0, p0 if np.ndim(p0) == 2 else np.diag(p0))

    def begin(self, k, p):
        """Forget all, after a reset of any kind that leaves P."""
        self.reset_at, self.honest, self.fed, self.seen = k, p, np.zeros(3), []

    def turn(self, x, p):
        """Forget all but when it was reset: what was estimated before is no correction of now."""
        self.begin(self.reset_at, p)
        self.fed = -x[2:5]

    def look(self, seen, x, p):
        """Whether P is to be reset."""
        level = np.array([0.0, 0.0, seen.earth.g(seen.latitude)])
        a = error_matrix(np.zeros(2), level, seen.earth, seen.latitude)
        if len(x) == 10:
            a = error_matrix_10(np.zeros(2), level, seen.earth, seen.latitude, seen.c)
        k, phi, h = seen.k, np.eye(len(x)) + a * self.dt, np.eye(len(x))[:2]
        predicted = phi @ self.honest @ phi.T + self.q
        gain = predicted @ h.T @ np.linalg.inv(h @ predicted @ h.T + self.r)
        self.honest = predicted - gain @ h @ predicted
        known = p[2:5, 2:5], self.honest[2:5, 2:5]
        self.seen.append(Seen(seen.r, seen.s, self.fed + x[2:5], x[2:5], *known))
        window = self.numbers.window
        full = self.name == "linearisation" or len(self.seen) % window == 0
        score = SCORES[self.name](self.seen, window, self.dt) if full else 0.0
        self.scores.append(score)
        fires = (
            score > self.numbers.threshold
            and k - self.reset_at >= self.numbers.refractory
            and len(self.trigger_counts) < self.numbers.most
            and k <= self.numbers.until
        )
        if fires:
            self.trigger_counts.append(k)
        return fires

    def feed(self, phi):
        """Take an attitude correction in that was fed back."""
        self.fed = self.fed + phi

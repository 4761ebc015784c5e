"""The naive module's descriptions in the engine's words."""

import jax
import jax.numpy as jnp
import numpy as np
from naive import DEG, WGS84, Filter, Planet, Swing, quaternion

from sinsjax import earth, trajectory
from sinsjax.alignment import zero_velocity
from sinsjax.alignment.base import Site
from sinsjax.alignment.schedules import Feedback, Renewal, Resets
from sinsjax.types import Navigation, Quat

ARCMIN = DEG / 60
DEG_PER_H = DEG / 3600
UG = 9.8e-6

PAPER1 = Swing(
    np.zeros(3), np.array([1.8, 2.4, 2.8]) * DEG, np.array([6.0, 8.0, 10.0]), np.zeros(3)
)
"""Base motion of [P1]."""

PAPER2 = Swing(
    np.zeros(3), np.array([8.0, 6.0, 5.0]) * DEG, 1 / np.array([0.15, 0.2, 0.125]), np.zeros(3)
)
"""Base motion of [P2]."""

RESETS = 4
"""Places in a reset schedule; a schedule of fewer is filled with never."""

_KINDS = {"full": (0.0, 0.0, 1.0, 1.0), "yaw": (1.0, 0.0, 0.0, 1.0)}


def motion(swing: Swing) -> trajectory.Motion:
    angles = zip(*swing, strict=True)
    return trajectory.Motion(*(trajectory.Sway(*map(np.float64, angle)) for angle in angles))


def model(planet: Planet) -> earth.Earth:
    if planet is WGS84:
        return earth.wgs84()
    return earth.sphere(planet.rate, planet.a, planet.gravity)


def place(planet: Planet, latitude: float) -> earth.Place:
    return jax.tree.map(np.float64, earth.place(model(planet), latitude))


def site(planet: Planet, latitude: float) -> Site:
    return jax.tree.map(np.float64, Site(model(planet), place(planet, latitude), latitude))


def paper_filter(n: int, **changes) -> Filter:
    """[P1]'s filter of n = 5 or 10 states, Q per step."""
    p0 = np.array([0.1, 0.1, 15 * DEG, 15 * DEG, 80 * DEG] + [500 * UG] * 2 + [0.1 * DEG_PER_H] * 3)
    q = np.array([500 * UG] * 2 + [0.1 * DEG_PER_H] * 3 + [0.0] * 5)
    return Filter(p0[:n] ** 2, q[:n] ** 2, 0.1**2)._replace(**changes)


def params(filt: Filter) -> zero_velocity.Params:
    scale = (filt.factor, filt.factor, 0.0, 0.0)
    when = [*filt.resets] + [np.inf] * (RESETS - len(filt.resets))
    return zero_velocity.Params(
        p0=tuple(filt.p0),
        q=tuple(filt.q),
        r=np.float64(filt.r),
        feedback=Feedback(np.float64(filt.every), np.float64(filt.gain)),
        resets=Resets(
            np.array(when, dtype=float), Renewal(*map(np.float64, _KINDS.get(filt.kind, scale)))
        ),
        turn=Renewal(*map(np.float64, (1, 1, 0, 0))),
    )


def navigation(c: np.ndarray, v: np.ndarray, latitude: float) -> Navigation:
    numbers = (jnp.asarray(float(x)) for x in (*v, latitude, 0.0))
    return Navigation(Quat(*map(jnp.asarray, quaternion(c))), *numbers)


def swing_increments(swing: Swing, planet: Planet, latitude: float, *, rate, samples, **errors):
    """Ideal increments, or with constant biases and noise: (bias, noise) of gyro and accel."""
    here = place(planet, latitude)
    rows = np.array(_increments(motion(swing), here, float(rate), samples))
    rng = np.random.default_rng(0)
    for columns, name in ((slice(3), "gyro"), (slice(3, 6), "accel")):
        bias, noise = errors.get(name, (0.0, 0.0))
        rows[:, columns] += (np.asarray(bias) + noise * rng.normal(size=(samples, 3))) / rate
    return rows


_increments = jax.jit(trajectory.increments, static_argnums=3)

"""The naive module's descriptions as inputs of the engine."""

from collections.abc import Sequence
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from support.alone import set_up_alone

from oracles.naive import DEG, WGS84, Filter, Loops, Planet, Swing, quaternion
from sinsjax.engine.inputs import Draw, Environment, ProgramSpec, RunParams
from sinsjax.engine.metrics import Criteria
from sinsjax.engine.run import Intervals, TileState, advance_interval
from sinsjax.maths.algebra import Minus, triangle_index
from sinsjax.methods import compass
from sinsjax.methods.compass import AzimuthGains, LevelGains
from sinsjax.methods.filters.keys import acting_reset_times
from sinsjax.methods.filters.loop import FilterParams
from sinsjax.methods.floors import NO_BIASES
from sinsjax.methods.method import Options, Site
from sinsjax.methods.registry import METHODS
from sinsjax.methods.schedules import CovarianceReset, FeedbackSchedule, PiecewiseConstant, Resets
from sinsjax.strapdown import base_motion, earth, sensors
from sinsjax.types import Navigation, Quat, Vec3

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


def motion(swing: Swing) -> base_motion.Motion:
    angles = zip(*swing, strict=True)
    return base_motion.Motion(*(base_motion.Sway(*map(np.float64, angle)) for angle in angles))


def model(planet: Planet) -> earth.Earth:
    if planet is WGS84:
        return earth.wgs84()
    return earth.sphere(planet.rate, planet.a, planet.gravity)


def place(planet: Planet, latitude: float) -> earth.Place:
    return jax.tree.map(np.float64, earth.place(model(planet), latitude))


def site(planet: Planet, latitude: float) -> Site:
    return jax.tree.map(np.float64, Site(model(planet), place(planet, latitude), latitude))


_PAPER_P0 = np.array(
    [0.1, 0.1, 15 * DEG, 15 * DEG, 80 * DEG, *[500 * UG] * 2, *[0.1 * DEG_PER_H] * 3]
)
"""Initial standard deviations of [P1]; those of the biases are ours."""

_PAPER_Q = np.array([*[500 * UG] * 2, *[0.1 * DEG_PER_H] * 3, *[0.0] * 5])
"""Process noise of a step, as standard deviations."""


def paper_filter(n: int, **changes) -> Filter:
    """[P1]'s filter of n = 5 or 10 states, Q per step."""
    return Filter(_PAPER_P0[:n] ** 2, _PAPER_Q[:n] ** 2, 0.1**2)._replace(**changes)


def filter_params(filt: Filter) -> FilterParams:
    """Numbers of a filter whose states are in one order here and there."""
    scale, inflated = ((by, by, 0.0, 0.0) for by in (filt.factor, filt.turn_factor))
    turns = {"carried": (1.0, 1.0, 0.0, 0.0), "inflated": inflated, "reset": _KINDS["full"]}
    written = tuple(map(float, filt.resets)), None, None, None
    when = acting_reset_times(1.0, *written, filt.at_feedback, float(filt.every))
    when = [*when, *[np.inf] * (RESETS - len(when))]
    p0 = tuple(map(np.float64, filt.p0))
    return FilterParams(
        p0=p0,
        q=tuple(map(np.float64, filt.q)),
        r=np.float64(filt.r),
        feedback=FeedbackSchedule(
            np.float64(filt.every), np.float64(filt.gain), np.float64(1) if filt.restarts else None
        ),
        resets=Resets(
            np.array(when, dtype=float),
            CovarianceReset(*map(np.float64, _KINDS.get(filt.kind, scale))),
        ),
        reset_to=p0,
        reversal=CovarianceReset(*map(np.float64, turns[filt.turn])),
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


_increments = jax.jit(base_motion.ideal_increments, static_argnums=3)


def loops(given: Loops, turn: Sequence[float]) -> compass.LoopParams:
    """Compass loops whose azimuth gains do not change, with a turn rule in numbers."""
    ((begin, gains),) = given.azimuth
    return compass.LoopParams(
        level=LevelGains(*map(np.float64, given.level)),
        azimuth=AzimuthGains(*map(np.float64, gains)),
        pace=PiecewiseConstant(np.array([]), np.array([1.0])),
        azimuth_from=np.float64(begin),
        smoothing=np.float64(given.smoothing),
        reversal=compass.Reversal(*map(np.float64, turn)),
    )


@partial(jax.jit, static_argnums=0)
def _trail(spec: ProgramSpec, environment: Environment, q: Quat, params: RunParams) -> Any:
    draw = Draw(jnp.asarray(0), jnp.asarray(0), jnp.asarray(0), q)
    runs = set_up_alone(spec, environment, draw, params)
    unknown = Quat(*(jnp.full(1, jnp.nan) for _ in range(4)))

    def record(tile: TileState, number: Any) -> tuple[TileState, Any]:
        tile, _ = advance_interval(runs, tile, Intervals(number, unknown))
        return tile, jax.tree.map(lambda a: a[0], tile.run.state)

    first = TileState(runs.start(), runs.sensors.start())
    return jax.lax.scan(record, first, jnp.arange(spec.intervals))[1]


def follow(
    name: str,
    params: Any,
    rows: np.ndarray,
    here: Site,
    start: tuple[np.ndarray, Any, Any],
    *,
    options: Options,
    records: int,
    every: int = 1,
    stored: int | None = None,
) -> Any:
    """The state of a method at every record of one run of the engine, leaves (records, ...).

    The run starts from an attitude, off by a phi (rad), with a velocity (m/s). Its truth is not
    known. A record of ``stored`` records is read forward and backward in turn.
    """
    spec = ProgramSpec(name, options, every, records, curves=False, reverses=True)
    environment = Environment(
        site=here,
        errors=sensors.error_free_sensors(),
        biases=NO_BIASES,
        seed=np.asarray(11),
        criteria=Criteria(np.zeros(1), *(np.float64(0.0),) * 4),
        pass_intervals=np.asarray(stored or records),
        increments=rows,
        attitudes=np.full((1, 1, 4), np.nan),
    )
    c, phi, v = start
    given = RunParams(Vec3(*map(np.float64, phi)), *map(np.float64, v), params)
    return _trail(spec, environment, Quat(*map(np.float64, quaternion(c))), given)


def shown(name: str, options: Options, states: Any) -> tuple[Quat, Any]:
    """Attitude with all that is estimated taken out, and covariance, of states (n,)."""
    program = METHODS[name].build(options)

    def see(state: Any) -> tuple[Quat, Any]:
        return program.attitude(state), program.covariance and program.covariance(state)

    return jax.jit(jax.vmap(see))(states)


def covariances(triangle: Sequence[Any]) -> np.ndarray:
    """Matrices (..., n, n) of upper triangles, entries (...)."""
    n = round((2 * len(triangle)) ** 0.5 - 0.5)
    index = triangle_index(n)
    order = np.array([[index[i, j] for j in range(n)] for i in range(n)])
    return np.moveaxis(np.array(triangle)[order], (0, 1), (-2, -1))


def dense(entries, n):
    """The matrix (n, n) of entries by place."""
    matrix = np.zeros((n, n))
    for at, value in entries.items():
        matrix[at] = -value.of if isinstance(value, Minus) else value
    return matrix


def step_and_close(method, params, site, state, sample, n):
    """A sample of a run taken alone."""
    state = method.step(params, site, state, sample, n)
    return method.feedback.close(params, state, n) if method.feedback else state


@cache
def measured(planet: Planet, latitude: float, samples: int, rate: int = 100) -> np.ndarray:
    """Increments of [P1]'s swing with biases and noise twice its own."""
    return swing_increments(
        PAPER1._replace(center=np.array([0.02, -0.03, 1.0])),
        planet,
        latitude,
        rate=rate,
        samples=samples,
        gyro=((0.2 * DEG_PER_H, -0.1 * DEG_PER_H, 0.3 * DEG_PER_H), 0.2 * DEG_PER_H),
        accel=((1e3 * UG, -5e2 * UG, 3e2 * UG), 1e3 * UG),
    )

"""What runs share, what a draw has for itself, and its measured increments."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.alignment import passes
from sinsjax.alignment.base import Options, Site
from sinsjax.alignment.limits import Biases, mean_biases
from sinsjax.engine.metrics import Criteria
from sinsjax.strapdown import base_motion, earth, sensors
from sinsjax.types import Array, Count, Increments, Quat, Scalar


class Static(NamedTuple):
    """What decides the compiled program; hashable.

    Attributes:
        method: name in `methods.METHODS`.
        options: of that method.
        record_every: samples a record interval.
        records: record intervals in a run; the run is records * record_every samples long.
        curves: whether observations at all record times are returned.
        noisy: whether the sensors have any noise to draw.
        repeats: whether the tape is gone over backward and again; else forward, once.
        sways: whether a base that draws have for themselves sways; a still one is sensed once.
        shown: lanes of a tile whose observations are returned, the first ones; None: all.
    """

    method: str
    options: Options
    record_every: int
    records: int
    curves: bool
    noisy: bool
    repeats: bool = False
    sways: bool = True
    shown: int | None = None


class Environment(NamedTuple):
    """What all runs of a batch share.

    Attributes:
        site: Earth and place.
        tape: (T, 6) ideal or recorded increments, rad and m/s; None where they are made as a run
            goes, since together they would fill the memory.
        truth: (rows, records, 4) true or reference attitude at record times; NaN if unknown.
        errors: of the sensors.
        seed: of the noise.
        criteria: what runs are judged against.
        biases: of the sensors, mean in n.
        pass_records: record intervals a pass over the tape; ignored without repeats.
        times: (records,) record times on the tape, s; None where `truth` has all that is needed.
        motion: of the base, where draws have something for themselves or there is no tape.
    """

    site: Site
    tape: Array | None
    truth: Array
    errors: sensors.SensorErrors
    seed: Count
    criteria: Criteria
    biases: Biases
    pass_records: Count
    times: Array | None = None
    motion: base_motion.Motion | None = None

    @property
    def dtype(self) -> jnp.dtype:
        """Of all numbers of a run."""
        return jnp.result_type(self.truth if self.tape is None else self.tape)


def aligned_record(samples: int) -> np.ndarray:
    """Room for a tape (samples, 6) where XLA takes it as it is: others it copies, in every call."""
    size, line = 8 * 6 * samples, 64
    room = np.empty(size + line, np.uint8)
    begin = -room.ctypes.data % line
    return room[begin : begin + size].view(float).reshape(samples, 6)


class InitialErrors(NamedTuple):
    """What a draw begins with instead of its runs' `Params`; None for what is theirs.

    Attributes:
        phi: angles of the initial misalignment, rad.
        ve: initial velocity east, m/s.
        vn: initial velocity north, m/s.
    """

    phi: tuple[Scalar | None, Scalar | None, Scalar | None] = (None, None, None)
    ve: Scalar | None = None
    vn: Scalar | None = None


class Derived(NamedTuple):
    """What follows from what a draw has for itself; None for what is the environment's.

    Attributes:
        site: at its latitude.
        biases: of its sensors, mean in n.
        rest: ideal increments of its base, where that does not sway.
        ahead: of its base, where that sways.
    """

    site: Site | None = None
    biases: Biases | None = None
    rest: Increments | None = None
    ahead: base_motion.Nodes | None = None


class Draw(NamedTuple):
    """One realisation of what is random: noise, and whatever else a study draws.

    What is None is that of the environment, or of the run.

    Attributes:
        draw_id: decides its noise.
        start: first sample on the tape; of many draws, one number if it is the same for all.
        row: of `Environment.truth`.
        begins: what its runs begin with.
        errors: of its sensors.
        motion: of its base; its increments are made sample by sample, in place of the tape's.
        latitude: of its base, which then has a motion too, rad.
        made: what follows from these.
    """

    draw_id: Count
    start: Count
    row: Count
    begins: InitialErrors = InitialErrors()
    errors: sensors.SensorErrors | None = None
    motion: base_motion.Motion | None = None
    latitude: Scalar | None = None
    made: Derived = Derived()


def noise(
    static: Static, environment: Environment, draws: Draw, numbers: Array
) -> Increments | None:
    """Standard normal numbers, leaves (n, *draws), for n samples; None if no sensor has noise."""
    return sensors.noise(environment.seed, draws.draw_id, numbers) if static.noisy else None


SAMPLES_A_PIECE = 64
"""Samples times draws that are made at a time: fewer leave the vector units idle, more leave the
first-level cache."""


def piece(static: Static, draws: Draw) -> int:
    """Samples that are made at a time; a record interval is cut into equal pieces."""
    every = static.record_every
    most = SAMPLES_A_PIECE // draws.draw_id.size
    return max(n for n in range(1, max(1, min(most, every)) + 1) if every % n == 0)


SAMPLES_A_CALL = 1000
"""Samples whose ideal increments are made at a time where there is no tape."""


def ideal(
    static: Static, environment: Environment, draws: Draw, numbers: Array
) -> Increments | None:
    """What ideal sensors put out over n samples, leaves (n,), where no tape has it; else None.

    None also where draws have a motion of their own.
    """
    if environment.tape is not None or draws.motion is not None:
        return None
    assert environment.motion is not None
    motion, place, rate = environment.motion, environment.site.place, 1 / static.options.dt
    at = partial(base_motion.increment, motion, base_motion.nodes(motion, rate), place, rate)
    k = jnp.asarray(numbers, environment.dtype)
    return (
        jax.vmap(at)(k)
        if k.size <= SAMPLES_A_CALL
        else jax.lax.map(at, k, batch_size=SAMPLES_A_CALL)
    )


def own(static: Static, environment: Environment, draws: Draw, numbers: Array) -> Increments | None:
    """What ideal sensors put out on the swaying bases of draws over n samples, leaves (n, *draws).

    None where draws have no such base. Samples of all draws are made in one row, which fills the
    vector units.
    """
    if draws.made.ahead is None:
        return None
    at = partial(_swayed, static, environment)
    if draws.draw_id.ndim == 0:
        return jax.vmap(partial(at, draws))(numbers)
    shape = (numbers.size, draws.draw_id.size)
    axes = jax.tree.map(lambda a: 0 if jnp.ndim(a) else None, draws)

    def repeated(a: Array) -> Array:
        return jnp.tile(a, (len(numbers), *(1 for _ in a.shape[1:]))) if jnp.ndim(a) else a

    row = jax.vmap(at, in_axes=(axes, 0))(
        jax.tree.map(repeated, draws), jnp.repeat(numbers, shape[1])
    )
    return jax.tree.map(lambda a: a.reshape(shape), row)


def _swayed(static: Static, environment: Environment, draw: Draw, n: Count) -> Increments:
    """What ideal sensors put out over sample ``n`` on a swaying base that the draw has."""
    assert draw.motion is not None and draw.made.ahead is not None
    place = (environment.site if draw.made.site is None else draw.made.site).place
    k = jnp.asarray(n, environment.dtype)
    return base_motion.increment(draw.motion, draw.made.ahead, place, 1 / static.options.dt, k)


def measured(
    static: Static,
    environment: Environment,
    draw: Draw,
    n: Count,
    normal: Increments | None,
    exact: Increments | None = None,
) -> Increments:
    """Measured increments of sample ``n`` (from 0) of one draw: rad, m/s.

    Zeros for a negative number, before the tape: with them nothing is compensated. ``exact`` is
    what ideal sensors put out, if it was made already.
    """
    if exact is not None:
        pass
    elif draw.made.rest is not None:
        exact = draw.made.rest
    elif draw.motion is not None:
        exact = _swayed(static, environment, draw, n)
    else:
        exact = sensors.split(jnp.asarray(environment.tape)[draw.start + n])
    errors = environment.errors if draw.errors is None else draw.errors
    put_out = sensors.measure(exact, errors, normal, static.options.dt)
    if not static.repeats:
        return put_out
    return passes.where(n < 0, jax.tree.map(jnp.zeros_like, put_out), put_out)


def derived(static: Static, environment: Environment, draw: Draw) -> Derived:
    """What follows from what a draw has for itself."""
    if draw.errors is None and draw.motion is None and draw.latitude is None:
        return Derived()
    site = environment.site
    if draw.latitude is not None:
        site = Site(site.earth, earth.place(site.earth, draw.latitude), draw.latitude)
    errors = environment.errors if draw.errors is None else draw.errors
    motion = environment.motion if draw.motion is None else draw.motion
    assert motion is not None
    rest = ahead = None
    if draw.motion is not None:
        ahead = base_motion.nodes(motion, 1 / static.options.dt)
        if not static.sways:
            rest = base_motion.increment(motion, ahead, site.place, 1 / static.options.dt, 0.0)
            ahead = None
    own = None if draw.latitude is None else site
    return Derived(own, mean_biases(errors, motion), rest, ahead)


def attitudes(static: Static, environment: Environment, draws: Draw) -> Quat | None:
    """True attitudes at record times where draws have a motion of their own, else None.

    Returns:
        Leaves (records, *draws).
    """
    if draws.motion is None:
        return None
    times = jnp.asarray(environment.times)[: static.records]
    at = jax.vmap(base_motion.attitude, in_axes=(None, 0))
    many = at if draws.draw_id.ndim == 0 else jax.vmap(at, in_axes=(0, None), out_axes=1)
    return many(draws.motion, times)


def attitude(environment: Environment, draws: Draw, number: Count) -> Quat:
    """True attitude at the end of a record by `Environment.truth`, leaves (*draws); NaN if unknown.

    Looked up record by record: those of all records, draw by draw, would fill the memory.
    """
    return Quat(*jnp.moveaxis(jnp.asarray(environment.truth)[draws.row, number], -1, 0))

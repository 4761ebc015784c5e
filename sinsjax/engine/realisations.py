"""What runs share, and what a draw has for itself."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.engine.metrics import Criteria
from sinsjax.methods.base import Method, Options, Site
from sinsjax.methods.coloured_growth import Coloured
from sinsjax.methods.error_growth import with_growth
from sinsjax.methods.floors import MeanBiases, mean_biases
from sinsjax.methods.registry import METHODS
from sinsjax.strapdown import base_motion, earth, sensors
from sinsjax.strapdown.base_motion import Sensed
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.types import Array, Count, Quat, Scalar


class CoarseStage(NamedTuple):
    """Coarse alignment as the first stage of a run.

    Attributes:
        method: name in `methods.METHODS`, of one that needs no initial attitude.
        records: record intervals that it takes.
        replays: whether fine alignment then begins with the first sample again.
    """

    method: str
    records: int
    replays: bool


class Static(NamedTuple):
    """What decides the compiled program; hashable.

    Attributes:
        method: name in `methods.METHODS`.
        options: of that method.
        record_every: samples a record interval.
        records: record intervals in a run; the run is records * record_every samples long.
        curves: whether observations at all record times are returned.
        noisy: whether the sensors have any noise to draw.
        repeats: whether the stored record is read in repeated passes; else forward, once.
        rewinds: whether it is then read forward in every pass.
        coarse: the stage before the method's own; None where that begins by itself.
        sways: whether a base that draws have for themselves sways; a still one is sensed once.
        distorted: whether the sensors have scale factor errors or misaligned axes.
        sampled_errors: of how many sampled errors of each run the spread is told beside it, see
            `covariance`; 0 where none is.
        kept: samples of a draw's record that are made once and kept, where passes read it in both
            directions and a sample hangs on those before it; 0 where samples are made as they come.
    """

    method: str
    options: Options
    record_every: int
    records: int
    curves: bool
    noisy: bool
    repeats: bool = False
    sways: bool = True
    distorted: bool = True
    rewinds: bool = False
    kept: int = 0
    coarse: CoarseStage | None = None
    sampled_errors: int = 0

    @property
    def winds_back(self) -> bool:
        """Whether an attitude is wound back to the beginning of the record."""
        return self.rewinds or (self.coarse is not None and self.coarse.replays)


def method_of(static: Static) -> Method:
    """Build the study's method."""
    method = METHODS[static.method](static.options)
    return with_growth(method) if static.sampled_errors else method


class Environment(NamedTuple):
    """What all runs of a batch share.

    Attributes:
        site: Earth and place.
        increments: (T, 6) the stored record, ideal or recorded, rad and m/s; None where increments
            are made as a run goes, since together they would fill the memory.
        truth: (rows, records, 4) true or reference attitude at record times; NaN if unknown.
        errors: of the sensors.
        seed: of the noise.
        criteria: what runs are judged against.
        biases: of the sensors, mean in n.
        pass_records: record intervals a pass; ignored without repeats.
        times: (records,) record times by the clock of the stored record, s; None where `truth` has
            all that is needed.
        motion: of the base, where draws have something for themselves or no increments are stored.
        axes: (T, 9) axes of n in b over the stored samples, where disturbances ask for them.
        disturbances: of base and sensors.
        spread_at: numbers, from 0, of the records at which the spread of runs is told; None for
            all.
        coloured: errors of the increments that the spread has beside white noise.
        drawn: what draws have for themselves, where all of it is drawn normally; else None.
    """

    site: Site
    increments: Array | None
    truth: Array
    errors: sensors.SensorErrors
    seed: Count
    criteria: Criteria
    biases: MeanBiases
    pass_records: Count
    times: Array | None = None
    motion: base_motion.Motion | None = None
    axes: Array | None = None
    disturbances: Disturbances = Disturbances()
    spread_at: Array | None = None
    coloured: Coloured = Coloured()
    drawn: "DrawnNormally | None" = None

    @property
    def dtype(self) -> jnp.dtype:
        """Of all numbers of a run."""
        return jnp.result_type(self.truth if self.increments is None else self.increments)


def aligned_record(samples: int) -> np.ndarray:
    """Room for a record (samples, 6) that XLA takes as it is: others it copies, in every call."""
    size, line = 8 * 6 * samples, 64
    room = np.empty(size + line, np.uint8)
    begin = -room.ctypes.data % line
    return room[begin : begin + size].view(float).reshape(samples, 6)


class InitialErrors(NamedTuple):
    """What a draw begins with instead of its runs' `RunParams`; None for what is theirs.

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
        rest: what ideal sensors measure on its base, where that does not sway.
        nodes: of its base, where that sways.
    """

    site: Site | None = None
    biases: MeanBiases | None = None
    rest: Sensed | None = None
    nodes: base_motion.Nodes | None = None


class Draw(NamedTuple):
    """One realisation of what is random: noise, and whatever else a study draws.

    What is None is that of the environment, or of the run.

    Attributes:
        draw_id: decides its noise.
        start: first sample in the stored record; of many draws, one number if all have the same.
        row: of `Environment.truth`.
        begins: what its runs begin with.
        errors: of its sensors.
        motion: of its base; its increments are made as a run goes, in place of the
            stored ones.
        latitude: of its base, which then has a motion too, rad.
        disturbances: of its base and sensors.
        made: what follows from these.
    """

    draw_id: Count
    start: Count
    row: Count
    begins: InitialErrors = InitialErrors()
    errors: sensors.SensorErrors | None = None
    motion: base_motion.Motion | None = None
    latitude: Scalar | None = None
    disturbances: Disturbances | None = None
    made: Derived = Derived()


class DrawnNormally(NamedTuple):
    """The normal distributions of what draws have for themselves: means and standard deviations.

    Attributes:
        begins: means of what they begin with; None for what is the run's.
        errors: of sensors with the mean biases; None where no bias is drawn.
        begins_sigma: (5,) of phi about e, n, u, rad, and of the velocity east and north, m/s.
        gyro_bias_sigma: (3,) rad/s; None where it is not drawn.
        accel_bias_sigma: (3,) m/s^2; likewise.
    """

    begins: InitialErrors
    errors: sensors.SensorErrors | None
    begins_sigma: Array
    gyro_bias_sigma: Array | None
    accel_bias_sigma: Array | None

    def mean(self, draws: Draw) -> Draw:
        """The first of some draws with the means for its own, leaves (1, ...)."""
        return Draw(
            draws.draw_id[:1],
            draws.start,
            draws.row[:1],
            *jax.tree.map(lambda a: np.asarray(a)[None], (self.begins, self.errors)),
        )


def derived(static: Static, environment: Environment, draw: Draw) -> Derived:
    """What follows from what a draw has for itself."""
    if draw.errors is None and draw.motion is None and draw.latitude is None:
        return Derived()
    site = environment.site
    if draw.latitude is not None:
        site = Site(site.earth, earth.place(site.earth, draw.latitude), draw.latitude)
    errors = errors_of(environment, draw)
    motion = environment.motion if draw.motion is None else draw.motion
    assert motion is not None
    rest = nodes = None
    if draw.motion is not None:
        nodes = base_motion.nodes(motion, 1 / static.options.dt)
        if not static.sways:
            rest = base_motion.sensed(motion, nodes, site.place, 1 / static.options.dt, 0.0)
            nodes = None
    own = None if draw.latitude is None else site
    return Derived(own, mean_biases(errors, motion), rest, nodes)


def errors_of(environment: Environment, draw: Draw) -> sensors.SensorErrors:
    """Of the sensors of a draw."""
    return environment.errors if draw.errors is None else draw.errors


def quantised(environment: Environment, draw: Draw) -> bool:
    """Whether the sensors of a draw have quanta."""
    return errors_of(environment, draw).gyro_quantum is not None


def disturbances_of(environment: Environment, draw: Draw) -> Disturbances:
    """Processes that disturb a draw."""
    return environment.disturbances if draw.disturbances is None else draw.disturbances


def site_of(environment: Environment, draw: Draw) -> Site:
    """Earth and place of a draw."""
    return environment.site if draw.made.site is None else draw.made.site


def biases_of(environment: Environment, draw: Draw) -> MeanBiases:
    """Mean sensor biases of a draw."""
    return environment.biases if draw.made.biases is None else draw.made.biases


def first_attitude(draw: Draw) -> Quat | None:
    """True attitude of a draw that has a motion of its own before its first sample, else None."""
    return None if draw.motion is None else base_motion.attitude(draw.motion, 0.0)


def attitude(environment: Environment, draw: Draw, number: Array) -> Quat:
    """True attitude at the end of a record interval by `Environment.truth`; NaN if unknown."""
    return Quat(*jnp.moveaxis(jnp.asarray(environment.truth)[draw.row, number], -1, 0))


def attitudes(static: Static, environment: Environment, draw: Draw) -> Quat:
    """True attitudes of a draw at all record times, leaves (records,)."""
    if draw.motion is None:
        return attitude(environment, draw, jnp.arange(static.records))
    times = jnp.asarray(environment.times)[: static.records]
    return jax.vmap(partial(base_motion.attitude, draw.motion))(times)

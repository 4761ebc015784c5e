"""The inputs of runs: program, environment, draws and params, all in SI units.

A `ProgramSpec` decides the compiled program. Runs of one program share an `Environment`: Earth,
base, sensors, truth and criteria. A `Draw` is one realisation of everything random, and `RunParams`
are the numbers of one run. Fields of a draw that are None are those of the environment or the run.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.engine.metrics import Criteria
from sinsjax.methods.floors import MeanBiases, mean_biases
from sinsjax.methods.method import Options, Program, Site
from sinsjax.methods.registry import METHODS
from sinsjax.strapdown import base_motion, earth, sensors
from sinsjax.strapdown.base_motion import IdealSample
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.types import Array, Count, Flag, Quat, Scalar, Vec3

# What decides the program


class CoarseStage(NamedTuple):
    """Coarse alignment as the first stage of a run.

    Attributes:
        method: name in `registry.METHODS`, of a method that needs no initial attitude.
        intervals: its length.
        replays: whether fine alignment then starts from the first sample again.
    """

    method: str
    intervals: int
    replays: bool


class SensorProgram(NamedTuple):
    """The part of a program that simulates the sensors.

    Attributes:
        noisy: whether the sensors have white noise.
        distorted: whether they have scale factor errors or misaligned axes.
        sways: whether a base drawn for each draw sways or is turned; a still one is measured once.
        kept: samples per draw that are made once and kept, when passes read them in both
            directions and each sample depends on those before it; 0 to make samples as they are
            read.
    """

    noisy: bool = False
    distorted: bool = False
    sways: bool = True
    kept: int = 0


class ProgramSpec(NamedTuple):
    """The choices that decide a compiled program; hashable.

    Attributes:
        method: name in `registry.METHODS`.
        options: of that method.
        interval_samples: samples of an interval between two outputs.
        intervals: of a run, which has intervals * interval_samples samples.
        curves: whether the observations at the ends of all intervals are returned.
        sensors: see `SensorProgram`.
        passes: how the stored record is read: "once", forward and backward in turn ("alternate"),
            or forward every time ("rewind").
        coarse: the stage before the method's own; None if there is none.
        stacks: whether tiles of a method whose covariance all draws share may share it.
    """

    method: str
    options: Options
    interval_samples: int
    intervals: int
    curves: bool
    sensors: SensorProgram = SensorProgram()
    passes: Literal["once", "alternate", "rewind"] = "once"
    coarse: CoarseStage | None = None
    stacks: bool = True

    @property
    def rewinds_attitude(self) -> bool:
        """Whether an attitude is propagated back to the beginning of the record."""
        return self.passes == "rewind" or (self.coarse is not None and self.coarse.replays)

    @property
    def program(self) -> Program:
        """The functions of the method."""
        return METHODS[self.method].build(self.options)

    @property
    def shares_covariance(self) -> bool:
        """Whether stacked tiles share one covariance."""
        return self.stacks and self.program.shares_covariance

    @property
    def finds_heading(self) -> bool:
        """Whether the method finds a heading."""
        return METHODS[self.method].finds_heading

    def of_coarse_stage(self) -> "ProgramSpec":
        """Return the program of the coarse stage, which lies within one pass."""
        assert self.coarse is not None
        options = Options(self.options.dt)
        return self._replace(method=self.coarse.method, options=options, passes="once")


# What runs share


class SensorModel(NamedTuple):
    """The base and the sensors that all runs share.

    Attributes:
        increments: (T, 6) the stored record, ideal or measured, rad and m/s; None if increments are
            made as a run proceeds, since all together would fill the memory.
        errors: of the sensors.
        seed: of all noise.
        motion: of the base, if draws differ, no increments are stored, or the housing rotates.
        axes: (T, 9) axes of n in b over the stored samples, if disturbances need them.
        disturbances: random processes of base and sensors.
    """

    increments: Array | None
    errors: sensors.SensorErrors
    seed: Count
    motion: base_motion.Motion | None = None
    axes: Array | None = None
    disturbances: Disturbances = Disturbances()


class Truth(NamedTuple):
    """The true or reference attitude.

    Attributes:
        attitudes: (rows, intervals, 4) quaternions at the ends of intervals; NaN if unknown.
        times: (intervals,) these ends by the clock of the stored record, s; None if draws have no
            motion of their own.
    """

    attitudes: Array
    times: Array | None = None


class Environment(NamedTuple):
    """Everything that the runs of a program share.

    Attributes:
        site: Earth and place.
        sensors: base and sensors.
        truth: true attitudes.
        criteria: thresholds and times by which runs are judged.
        biases: mean sensor biases in n.
        pass_intervals: of a pass; without effect on a record that is read once.
    """

    site: Site
    sensors: SensorModel
    truth: Truth
    criteria: Criteria
    biases: MeanBiases
    pass_intervals: Count

    @property
    def dtype(self) -> jnp.dtype:
        """Type of all numbers of a run."""
        stored = self.sensors.increments
        return jnp.result_type(self.truth.attitudes if stored is None else stored)


def aligned_record(samples: int) -> np.ndarray:
    """Return room for a record (samples, 6), aligned so that XLA does not copy it in every call."""
    size, line = 8 * 6 * samples, 64
    room = np.empty(size + line, np.uint8)
    begin = -room.ctypes.data % line
    return room[begin : begin + size].view(float).reshape(samples, 6)


# What belongs to a draw, and to a run


class InitialErrors(NamedTuple):
    """Initial errors of a draw in place of those of `RunParams`; None for those of the run.

    Attributes:
        phi: angles of the initial misalignment, rad.
        ve: initial velocity east, m/s.
        vn: initial velocity north, m/s.
    """

    phi: tuple[Scalar | None, Scalar | None, Scalar | None] = (None, None, None)
    ve: Scalar | None = None
    vn: Scalar | None = None


class DerivedInputs(NamedTuple):
    """Inputs that follow from those drawn; None for those of the environment.

    Attributes:
        site: at the latitude of the draw.
        biases: mean sensor biases in n.
        rest: what ideal sensors measure on a base that does not sway.
        nodes: integration nodes of a base that sways.
    """

    site: Site | None = None
    biases: MeanBiases | None = None
    rest: IdealSample | None = None
    nodes: base_motion.Nodes | None = None


class Draw(NamedTuple):
    """One realisation of everything random: noise, and the numbers that a study draws.

    Attributes:
        draw_id: number that decides its noise.
        start: first sample in the stored record; one number if many draws have the same.
        row: row of `Truth.attitudes`.
        q: attitude before the initial misalignment is added: true, or coarsely aligned.
        initial: initial errors.
        errors: of the sensors.
        motion: of the base, whose increments are made as a run proceeds.
        latitude: of the base, which then has a motion too, rad.
        disturbances: random processes of base and sensors.
        derived: inputs that follow from these.
    """

    draw_id: Count
    start: Count
    row: Count
    q: Quat
    initial: InitialErrors = InitialErrors()
    errors: sensors.SensorErrors | None = None
    motion: base_motion.Motion | None = None
    latitude: Scalar | None = None
    disturbances: Disturbances | None = None
    derived: DerivedInputs = DerivedInputs()


class RunParams(NamedTuple):
    """Numbers of one run: all of them can be swept, mapped over or differentiated by.

    Attributes:
        phi: initial misalignment, rotation vector in n, rad.
        ve: initial velocity east, m/s.
        vn: initial velocity north, m/s.
        method: params of the method.
        euler: whether ``phi`` still holds Euler angles, if draws have some of them.
    """

    phi: Vec3
    ve: Scalar
    vn: Scalar
    method: Any
    euler: Flag | None = None


class Tiles(NamedTuple):
    """The draws and params of tiles; leading axes of tiles, and of sets if tiles are stacked.

    Attributes:
        draws: leaves (tiles, [sets,] draws).
        row: (tiles, lanes) draw of each lane among those of its tile.
        params: leaves (tiles, lanes, ...).
    """

    draws: Draw
    row: Array
    params: RunParams


class DrawInputs(NamedTuple):
    """All inputs of a draw: its own, or those of the environment.

    Attributes:
        site: Earth and place.
        errors: of the sensors.
        motion: of the base; None if it does not matter beyond its increments.
        disturbances: random processes of base and sensors.
        biases: mean sensor biases in n.
    """

    site: Site
    errors: sensors.SensorErrors
    motion: base_motion.Motion | None
    disturbances: Disturbances
    biases: MeanBiases


def inputs_of(environment: Environment, draw: Draw) -> DrawInputs:
    """Return all inputs of a draw, whose derived ones are known."""
    shared, derived = environment.sensors, draw.derived
    return DrawInputs(
        environment.site if derived.site is None else derived.site,
        shared.errors if draw.errors is None else draw.errors,
        shared.motion if draw.motion is None else draw.motion,
        shared.disturbances if draw.disturbances is None else draw.disturbances,
        environment.biases if derived.biases is None else derived.biases,
    )


def derive_inputs(spec: ProgramSpec, environment: Environment, draw: Draw) -> DerivedInputs:
    """Return the inputs that follow from the numbers of one draw."""
    if draw.errors is None and draw.motion is None and draw.latitude is None:
        return DerivedInputs()
    site = environment.site
    if draw.latitude is not None:
        site = Site(site.earth, earth.place(site.earth, draw.latitude), draw.latitude)
    given = inputs_of(environment, draw)
    assert given.motion is not None
    rest = nodes = None
    if draw.motion is not None:
        rate_hz = 1 / spec.options.dt
        nodes = base_motion.integration_nodes(draw.motion, rate_hz)
        if not spec.sensors.sways:
            rest = base_motion.ideal_sample(draw.motion, nodes, site.place, rate_hz, 0.0)
            nodes = None
    return DerivedInputs(
        None if draw.latitude is None else site,
        mean_biases(given.errors, given.motion),
        rest,
        nodes,
    )


def map_draws(
    function: Callable[..., Any], draws: Draw, *others: Any, axes: Any = None, out_axes: int = 0
) -> Any:
    """Map a function over draws, whose leaves are (draws,), or () of what all of them share.

    Args:
        function: of one draw, and of others.
        draws: to map over.
        others: further arguments.
        axes: axis of the draws in each of ``others``; None for 0 in all of them.
        out_axes: axis of the draws in what is returned.
    """
    leaves = jax.tree.map(lambda a: 0 if jnp.ndim(a) else None, draws)
    in_axes = (leaves, *((0,) * len(others) if axes is None else axes))
    return jax.vmap(function, in_axes, out_axes)(draws, *others)


def stored_attitude(truth: Truth, draw: Draw, number: Array) -> Quat:
    """Return the stored attitude of the base at the end of an interval; NaN if unknown."""
    return Quat(*jnp.moveaxis(jnp.asarray(truth.attitudes)[draw.row, number], -1, 0))


def computed_attitudes(truth: Truth, draw: Draw, intervals: int) -> Quat:
    """Return the attitudes of a base of the draw's own, at the ends of intervals."""
    assert draw.motion is not None
    times = jnp.asarray(truth.times)[:intervals]
    return jax.vmap(partial(base_motion.attitude, draw.motion))(times)

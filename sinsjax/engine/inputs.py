"""The inputs of runs: program, environment, draws and params, all in SI units.

A `ProgramSpec` decides the compiled program. Runs of one program share an `Environment`: Earth,
base, sensors, truth and criteria. A `Draw` is one realisation of everything random, and `RunParams`
are the numbers of one run. Fields of a draw that are None are those of the environment or the run.
True attitudes and increments of ideal sensors are computed here for whole studies.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.engine.metrics import Criteria
from sinsjax.methods.floors import MeanBiases, mean_biases
from sinsjax.methods.method import Options, Program, Site
from sinsjax.methods.registry import METHODS
from sinsjax.strapdown import base_motion, earth, sensors
from sinsjax.strapdown.base_motion import IdealSample, Motion, Nodes
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.sensors import SensorErrors
from sinsjax.types import Array, Count, Flag, Navigation, Quat, Sample, Scalar, Vec3

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


class ProgramSpec(NamedTuple):
    """The choices that decide a compiled program; hashable.

    Attributes:
        method: name in `registry.METHODS`.
        options: of that method.
        interval_samples: samples of an interval between two outputs.
        intervals: of a run, which has intervals * interval_samples samples.
        curves: whether the observations at the ends of all intervals are returned.
        noisy: whether the sensors have white noise.
        distorted: whether they have scale factor errors or misaligned axes.
        sways: whether a base drawn for each draw sways or is turned; a still one is measured once.
        kept: samples per draw that are made once and kept, when passes read them in both
            directions and each sample depends on those before it; 0 to make samples as they are
            read.
        reverses: whether the stored record is read repeatedly, forward and backward in turn.
        coarse: the stage before the method's own; None if there is none.
        stacks: whether tiles of a method whose covariance all draws share may share it.
    """

    method: str
    options: Options
    interval_samples: int
    intervals: int
    curves: bool
    noisy: bool = False
    distorted: bool = False
    sways: bool = True
    kept: int = 0
    reverses: bool = False
    coarse: CoarseStage | None = None
    stacks: bool = True

    @property
    def program(self) -> Program:
        """The functions of the method."""
        return METHODS[self.method].build(self.options)

    @property
    def shares_covariance(self) -> bool:
        """Whether stacked tiles share one covariance."""
        return self.stacks and self.program.shares_covariance

    def of_coarse_stage(self) -> "ProgramSpec":
        """Return the program of the coarse stage, which lies within one pass."""
        assert self.coarse is not None
        options = Options(self.options.dt)
        return self._replace(method=self.coarse.method, options=options, reverses=False)


# What runs share


class Environment(NamedTuple):
    """Everything that the runs of a program share.

    Attributes:
        site: Earth and place.
        errors: of the sensors.
        biases: mean sensor biases in n.
        seed: of all noise.
        criteria: thresholds and times by which runs are judged.
        pass_intervals: of a pass; without effect on a record that is read once.
        increments: (T, 6) the stored record, ideal or measured, rad and m/s; None if increments are
            made as a run proceeds, since all together would fill the memory.
        attitudes: (rows, intervals, 4) true or reference attitudes at the ends of intervals,
            quaternions; NaN if unknown.
        end_times: (intervals,) these ends by the clock of the stored record, s; None if draws have
            no motion of their own.
        motion: of the base, if draws differ, no increments are stored, or the housing rotates.
        axes: (T, 9) axes of n in b over the stored samples, if disturbances need them.
        disturbances: random processes of base and sensors.
    """

    site: Site
    errors: SensorErrors
    biases: MeanBiases
    seed: Count
    criteria: Criteria
    pass_intervals: Count
    increments: Array | None
    attitudes: Array
    end_times: Array | None = None
    motion: Motion | None = None
    axes: Array | None = None
    disturbances: Disturbances = Disturbances()

    @property
    def dtype(self) -> jnp.dtype:
        """Type of all numbers of a run."""
        return jnp.result_type(self.attitudes if self.increments is None else self.increments)


def aligned_record(samples: int) -> np.ndarray:
    """Return room for a record (samples, 6), aligned so that XLA does not copy it in every call."""
    size, line = 8 * 6 * samples, 64
    room = np.empty(size + line, np.uint8)
    begin = -room.ctypes.data % line
    return room[begin : begin + size].view(float).reshape(samples, 6)


# What belongs to a draw, and to a run


class Draw(NamedTuple):
    """One realisation of everything random: noise, and the numbers that a study draws.

    Of the fields after ``q``, None stands for the value of the run or of the environment.

    Attributes:
        draw_id: number that decides its noise.
        start: first sample in the stored record; one number if many draws have the same.
        row: row of `Environment.attitudes`.
        q: attitude before the initial misalignment is added: true, or coarsely aligned.
        phi: angles of the initial misalignment, rad.
        ve: initial velocity east, m/s.
        vn: initial velocity north, m/s.
        errors: of the sensors.
        motion: of the base, whose increments are made as a run proceeds.
        latitude: of the base, which then has a motion too, rad.
        disturbances: random processes of base and sensors.
        site: derived from the latitude.
        biases: mean sensor biases in n, derived from errors and motion.
        rest: what ideal sensors measure on a base that does not sway, derived from its motion.
        nodes: integration nodes of a base that sways, likewise.
    """

    draw_id: Count
    start: Count
    row: Count
    q: Quat
    phi: tuple[Scalar | None, Scalar | None, Scalar | None] = (None, None, None)
    ve: Scalar | None = None
    vn: Scalar | None = None
    errors: SensorErrors | None = None
    motion: Motion | None = None
    latitude: Scalar | None = None
    disturbances: Disturbances | None = None
    site: Site | None = None
    biases: MeanBiases | None = None
    rest: IdealSample | None = None
    nodes: Nodes | None = None

    @property
    def run_axis(self) -> int | None:
        """Axis, for `jax.vmap`, of what is broadcast to runs; None if all share one draw."""
        return None if len(self.draw_id) == 1 else 0


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


def complete(environment: Environment, draw: Draw) -> Any:
    """Return a draw with site, sensor errors, motion, disturbances and biases of the environment.

    Its own have precedence; the motion may be None, where it does not matter beyond increments.
    """
    fields = ("site", "errors", "motion", "disturbances", "biases")
    missing = (field for field in fields if getattr(draw, field) is None)
    return draw._replace(**{field: getattr(environment, field) for field in missing})


def derive_inputs(spec: ProgramSpec, environment: Environment, draws: Draw) -> Draw:
    """Return draws with what follows from their own numbers."""
    if draws.errors is None and draws.motion is None and draws.latitude is None:
        return draws

    def derive_place_biases_and_motion(draw: Draw) -> dict[str, Any]:
        derived: dict[str, Any] = {}
        if draw.latitude is not None:
            place = earth.place(environment.site.earth, draw.latitude)
            derived["site"] = Site(environment.site.earth, place, draw.latitude)
        whole = complete(environment, draw._replace(**derived))
        derived["biases"] = mean_biases(whole.errors, whole.motion)
        if draw.motion is None:
            return derived
        rate_hz = 1 / spec.options.dt
        nodes = base_motion.integration_nodes(draw.motion, rate_hz)
        if spec.sways:
            return derived | {"nodes": nodes}
        rest = base_motion.ideal_sample(draw.motion, nodes, whole.site.place, rate_hz, 0.0)
        return derived | {"rest": rest}

    return draws._replace(**map_draws(derive_place_biases_and_motion, draws))


def map_draws(
    function: Callable[..., Any], draws: Draw, *others: Any, axes: Any = None, out_axes: int = 0
) -> Any:
    """Map a function over draws, whose leaves are (draws,), or () of what all of them share.

    Draws are the first axis of all others, or the ``axes`` of each.
    """
    leaves = jax.tree.map(lambda a: 0 if jnp.ndim(a) else None, draws)
    in_axes = (leaves, *((0,) * len(others) if axes is None else axes))
    return jax.vmap(function, in_axes, out_axes)(draws, *others)


# The truth and coarse attitudes of whole studies

_SAMPLES, _TIMES = 4000, 256
"""Samples of increments, and attitudes, per call: one program serves studies of any length."""


@partial(jax.jit, static_argnums=(0, 2))
def coarse_attitudes(method: str, increments: Array, dt: float, site: Site) -> Array:
    """Return coarsely aligned attitudes at the ends of parts of a record, (parts, 4).

    The method needs no initial attitude and no params; the increments (parts, n, 6) are
    those measured over ``dt`` s, rad and m/s.
    """
    program = METHODS[method].build(Options(dt))

    def align(part: Array) -> Array:
        samples = sensors.compensate_record(part, part[0])
        return jnp.stack(align_by_program(program, samples, site))

    return jax.vmap(align)(increments)


def align_by_program(program: Program, samples: Sample, site: Site) -> Quat:
    """Return q_nb at the end of compensated samples, leaves (n,), by a method without params."""
    counts = 1 + jnp.arange(samples.dv.x.size, dtype=samples.dv.x.dtype)
    zero = jnp.zeros_like(counts[0])
    start = Navigation(Quat(zero + 1, zero, zero, zero), zero, zero, site.latitude + zero, zero)

    def over_sample(state: Any, numbered: tuple[Sample, Scalar]) -> tuple[Any, None]:
        sample, n = numbered
        return program.step((), site, state, sample, n), None

    state, _ = jax.lax.scan(over_sample, program.init((), start), (samples, counts))
    return program.attitude(program.normalise(state))


_increments = jax.jit(base_motion.ideal_increments, static_argnames=("samples", "with_axes"))


@jax.jit
def _attitudes(motion: Motion, times: Array) -> Array:
    return jax.vmap(lambda t: jnp.stack(base_motion.attitude(motion, t)))(times)


def true_increments(
    motion: Motion,
    place: Place,
    rate_hz: float,
    samples: int,
    *,
    with_axes: bool = False,
    blank: bool = False,
) -> np.ndarray:
    """Return ideal increments, rad and m/s: (samples, 6), or with the axes of n (samples, 15).

    The axes of n in b are means over each sample. If blank, all are zero, enough to compile.
    """
    increments = np.zeros((samples, 15 if with_axes else 6))
    for first in range(0, 0 if blank else samples, _SAMPLES):
        block = increments[first : first + _SAMPLES]
        made = _increments(motion, place, rate_hz, _SAMPLES, float(first), with_axes=with_axes)
        block[:] = made[: len(block)]
    return increments


def true_attitudes(motion: Motion, times: np.ndarray, *, blank: bool = False) -> np.ndarray:
    """Return true attitudes, body to n, (n, 4) quaternions at times (n,), s; or zeros if blank."""
    attitudes = np.zeros((len(times), 4))
    for first in range(0, 0 if blank else len(times), _TIMES):
        block = attitudes[first : first + _TIMES]
        padded = np.resize(times[first : first + _TIMES], _TIMES)
        block[:] = _attitudes(motion, padded)[: len(block)]
    return attitudes

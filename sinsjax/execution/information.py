"""Lower bound of the heading error of any method on the data of a study, in memory."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pyarrow as pa

from sinsjax import columns
from sinsjax.bounds.coloured_noise import (
    ANGLE,
    IN_B,
    VELOCITY,
    increment_error_processes,
)
from sinsjax.bounds.information import heading_bound
from sinsjax.bounds.turning_information import (
    LONGEST_STEP_S,
    MOTION_NODES,
    ConstantErrors,
    HeadingProblem,
    IncrementErrors,
    WhiteNoise,
    turning_heading_bound,
)
from sinsjax.engine.inputs import Environment
from sinsjax.engine.scenario import (
    ENVIRONMENT_KEYS,
    Scenario,
    add_turns,
    read_disturbances,
    read_errors,
    read_sways,
)
from sinsjax.errors import InputError
from sinsjax.execution.tables import make_table
from sinsjax.maths.rotations import matrix
from sinsjax.methods.floors import mean_attitude
from sinsjax.platform import runtime
from sinsjax.strapdown.base_motion import Motion, attitude, rate_and_force
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.processes import Process, rounding_process
from sinsjax.strapdown.sensors import SensorErrors
from sinsjax.study.keys import SECTION_OF
from sinsjax.study.load import load_study
from sinsjax.study.schema import keys_acting_as
from sinsjax.study.study import Study
from sinsjax.study.variants import Variants
from sinsjax.types import Array
from sinsjax.units import ARCMIN

_CONSTANT_KEYS = keys_acting_as("bias", "distortion")
"""Keys of the sensors' constant errors."""

_TIMES = 4096
"""Times per call of the motion: one program serves studies of any length."""


def information_bound(study: Study | str | Path) -> pa.Table:
    """Return the information bound of a simulated study's heading.

    No unbiased method has a smaller standard deviation of the heading error, whatever its initial
    state; the settings of the study's methods have no influence. Variants with the same Earth,
    motion and sensors share a bound.

    On a base at rest with fixed sensor errors the bound is measured from the bias floor, see
    `bounds.information`; it takes about a second for 300 s at 100 Hz. It is measured from the
    true heading, see `bounds.turning_information`, if biases, scale factors or cross-axis
    errors are drawn from a normal distribution, whose standard deviation is then the prior
    knowledge, and on a base that turns, where the absolute value of a fixed error counts as its
    standard deviation. This bound takes about 0.1 s for 300 s.

    Args:
        study: study, its file, or the name of a shipped study.

    Returns:
        One row per variant and time, `report_times_s` and the end of its run: the least 1 sigma of
        phi_u. The schema has units and meanings.

    Raises:
        InputError: the study has a record or passes, draws a value that affects the bound, or has
            accelerometers without white noise.

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.rate_hz": 10.0})
        >>> bound = sinsjax.information_bound(study)
        >>> [round(sigma, 2) for sigma in bound["bound_u_arcmin"].to_pylist()]
        [1.17, 1.17, 1.17]
    """
    runtime.ensure_configured()
    study = load_study(study)
    _check_bound_applies(study)
    scenario, ends = Scenario(study), study.spans_s[:, 0]
    swept = [key for key in study.axis_keys if key in ENVIRONMENT_KEYS]
    codes = study.resolved.column(*swept).codes if swept else np.zeros(study.n_variants, int)
    bounds: dict[tuple[int, float], dict[float, float]] = {}
    rows: list[tuple[int, float, float]] = []
    for part, ids in enumerate(scenario.variant_ids):
        for variant in ids:
            key = int(codes[variant]), float(ends[variant])
            if key not in bounds:
                times = sorted({*(t for t in study.report_times_s if t < key[1]), key[1]})
                bounds[key] = dict(
                    zip(times, _heading_sigma_bound(scenario, part, times), strict=True)
                )
            rows += [(int(variant), time, sigma) for time, sigma in bounds[key].items()]
    names = (c.name for c in columns.INFORMATION_BOUND)
    values = zip(
        names, (np.array(column) for column in zip(*sorted(rows), strict=True)), strict=True
    )
    return make_table(columns.INFORMATION_BOUND, dict(values))


def _heading_sigma_bound(scenario: Scenario, part: int, times_s: Sequence[float]) -> np.ndarray:
    """Return the bound of 1 sigma of the heading at some times, arcmin."""
    study = scenario.study
    environment = _environment(scenario, part)
    variants = scenario.keys(part)
    motion = add_turns(read_sways(variants.common), variants)
    if motion.turns or any(key in _CONSTANT_KEYS for key in study.drawn_keys):
        problem = _problem_with_priors(study, variants, environment, motion)
        return turning_heading_bound(times_s, problem) / ARCMIN
    sigma = heading_bound(
        times_s,
        place=environment.site.place,
        errors=environment.errors,
        disturbances=environment.disturbances,
        dt=1 / study.rate_hz,
        to_n=np.asarray(mean_attitude(still(motion))),
    )
    return sigma / ARCMIN


class ErrorSources(NamedTuple):
    """A problem of the bound, and the names of the sources that `heading_budget` lists."""

    problem: HeadingProblem
    names: tuple[str, ...]


def error_sources(study: Study) -> ErrorSources:
    """Return what limits the heading of a study of one variant.

    Of the motion only turns are taken: sways do not matter to the bound.

    Raises:
        InputError: see `information_bound`.
    """
    runtime.ensure_configured()
    _check_bound_applies(study)
    scenario = Scenario(study)
    variants, environment = scenario.keys(0), _environment(scenario, 0)
    motion = add_turns(still(read_sways(variants.common)), variants)
    problem = _problem_with_priors(study, variants, environment, motion)
    if not motion.turns:
        pose = np.asarray(mean_attitude(motion)), environment.site.place
        problem = replace(problem, motion=partial(_parked, *pose))
    drifts = increment_error_processes(environment.disturbances, problem.dt)
    quantised = [name for name, _ in _iter_quantisation(environment.errors)]
    names = ("gyro_noise", "accel_noise", *drifts, *quantised, *CONSTANT_SOURCES)
    return ErrorSources(replace(problem, longest_step_s=LONGEST_STEP_S), names)


CONSTANT_SOURCES = (
    *("gyro_bias", "accel_bias"),
    *("gyro_scale", "gyro_misalignment", "accel_scale", "accel_misalignment"),
)
"""The constant errors, in the order of `heading_budget`."""


def _parked(c: np.ndarray, place: Place, times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return C_b^n (n, 3, 3) and w_ib in b (n, 3), rad/s, of a base at rest."""
    rate = np.array([0.0, place.rate_n, place.rate_u]) @ c
    count = len(times_s)
    return np.broadcast_to(c, (count, 3, 3)), np.broadcast_to(rate, (count, 3))


def still(motion: Motion) -> Motion:
    """Return the mean angles of a motion, without sways."""
    pitch, roll, yaw = (s._replace(amplitude=0.0 * s.amplitude) for s in motion.angles)
    return Motion(pitch, roll, yaw)


def _environment(scenario: Scenario, part: int) -> Environment:
    environment = scenario.batch(part, range(1), blank=True).environment
    if not np.all(environment.errors.accel_noise):
        raise InputError("[sensors] accel_noise_ug: the information bound needs white noise")
    return environment


def _iter_quantisation(errors: SensorErrors) -> Iterator[tuple[str, tuple[Process, Any]]]:
    """Yield the processes of quantised increments: what the digits leave is carried on."""
    for name, quantum, entry in (
        ("gyro_quantisation", errors.gyro_quantum, (ANGLE, IN_B)),
        ("accel_quantisation", errors.accel_quantum, (VELOCITY, IN_B)),
    ):
        if quantum is not None and np.any(quantum):
            yield name, (rounding_process(np.asarray(quantum)), entry)


def _problem_with_priors(
    study: Study, variants: Variants, environment: Environment, motion: Motion
) -> HeadingProblem:
    """Return a base that turns, or sensors with drawn errors."""
    dt = 1 / study.rate_hz
    errors, disturbances = environment.errors, environment.disturbances
    laws = {} if study.drawn is None else study.drawn.laws

    def sigma_of(key: str) -> Any:
        if key in laws:
            return (laws[key].normal or (0.0, 0.0))[1]
        value = variants.common(key)
        if key not in _CONSTANT_KEYS:
            return value
        return np.abs(value) if motion.turns else 0.0

    def increment_errors(step: float) -> IncrementErrors:
        processes = read_disturbances(variants, 1 / step)
        present = increment_error_processes(processes, step).values()
        return (*present, *(process for _, process in _iter_quantisation(errors)))

    moves = (disturbances.surge, disturbances.shaking)
    longest_step = dt if any(process is not None for process in moves) else LONGEST_STEP_S
    sigmas = read_errors(sigma_of, variants.micro_g, study.rate_hz)
    periods = [float(sway.period) for sway in motion.angles if np.any(sway.amplitude)]
    per_period = max((longest_step / period for period in periods), default=0.0)
    return HeadingProblem(
        partial(_attitude_and_rate, motion, environment.site.place),
        place=environment.site.place,
        dt=dt,
        noise=WhiteNoise(errors.gyro_noise / np.sqrt(dt), errors.accel_noise / np.sqrt(dt)),
        constant=ConstantErrors(
            sigmas.gyro_bias, sigmas.accel_bias, sigmas.gyro_matrix, sigmas.accel_matrix
        ),
        increment_errors=increment_errors,
        longest_step_s=longest_step,
        nodes=int(np.ceil(MOTION_NODES * max(1.0, per_period))),
    )


def _attitude_and_rate(
    motion: Motion, place: Place, times_s: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return C_b^n (n, 3, 3) and w_ib in b (n, 3), rad/s, at times (n,), s."""
    padded = np.pad(times_s, (0, -len(times_s) % _TIMES), mode="edge").reshape(-1, _TIMES)
    blocks = [np.asarray(_evaluate_motion(motion, place, times)) for times in padded]
    rows = np.concatenate(blocks)[: len(times_s)]
    return rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]


@jax.jit
def _evaluate_motion(motion: Motion, place: Place, times: Array) -> Array:
    """Return C_b^n row by row and w_ib in b at times (n,), (n, 12)."""

    def at(t: Array) -> Array:
        rate, _ = rate_and_force(motion, place, t)
        entries = [entry for row in matrix(attitude(motion, t)) for entry in row]
        return jax.numpy.stack([*entries, *rate])

    return jax.vmap(at)(times)


def _check_bound_applies(study: Study) -> None:
    """Refuse a study for which the bound is unknown."""
    laws = {} if study.drawn is None else study.drawn.laws
    if study.is_recorded:
        raise InputError("[record]: the information bound needs the noise of a simulation")
    if study.passes:
        text = (
            "repeated passes add no information (drop [passes]; duration_s is the record's length)"
        )
        raise InputError(f"[passes]: {text}")
    for key in study.drawn_keys:
        if key in _CONSTANT_KEYS and laws[key].normal is None:
            text = "the information bound needs a fixed value or a normal distribution"
            raise InputError(f"[drawn] {key}: {text}")
        if key in ENVIRONMENT_KEYS and key not in _CONSTANT_KEYS:
            text = "the information bound needs a fixed value (sweep it instead of drawing it)"
            raise InputError(f"[{SECTION_OF[key]}] {key}: {text}")

"""Lower bound of the heading error of any method on the data of a study, in memory."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa

from sinsjax import columns
from sinsjax.bounds.information import (
    ACCEL,
    GYRO,
    LONGEST_STEP_S,
    MOTION_NODES,
    BaseMotion,
    HeadingProblem,
    IncrementError,
    IncrementErrors,
    coloured_errors,
    heading_bound,
    parked,
)
from sinsjax.engine.scenario import (
    ENVIRONMENT_KEYS,
    Scenario,
    read_errors,
    read_random_processes,
    read_rotation,
)
from sinsjax.errors import InputError
from sinsjax.maths.rotations import matrix
from sinsjax.methods.filters.keys import level_surge
from sinsjax.methods.floors import mean_attitude
from sinsjax.methods.gravity_fit.method import BLOCK_S, OVERLAP_S
from sinsjax.platform import runtime
from sinsjax.strapdown.base_motion import Motion, attitude, rate_and_force
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.processes import rounding_process
from sinsjax.strapdown.sensors import SensorErrors
from sinsjax.study.keys import SECTION_OF
from sinsjax.study.load import load_study
from sinsjax.study.schema import keys_acting_as
from sinsjax.study.study import Study
from sinsjax.types import Array
from sinsjax.units import ARCMIN, ARCSEC

_CONSTANT_KEYS = keys_acting_as("bias", "distortion")
"""Keys of the sensors' constant errors."""

_TIMES = 4096
"""Times per call of the motion: one program serves studies of any length."""

_COLUMNS = (
    columns.column("variant_id", "point of the study's axes", pa.int64()),
    columns.CURVES[1],
    columns.column("bound_u_arcmin", "least 1 sigma of phi_u of any unbiased estimator"),
)


def information_bound(study: Study | str | Path) -> pa.Table:
    """Return the information bound of a simulated study's heading.

    No unbiased method has a smaller standard deviation of the heading error, whatever its initial
    state; the settings of the study's methods have no influence. Variants with the same Earth,
    motion and sensors share a bound.

    On a base at rest with fixed sensor errors the bound is measured from the bias floor, see
    `bounds.information`; it takes about a second for 300 s at 100 Hz. It is measured from the true
    heading if biases, scale factors or cross-axis errors are drawn from a normal distribution,
    whose standard deviation is then the prior knowledge, and on a base that turns, where the
    absolute value of a fixed error counts as its standard deviation. This bound takes about 0.1 s
    for 300 s.

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
    codes = study.coded(*swept).codes if swept else np.zeros(study.n_variants, int)
    bounds: dict[tuple[int, float], list[tuple[float, float]]] = {}
    rows: list[tuple[int, float, float]] = []
    for program, ids in enumerate(scenario.variant_ids):
        base = int(codes[ids[0]]), float(ends[ids[0]])  # of all its variants
        if base not in bounds:
            times = sorted({*(t for t in study.report_times_s if t < base[1]), base[1]})
            sigmas = heading_bound(times, _heading_problem(scenario, program)) / ARCMIN
            bounds[base] = list(zip(times, sigmas, strict=True))
        rows += [(variant, *row) for variant in ids for row in bounds[base]]
    values = [pa.array(column) for column in zip(*sorted(rows), strict=True)]
    return pa.Table.from_arrays(values, schema=columns.arrow_schema(_COLUMNS))


def budget_problem(study: Study) -> HeadingProblem:
    """Return the problem of a study of one variant, whose heading is judged from the true one."""
    runtime.ensure_configured()
    _check_bound_applies(study)
    problem = _heading_problem(Scenario(study), 0, for_budget=True)
    keys = "lever_arm_m", "surge_m_per_s", "gyro_quantisation_arcsec", "accel_quantisation_um_per_s"
    given, surge, *quanta = (study.values(key)[0] for key in keys)
    arm, step = np.broadcast_to(given, 3), problem.longest_step_s
    if level_surge(surge):  # `kalman_surge` does not know the arm; the mean over all headings
        arms = np.outer([1, 1j], arm) / np.sqrt(2)
    else:  # it is an unknown of `gravity_fit`, which reads blocks
        level = np.hypot(arm[0], arm[1]) / np.sqrt(2)
        arms = np.diag([level, level, arm[2]])
        step = BLOCK_S if any(map(np.any, (arm, *quanta))) else step
        problem = _with_swing_by_rounded_rates(problem, arm, quanta[0])
    return replace(problem, lever_arms=arms[arms.any(axis=1)], longest_step_s=step)


def _with_swing_by_rounded_rates(problem: HeadingProblem, arm: Any, arcsec: Any) -> HeadingProblem:
    """Return a problem with the velocity that an arm makes of the rounding of angles.

    `gravity_fit` takes the swing of the arm from the turn in the overlap of two blocks, which errs
    by two remainders. The velocity is known to so much, not summed.
    """
    rate, arms = np.sqrt(2) * np.broadcast_to(arcsec, 3) * ARCSEC / OVERLAP_S, np.diag(arm)
    swing = np.sqrt(np.square(np.cross(arms, rate * np.eye(3)[:, None])).sum(axis=(0, 1)))
    if not swing.any():
        return problem
    error = IncrementError(rounding_process(swing), ACCEL, rounded=True)
    return replace(
        problem, increment_errors=lambda step: {**problem.increment_errors(step), "swing": error}
    )


def _heading_problem(
    scenario: Scenario, program: int, *, for_budget: bool = False
) -> HeadingProblem:
    """Return the base and the sensors of a program, for its bound or for a budget of it."""
    study = scenario.study
    environment = scenario.batch(program, range(1), blank=True).environment
    place, errors = environment.site.place, environment.errors
    if not np.all(errors.accel_noise):
        raise InputError("[sensors] accel_noise_ug: the information bound needs white noise")
    variants, dt = scenario.keys(program), 1 / study.rate_hz
    motion = read_rotation(variants)._replace(lever=None)
    draws_errors = any(key in _CONSTANT_KEYS for key in study.drawn_keys)
    still = not (for_budget or motion.turns or draws_errors)
    laws = {} if study.drawn is None else study.drawn.laws

    def sigma_of(key: str) -> Any:
        if key in laws:
            return (laws[key].normal or (0.0, 0.0))[1]
        value = variants.common(key)
        if key not in _CONSTANT_KEYS:
            return value
        return np.abs(value) if motion.turns else 0.0

    def increment_errors(step: float) -> IncrementErrors:
        coloured = coloured_errors(read_random_processes(variants, 1 / step), step)
        return coloured if still else {**coloured, **_rounding_errors(errors)}

    periods = [float(sway.period) for sway in motion.angles if np.any(sway.amplitude)]
    if still or not (periods or motion.turns):
        pitch, roll, yaw = (s._replace(amplitude=0.0 * s.amplitude) for s in motion.angles)
        moving = partial(parked, np.asarray(mean_attitude(Motion(pitch, roll, yaw))), place)
    else:
        moving = partial(_base_motion, motion, place)
    moves = (environment.disturbances.surge, environment.disturbances.shaking)
    by_samples = not for_budget and any(process is not None for process in moves)
    longest_step = dt if by_samples else LONGEST_STEP_S
    per_period = max((longest_step / period for period in periods), default=0.0)
    return HeadingProblem(
        moving,
        place=place,
        dt=dt,
        errors=read_errors(sigma_of, variants.micro_g, study.rate_hz),
        increment_errors=increment_errors,
        still=still,
        longest_step_s=longest_step,
        nodes=int(np.ceil(MOTION_NODES * max(1.0, per_period))),
    )


def _rounding_errors(errors: SensorErrors) -> IncrementErrors:
    """Return the errors of quantised increments: what the digits leave is carried on."""
    quanta = {
        "gyro_quantisation": (errors.gyro_quantum, GYRO),
        "accel_quantisation": (errors.accel_quantum, ACCEL),
    }
    return {
        name: IncrementError(rounding_process(np.asarray(quantum)), sensor, rounded=True)
        for name, (quantum, sensor) in quanta.items()
        if quantum is not None and np.any(quantum)
    }


def _base_motion(motion: Motion, place: Place, times_s: np.ndarray) -> BaseMotion:
    """Return the motion of a base that turns or sways."""
    padded = np.pad(times_s, (0, -len(times_s) % _TIMES), mode="edge").reshape(-1, _TIMES)
    blocks = [np.asarray(_evaluate_motion(motion, place, times)) for times in padded]
    rows = np.concatenate(blocks)[: len(times_s)]
    return BaseMotion(rows[:, :9].reshape(-1, 3, 3), rows[:, 9:])


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
        raise InputError("[passes]: repeated passes add no information (drop [passes])")
    for key in study.drawn_keys:
        text = "the information bound needs a fixed value"
        if key in _CONSTANT_KEYS and laws[key].normal is None:
            raise InputError(f"[drawn] {key}: {text} or a normal distribution")
        if key in ENVIRONMENT_KEYS and key not in _CONSTANT_KEYS:
            raise InputError(f"[{SECTION_OF[key]}] {key}: {text} (sweep it instead of drawing it)")

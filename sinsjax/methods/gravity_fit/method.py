"""The fit to the turn of gravity as a method: blocks of samples, and fits at some record times.

The samples of a block of about a second are summed in the body frame at its start. At a record
time the rotation and the velocity increment of the block are stored, 136 bytes per second of a run,
and when a fit is due all blocks so far are fitted, see `fit`: after 4, 8, 16, ...
blocks, at reported times and at the end. In between the gyros carry the attitude, without the
biases found.

The velocity of a lever arm is as noisy as the rate of a sample, but two attitudes show its mean.
With an arm blocks overlap by 0.1 s, in which the share of the next one in the sums grows, and meet
at the attitude after half of the turn in it.
"""

from collections.abc import Callable
from functools import partial
from operator import attrgetter
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.columns import column
from sinsjax.maths import rotations
from sinsjax.maths.algebra import dot, scale, select_tree
from sinsjax.methods import method
from sinsjax.methods.filters.keys import ACCEL_NOISE, GYRO_NOISE, level_surge
from sinsjax.methods.gravity_fit.fit import NUMBERS, Block, FitParams, Solution, combine, solve
from sinsjax.methods.gravity_fit.noise import Drift, SensorNoise
from sinsjax.types import Array, Count, Flag, Navigation, Quat, Sample, Scalar, Vec3
from sinsjax.units import DEG_PER_H, si_factor
from sinsjax.value_types import (
    AccelNoise,
    AccelSigma,
    GyroSigma,
    GyroWalk,
    KeyInfo,
    NonNegative,
    Section,
    key_field,
)

BLOCK_S, LONGEST_BLOCK_S = 1.0, 2.0
OVERLAP_S = 0.1  # of blocks with a lever arm
LEAST_BLOCKS = 4
"""Blocks of the first fit; the next have twice as many each, and cost as much as the last alone."""

REFITS = (
    "gravity_fit refits after about 4, 8, 16, ... s, at report_times_s and at the end: only then"
    " can it settle (7, 15, 31, ... s)"
)
"""What its settling times are worth."""


class Sums(NamedTuple):
    """Sums over the samples of a block, in b at its beginning."""

    turn: Quat  # rotation of the body since then, at the beginnings and ends of samples
    dv: Vec3  # velocity increments, m/s


class FitState(NamedTuple):
    """A run between two samples."""

    nav: Navigation  # initial solution, whose attitude is the result before the first sample
    turn: Quat  # rotation of the body since the block began
    sums: Sums
    # With a lever arm: the rotation up to the samples that the next block shares, and its sums
    overlap: tuple[Quat, Sums] | None
    earth: Vec3  # rotation rate of the Earth in n, rad/s
    count: Scalar  # samples so far
    blocks: Array  # (most, `NUMBERS`) ended blocks, each a `Block`
    solution: Solution  # of the last fit, carried to the beginning of the block


def build(options: method.Options) -> method.Program:
    """Return the method; its params are `FitParams`."""
    record_s = options.record_every * options.dt
    records = max(1, round(BLOCK_S / record_s)) if record_s else 1
    length_s = records * record_s
    most = options.records // records
    shared = max(1, round(OVERLAP_S / options.dt))

    def init(params: FitParams, nav: Navigation) -> FitState:
        zero = jnp.zeros_like(nav.ve)
        one, still = Quat(zero + 1, zero, zero, zero), Vec3(zero, zero, zero)
        nothing = Sums(Quat(zero, *still), still)
        blank = jnp.zeros((most, NUMBERS)) + zero
        solution = Solution.of_unknown_attitude(params, zero)
        overlap = None if params.lever_arm is None else (one, nothing)
        return FitState(nav, one, nothing, overlap, still, zero, blank, solution)

    def add_sample_to_block(
        params: Any, site: method.Site, state: FitState, sample: Sample, n: Scalar
    ) -> FitState:
        turn, overlap = rotations.multiply(state.turn, sample.turn), state.overlap
        twice = jax.tree.map(jnp.add, state.turn, turn)
        gained = Sums(twice, rotations.rotate(state.turn, sample.dv))
        zero, share = jnp.zeros_like(n), 0.0
        earth = Vec3(zero, zero + site.place.rate_n, zero + site.place.rate_u)
        if overlap is not None:
            left = jnp.mod(-n, records * options.record_every)  # samples of the block
            share = jnp.maximum(0.0, 1 - (left + 0.5) / shared)
            begin = select_tree(left >= shared, turn, overlap[0])
            overlap = begin, jax.tree.map(lambda a, b: a + share * b, overlap[1], gained)
        sums = jax.tree.map(lambda a, b: a + (1 - share) * b, state.sums, gained)
        return state._replace(turn=turn, sums=sums, overlap=overlap, earth=earth, count=n)

    def store(state: FitState, interval: Count) -> FitState:
        ends, solution, overlap = (interval + 1) % records == 0, state.solution, state.overlap
        nothing = jax.tree.map(jnp.zeros_like, state.sums)
        one = nothing.turn._replace(w=jnp.ones_like(state.count))
        turn, rate, begun = state.turn, nothing.dv, (one, nothing, overlap)
        if overlap is not None:
            begin, later = overlap
            over = rotations.multiply(rotations.conjugate(begin), turn)
            half = rotations.exp(scale(0.5, rotations.log(over)))
            turn = rotations.multiply(turn, rotations.conjugate(half))
            rate = scale(2 / (shared * options.dt), Vec3(*over[1:]))
            to_end = rotations.conjugate(turn)
            later = Sums(rotations.multiply(to_end, later.turn), rotations.rotate(to_end, later.dv))
            begun = half, later, (half, nothing)
        mean = rotations.normalise(state.sums.turn)
        block = Block.of_turn(rotations.normalise(turn), state.sums.dv, rate, mean)
        place = jnp.minimum(interval // records, most - 1)
        blocks = jax.lax.dynamic_update_index_in_dim(state.blocks, block.row(), place, 0)
        errors = block.rotations_by_gyro_errors(len(solution.gyro), length_s)
        corrected = block.turn_without(combine(errors, solution.gyro))
        carried = rotations.normalise(rotations.multiply(solution.carried, corrected))
        so_far = state.turn, state.sums, overlap, solution.carried
        turn, sums, overlap, carried = select_tree(ends, (*begun, carried), so_far)
        solution = solution._replace(carried=carried)
        state = state._replace(turn=turn, sums=sums, overlap=overlap)
        return state._replace(blocks=blocks, solution=solution)

    def is_due(interval: Count, reported: Flag) -> Flag:
        ended, rest = (interval + 1) // records, (interval + 1) % records
        doubled = (ended & (ended - 1) == 0) & (rest == 0)  # 4, 8, 16, ...
        last = interval + 1 == options.records
        return (doubled | reported | last) & (ended >= LEAST_BLOCKS)

    def fit(params: FitParams, site: method.Site, state: FitState, interval: Count) -> Solution:
        return solve(params, site.place, state.blocks, (interval + 1) // records, length_s)

    def turn_of_n(state: FitState) -> Quat:
        """Return C_{n0}^n."""
        early = 0.5 * shared if state.overlap else 0.0  # by which overlapping blocks begin
        return rotations.exp(scale(-(state.count + early) * options.dt, state.earth))

    def attitude(state: FitState) -> Quat:
        body = rotations.multiply(state.solution.carried, state.turn)
        in_n0 = rotations.multiply(state.solution.attitude, body)
        q = rotations.multiply(turn_of_n(state), in_n0)
        return select_tree(state.count > 0, q, state.nav.q)

    def covariance(state: FitState) -> method.AttitudeCovariance:
        ee, en, eu, nn, nu, uu = state.solution.covariance
        rows = rotations.matrix(turn_of_n(state))
        turned = [
            Vec3(dot(row, Vec3(ee, en, eu)), dot(row, Vec3(en, nn, nu)), dot(row, Vec3(eu, nu, uu)))
            for row in rows
        ]
        return method.AttitudeCovariance(
            *(dot(turned[i], rows[k]) for i in range(3) for k in range(i, 3))
        )

    def normalise(state: FitState) -> FitState:
        return method.normalise_solution(state)._replace(turn=rotations.normalise(state.turn))

    return method.Program(
        init=init,
        step=add_sample_to_block,
        attitude=attitude,
        covariance=covariance,
        normalise=normalise,
        floor=None,
        results=lambda site, state: state.solution,
        block_fit=method.BlockFit(
            store,
            is_due,
            fit,
            previous=lambda state: state.solution,
            merge=lambda state, solution: state._replace(solution=solution),
        ),
    )


def _believed(meaning: str, default: str = "that of [sensors] or [drawn]") -> Any:
    return key_field(meaning, otherwise=default)


class GravityFitSection(Section):
    """[gravity_fit]: assumed sensor errors; biases and noise are required with a record."""

    fit_gyro_bias_deg_per_h: GyroSigma | None = _believed("1 sigma of each gyro's bias")
    fit_gyro_arw_deg_per_sqrt_h: GyroWalk | None = _believed(
        "angle random walk of each gyro, above 0", "the white noise of [sensors]"
    )
    fit_gyro_scale_ppm: Annotated[NonNegative, KeyInfo(usual_range=(0, 1e6))] | None = _believed(
        "1 sigma of each gyro's scale factor error"
    )
    fit_gyro_misalignment_arcsec: Annotated[NonNegative, KeyInfo(usual_range=(0, 1e5))] | None = (
        _believed("1 sigma of each cross-axis error of the gyros")
    )
    fit_lever_arm_m: Annotated[NonNegative, KeyInfo(usual_range=(0, 1e3))] | None = _believed(
        "1 sigma per axis of the lever arm from the turn axis; 0 on the axis", "that of [motion]"
    )
    fit_accel_bias_ug: AccelSigma | None = _believed("1 sigma of each accelerometer's bias")
    fit_accel_vrw_ug_per_sqrt_hz: AccelNoise | None = _believed(
        "velocity random walk of each accelerometer, above 0", "the white noise of [sensors]"
    )


_NOISE = {
    "fit_gyro_arw_deg_per_sqrt_h": GYRO_NOISE,
    "fit_accel_vrw_ug_per_sqrt_hz": ACCEL_NOISE,
}
"""The keys of white noise, and the sensors' own."""


def params(keys: method.StudyKeys, xp: Any) -> FitParams:
    """Return `FitParams`, leaves (variants,)."""
    # A record has no [sensors]: the rules require what it must give itself.
    zero, simulated = np.zeros(keys.count), keys.has("sensors")

    def given_or(default: Any, key: str) -> Any:
        given = keys.si(key)
        return np.where(np.isnan(given), default, given) if isinstance(given, np.ndarray) else given

    def size(key: str) -> Any:
        return keys.rms(key) * si_factor(key, keys.micro_g) if simulated else zero

    def believed(key: str) -> Any:
        return given_or(size(key), f"fit_{key}")

    def white(key: str) -> Any:
        noise, own = _NOISE[key], zero
        if simulated:
            own = keys.compute(partial(noise.density, keys.rate_hz), *noise.white)
        return given_or(own * si_factor(noise.key, keys.micro_g), key)

    def drifts(sensor: str, unit: str) -> tuple[Drift, ...]:
        variance = size(f"{sensor}_instability_{unit}") ** 2
        density = size(f"{sensor}_rrw_{unit}_per_sqrt_h") ** 2
        found = []
        if variance.any():
            found += [Drift(variance, 1 / keys.column(f"{sensor}_instability_time_s"), zero)]
        if density.any():
            found += [Drift(zero, zero, density)]
        return tuple(found)

    scale, cross = believed("gyro_scale_ppm"), believed("gyro_misalignment_arcsec")
    lever = believed("lever_arm_m")
    # On a level base the reaction to gravity makes a bias of the axes' errors.
    tilted = size("accel_misalignment_arcsec") * keys.site.place.gravity
    surge = keys.compute(level_surge, "surge_m_per_s") if simulated else zero
    has_scale = _is_given(scale) or _is_given(cross)
    return FitParams(
        noise=SensorNoise(
            gyro=white("fit_gyro_arw_deg_per_sqrt_h"),
            accel=white("fit_accel_vrw_ug_per_sqrt_hz"),
            gyro_drifts=drifts("gyro", "deg_per_h"),
            accel_drifts=drifts("accel", "ug"),
            surge=Drift(surge**2, 1 / keys.column("surge_time_s"), zero) if surge.any() else None,
        ),
        gyro_bias=believed("gyro_bias_deg_per_h"),
        accel_bias=xp.hypot(believed("accel_bias_ug"), tilted),
        scale_factor=scale if has_scale else None,
        cross_axis=cross if has_scale else None,
        lever_arm=lever if _is_given(lever) else None,
    )


def _is_given(sigma: Any) -> bool:
    """Return whether an error is an unknown: some sigma is not 0, or it is tuned."""
    return not isinstance(sigma, np.ndarray) or bool(sigma.any())


def _column(name: str, meaning: str, read: Callable[[Solution], Any]) -> method.OwnColumn:
    return method.OwnColumn(
        column(f"fit_{name}", meaning), lambda results, rate_hz: np.asarray(read(results))
    )


def _bias_deg_per_h(axis: int, found: Solution) -> Any:
    return np.asarray(found.gyro[0][axis]) / DEG_PER_H


def _bias_sigma_deg_per_h(axis: int, found: Solution) -> Any:
    return np.sqrt(np.asarray(found.gyro_bias_variance[axis])) / DEG_PER_H


_DOUBTS = {
    "misfit": "root mean square of the fit's residuals over their sigma; 1 is expected, more than 3"
    " is a doubt",
    "prior_ratio": "largest sensor error or lever arm that the fit finds, over its 1 sigma in"
    " [gravity_fit]; more than 3 is a doubt",
    "change": "change of the unknowns in the last pass of the fit, in sigma; more than 1 is a"
    " doubt, the fit has not converged",
}

COLUMNS = (
    *(_column(name, meaning, attrgetter(name)) for name, meaning in _DOUBTS.items()),
    *(
        _column(f"gyro_bias_{name}{suffix}_deg_per_h", meaning.format(name), partial(read, axis))
        for suffix, meaning, read in (
            ("", "gyro bias of the {} axis by the fit", _bias_deg_per_h),
            ("_sigma", "1 sigma of it", _bias_sigma_deg_per_h),
        )
        for axis, name in enumerate(("right", "front", "up"))
    ),
)


def _refuse_long_blocks_or_missing_noise(study: method.StudyKeys) -> None:
    """Refuse long blocks, records without beliefs about sensors, sensors without white noise."""
    required = ("fit_gyro_bias_deg_per_h", "fit_accel_bias_ug", *_NOISE)
    simulated = (*_NOISE, *(key for noise in _NOISE.values() for key in noise.white))
    for point in study.combinations("method", *(required if study.is_recorded else simulated)):
        if point["method"] != "gravity_fit":
            continue
        if study.record_interval_s > LONGEST_BLOCK_S:
            text = f"gravity_fit needs at most {LONGEST_BLOCK_S:g} s (its blocks are as long)"
            study.refuse("record_interval_s", text)
        for key in required if study.is_recorded else ():
            if point[key] is None:
                study.refuse(key, "required with a record (from the sensors' data sheet)")
        for key, noise in _NOISE.items():
            density = point[key]
            if density is None:
                density = noise.density(study.rate_hz, *(point[name] for name in noise.white))
            if not density:
                text = "must be above 0: gravity_fit weights its data by the noise"
                study.refuse(key, f"{text} (give it, or white noise in [sensors])")


GRAVITY_FIT = method.Method(
    name="gravity_fit",
    summary="least squares of the turn of gravity with the sensor biases as unknowns: for a base"
    " that is turned",
    source="`methods.gravity_fit.fit`",
    sections={"gravity_fit": GravityFitSection},
    build=build,
    params=params,
    needs_start=False,
    turning="any",
    rules=(_refuse_long_blocks_or_missing_noise,),
    columns=COLUMNS,
    step_s=10e-9,
    compile_s=8.5,
)

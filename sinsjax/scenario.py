"""From a study to arrays: the one place where units are left behind and programs part from numbers.

A `Part` holds the variants that share a compiled program and a world (Earth, base motion, sensors);
within a part everything that differs is a number. Parts are cut from the study's variants by the
values of `PROGRAM_KEYS` and `WORLD_KEYS`, wherever these are swept.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from sinsjax import earth, imu, trajectory, units
from sinsjax.alignment import zero_velocity
from sinsjax.alignment.base import Options, Site
COARSE = {}  # tmp
from sinsjax.alignment.schedules import Feedback, Resets
from sinsjax.batch import Group
from sinsjax.columns import bands
from sinsjax.error_model import MODELS
from sinsjax.metrics import Criteria
from sinsjax.records import Record, Reference, require_span
from sinsjax.rotations import from_euler, log
from sinsjax.sections import Earth, Motion, Sensors
from sinsjax.simulate import Draw, Params, Static, World
from sinsjax.studies import EARTH_CONSTANTS, Study
from sinsjax.types import Array, InputError, Quat, Vec3
from sinsjax.units import ARCMIN, ARCSEC, DEG, DEG_PER_H, DEG_PER_SQRT_H, PPM

PROGRAM_KEYS = ("method", "specific_force", "position")
"""Keys whose values decide the compiled program."""

WORLD_KEYS = tuple(key for model in (Earth, Motion, Sensors) for key in model.model_fields)
"""Keys whose values decide the truth that runs share."""

_RESET_KINDS = {
    # keep, keep_yaw, renew, renew_yaw
    "full": (0.0, 0.0, 1.0, 1.0),
    "yaw": (1.0, 0.0, 0.0, 1.0),
    "scale": (None, None, 0.0, 0.0),
}


class Part(NamedTuple):
    """Variants of a study that run together.

    Attributes:
        group: what the engine runs.
        variant_ids: (variants,) their numbers in the study.
    """

    group: Group
    variant_ids: np.ndarray


class Tape(NamedTuple):
    """A record made ready for the engine.

    Attributes:
        record: increments.
        reference: attitude to compare with, or None.
    """

    record: Record
    reference: Reference | None


class _Variants:
    """Columns of a study's sweepable keys, for some of its variants."""

    def __init__(self, study: Study, ids: np.ndarray | None = None) -> None:
        self._study = study
        self.ids = np.arange(study.n_variants) if ids is None else ids

    def raw(self, key: str) -> list[Any]:
        """Values of one key, in the file's units."""
        values = self._study.values(key)
        return [values[i] for i in self.ids]

    def column(self, key: str, factor: float = 1.0) -> np.ndarray:
        """Values of a numeric key times a factor, (variants,)."""
        return np.asarray(self.raw(key), dtype=float) * factor

    def common(self, key: str) -> Any:
        """The one value of a key that does not differ between these variants."""
        return self._study.values(key)[self.ids[0]]


def parts(study: Study, tape: Tape | None = None, *, curves: bool | None = None) -> list[Part]:
    """What the engine runs for a study.

    Args:
        study: checked study.
        tape: the record of a recorded study, else None.
        curves: whether curves are returned; None takes the study's word.

    Raises:
        InputError: a record that does not fit the study.
    """
    if study.is_recorded != (tape is not None):
        kind = "a recorded" if study.is_recorded else "a simulated"
        raise InputError(f"{study.study.name}: {kind} study cannot run here: see [record]")
    keep_curves = study.study.curves if curves is None else curves
    return [_part(study, _Variants(study, ids), tape, keep_curves) for ids in _split(study)]


def record_times(study: Study) -> np.ndarray:
    """(records,) times of the study's records from the start of fine alignment, s."""
    every, records = _record_counts(study)
    return np.arange(1, records + 1) * every / study.study.rate_hz


def dropped_s(study: Study) -> float:
    """Length of the last partial record interval, which is not run, s."""
    every, records = _record_counts(study)
    return max(0.0, study.study.duration_s - records * every / study.study.rate_hz)


def _record_counts(study: Study) -> tuple[int, int]:
    """Samples a record interval, and whole record intervals in the study."""
    every = round(study.study.record_interval_s * study.study.rate_hz)
    samples = int(np.floor(study.study.duration_s * study.study.rate_hz * (1 + 1e-12) + 1e-9))
    return every, samples // every


def _split(study: Study) -> Iterator[np.ndarray]:
    """Numbers of the variants that share program and world, in order of first appearance."""
    swept = [key for key in study.axis_keys if key in (*PROGRAM_KEYS, *WORLD_KEYS)]
    columns = [study.values(key) for key in swept]
    groups: dict[tuple[Any, ...], list[int]] = {}
    for i in range(study.n_variants):
        groups.setdefault(tuple(column[i] for column in columns), []).append(i)
    yield from (np.asarray(ids) for ids in groups.values())


def _part(study: Study, variants: _Variants, tape: Tape | None, curves: bool) -> Part:
    every, records = _record_counts(study)
    options = Options(
        dt=1 / study.study.rate_hz,
        specific_force=variants.common("specific_force"),
        position=variants.common("position"),
    )
    static = Static(variants.common("method"), options, every, records, curves)
    site, ug = _site(study, variants, tape)
    criteria = Criteria(
        bands=np.asarray(bands(study.study.settle_bands_arcmin)) * ARCMIN,
        window_start=np.float64(study.study.window_s[0]),
        window_end=np.float64(study.study.window_s[1]),
        consistency_after=np.float64(study.study.consistency_after_s),
        steady_after=np.float64(study.study.steady_after_s),
    )
    if tape is None:
        world, draws, q = _simulated(study, variants, site, criteria, ug)
    else:
        world, draws, q = _recorded(study, tape, site, criteria)
    group = Group(static, world, draws, q, _params(study, variants, ug))
    return Part(group, variants.ids)


def _site(study: Study, variants: _Variants, tape: Tape | None) -> tuple[Site, float]:
    """The Earth and place of a part, and its ug in m/s^2."""
    height = variants.common("height_m")
    if variants.common("earth") == "wgs84":
        model, ug = earth.wgs84(height), units.micro_g()
    else:
        constants = {
            key: default if (value := variants.common(key)) is None else value
            for key, default in EARTH_CONSTANTS.items()
        }
        gravity = constants["gravity_m_per_s2"]
        rate = constants["earth_rate_deg_per_h"] * DEG_PER_H
        model = earth.sphere(rate, constants["radius_m"], gravity, height)
        ug = units.micro_g(gravity)
    latitude = variants.common("latitude_deg")
    if latitude is None and tape is not None:
        latitude = tape.record.latitude_deg
    if latitude is None:
        source = tape.record.source if tape else study.study.name
        raise InputError(f"{source}: no latitude in the record: give [earth] latitude_deg")
    place = earth.place(model, latitude * DEG)
    site = Site(model, place, latitude * DEG)
    return jax.tree.map(np.float64, site), ug


def _simulated(
    study: Study, variants: _Variants, site: Site, criteria: Criteria, ug: float
) -> tuple[World, Draw, np.ndarray]:
    """World, draws and their true starting attitudes of a simulated part."""
    every, records = _record_counts(study)
    motion = _motion(variants)
    errors = _errors(variants, ug, study.study.rate_hz)
    ideal = jax.jit(trajectory.increments, static_argnums=3)
    truth = jax.vmap(lambda t: jnp.stack(trajectory.attitude(motion, t)))
    center = trajectory.attitude(
        trajectory.Motion(*(sway._replace(amplitude=0.0) for sway in motion)), 0.0
    )
    n = study.n_draws
    world = World(
        site=site,
        tape=np.asarray(ideal(motion, site.place, study.study.rate_hz, every * records)),
        truth=np.asarray(truth(record_times(study)))[None],
        errors=errors,
        seed=np.asarray(study.study.seed),
        criteria=criteria,
        floor=_floor(errors, center, site),
    )
    draws = Draw(np.arange(n), np.zeros(n, int), np.zeros(n, int))
    start = np.asarray(jnp.stack(trajectory.attitude(motion, 0.0)))
    return world, draws, np.tile(start, (n, 1))


def _floor(errors: imu.SensorErrors, center: Quat, site: Site) -> np.ndarray:
    """Limit of phi_u for constant biases, -eps_E/omega_N + (nabla_E/g) tan L, rad."""
    c = Rotation.from_quat(np.asarray(center, dtype=float), scalar_first=True)
    eps, nabla = c.apply(errors.gyro_bias), c.apply(errors.accel_bias)
    place = site.place
    return np.asarray(
        -eps[0] / place.rate_n + nabla[0] / place.gravity * place.tan_latitude, dtype=float
    )


def _motion(variants: _Variants) -> trajectory.Motion:
    def sway(angle: str) -> trajectory.Sway:
        return trajectory.Sway(
            center=np.float64(variants.common(f"{angle}_center_deg") * DEG),
            amplitude=np.float64(variants.common(f"{angle}_amplitude_deg") * DEG),
            period=np.float64(variants.common(f"{angle}_period_s")),
            phase=np.float64(variants.common(f"{angle}_phase_deg") * DEG),
        )

    return trajectory.Motion(sway("pitch"), sway("roll"), sway("yaw"))


def _errors(variants: _Variants, ug: float, rate_hz: float) -> imu.SensorErrors:
    dt = 1 / rate_hz

    def vector(key: str, factor: float) -> np.ndarray:
        return np.broadcast_to(np.asarray(variants.common(key), float) * factor, 3).copy()

    def noise(per_sample: str, density: str, units_: tuple[float, float]) -> np.ndarray:
        # A rate's standard deviation a sample integrates to dt times it; a density to sqrt(dt).
        if variants.common(density) is not None:
            return vector(density, units_[1] * np.sqrt(dt))
        if variants.common(per_sample) is not None:
            return vector(per_sample, units_[0] * dt)
        return np.zeros(3)

    def matrix(scale: str, cross: str) -> np.ndarray:
        out = np.diag(vector(scale, PPM))
        angles = np.broadcast_to(np.asarray(variants.common(cross), float) * ARCSEC, 6)
        out[~np.eye(3, dtype=bool)] = angles
        return out

    return imu.SensorErrors(
        gyro_bias=vector("gyro_bias_deg_per_h", DEG_PER_H),
        accel_bias=vector("accel_bias_ug", ug),
        gyro_noise=noise(
            "gyro_noise_deg_per_h", "gyro_arw_deg_per_sqrt_h", (DEG_PER_H, DEG_PER_SQRT_H)
        ),
        accel_noise=noise("accel_noise_ug", "accel_vrw_ug_per_sqrt_hz", (ug, ug)),
        gyro_matrix=matrix("gyro_scale_ppm", "gyro_misalignment_arcsec"),
        accel_matrix=matrix("accel_scale_ppm", "accel_misalignment_arcsec"),
    )


def _recorded(
    study: Study, tape: Tape, site: Site, criteria: Criteria
) -> tuple[World, Draw, np.ndarray]:
    """World, draws (one a start time) and coarsely aligned attitudes of a recorded part."""
    assert study.record is not None and study.coarse is not None
    record, rate = tape.record, study.study.rate_hz
    if abs(record.rate_hz - rate) > 1e-6 * rate:
        raise InputError(
            f"{record.source}: the record has {record.rate_hz:g} Hz, [study] rate_hz is {rate:g}"
        )
    every, records = _record_counts(study)
    coarse_n = round(study.coarse.coarse_duration_s * rate)
    starts = np.round(np.asarray(study.record.start_s) * rate).astype(int)
    for start in study.record.start_s:
        require_span(record, start, (coarse_n + every * records) / rate)
    increments = np.concatenate([record.dtheta, record.dv], axis=1)
    align = jax.jit(COARSE[study.coarse.coarse_method])
    pieces = np.stack([increments[s : s + coarse_n] for s in starts])
    samples = jax.vmap(imu.compensate)(pieces, pieces[:, 0])
    q = jax.vmap(lambda s: jnp.stack(align(s, site.place, 1 / rate)))(samples)
    fine = starts + coarse_n
    truth = np.stack([_reference_at(tape, s / rate + record_times(study)) for s in fine])
    world = World(
        site=site,
        tape=increments,
        truth=truth,
        errors=imu.perfect(),
        seed=np.asarray(study.study.seed),
        criteria=criteria,
        floor=np.float64(0.0),
    )
    n = len(starts)
    return world, Draw(np.arange(n), fine, np.arange(n)), np.asarray(q)


def _reference_at(tape: Tape, times: np.ndarray) -> np.ndarray:
    """(n, 4) reference attitude at times from the record's start; NaN without a reference."""
    reference = tape.reference
    if reference is None:
        return np.full((len(times), 4), np.nan)
    first, last = reference.time_s[0], reference.time_s[-1]
    slack = 1e-6 + 1 / tape.record.rate_hz
    if times[0] < first - slack or times[-1] > last + slack:
        raise InputError(
            f"the reference covers {first:g} to {last:g} s,"
            f" but the study needs {times[0]:g} to {times[-1]:g} s of {tape.record.source}"
        )
    pitch, roll, yaw = reference.attitude_deg.T
    attitudes = Rotation.from_euler("ZXY", np.column_stack([yaw, pitch, roll]), degrees=True)
    return Slerp(reference.time_s, attitudes)(np.clip(times, first, last)).as_quat(
        scalar_first=True
    )


def _params(study: Study, variants: _Variants, ug: float) -> Params:
    """Numbers of the part's variants, leaves (variants, ...)."""
    states = len(MODELS[variants.common("method")].states)
    dt = 1 / study.study.rate_hz
    velocity = variants.column("p0_velocity_m_per_s") ** 2
    level = variants.column("p0_level_deg", DEG) ** 2
    yaw = variants.column("p0_yaw_deg", DEG) ** 2
    nabla = variants.column("p0_accel_bias_ug", ug) ** 2
    eps = variants.column("p0_gyro_bias_deg_per_h", DEG_PER_H) ** 2
    readings = {"per_step": 1.0, "psd": dt, "per_sample": dt * dt}
    reading = np.asarray([readings[name] for name in variants.raw("q_reading")])
    q_v = variants.column("q_accel_ug", ug) ** 2 * reading
    q_phi = variants.column("q_gyro_deg_per_h", DEG_PER_H) ** 2 * reading
    per_update = np.asarray([1 if r == "per_update" else dt for r in variants.raw("r_reading")])
    zero = np.zeros_like(velocity)
    method = zero_velocity.Params(
        p0=(velocity, velocity, level, level, yaw, nabla, nabla, eps, eps, eps)[:states],
        q=(q_v, q_v, q_phi, q_phi, q_phi, *(zero,) * 5)[:states],
        r=variants.column("r_velocity_m_per_s") ** 2 / per_update,
        feedback=_feedback(variants, study.study.rate_hz),
        resets=_resets(study, variants),
    )
    return Params(
        q=Quat(zero, zero, zero, zero),
        phi=_misalignment(variants),
        ve=variants.column("ve0_m_per_s"),
        vn=variants.column("vn0_m_per_s"),
        method=method,
    )


def _misalignment(variants: _Variants) -> Vec3:
    e, n, u = (variants.column(f"phi_{axis}0_deg", DEG) for axis in "enu")
    euler = np.asarray(variants.raw("misalignment")) == "euler"
    # [P1] section 1: angles from the ideal to the computed frame, about U, E, N in turn.
    vector = log(from_euler(pitch=e, roll=n, yaw=u))
    return Vec3(
        *(np.where(euler, v, a) for v, a in zip(vector, (e, n, u), strict=True))
    )


def _feedback(variants: _Variants, rate_hz: float) -> Feedback:
    interval = variants.column("feedback_interval_s")
    constant = variants.column("feedback_time_constant_s")
    partial = constant > 0
    gain = np.where(partial, -np.expm1(-interval / np.where(partial, constant, 1.0)), 1.0)
    return Feedback(np.round(interval * rate_hz), gain)


def reset_times(study: Study) -> list[tuple[float, ...]]:
    """Reset times of every variant, s."""
    counts, cycles = study.values("reset_count"), study.values("reset_cycle_s")
    return [
        tuple(times) if times is not None else tuple((i + 1) * cycle for i in range(count or 0))
        for times, count, cycle in zip(
            study.values("reset_times_s"), counts, cycles, strict=True
        )
    ]


def _resets(study: Study, variants: _Variants) -> Resets:
    times: Sequence[tuple[float, ...]] = reset_times(study)
    width = max(map(len, times))
    samples = np.full((len(variants.ids), width), np.inf)
    for row, i in enumerate(variants.ids):
        samples[row, : len(times[i])] = np.round(np.asarray(times[i]) * study.study.rate_hz)
    kinds = zip(variants.raw("reset_kind"), variants.raw("reset_scale"), strict=True)
    numbers = [[s if v is None else v for v in _RESET_KINDS[kind]] for kind, s in kinds]
    return Resets(samples, *np.asarray(numbers, dtype=float).T)

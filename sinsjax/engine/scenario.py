"""From a study to arrays in SI units: the one module of the engine that knows studies.

A study's variants are split into programs by the values of `PROGRAM_KEYS`, `ENVIRONMENT_KEYS` and
`PASS_KEYS`: those of a program share its compiled code and its environment (Earth, motion of the
base, sensors), and all differences between them are numbers. A `Scenario` makes the `batch.Batch`
of each program on demand.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np

from sinsjax import units
from sinsjax.engine.batch import Batch
from sinsjax.engine.inputs import (
    CoarseStage,
    Draw,
    Environment,
    ProgramSpec,
    RunParams,
    aligned_record,
    coarse_attitudes,
    true_attitudes,
    true_increments,
)
from sinsjax.engine.metrics import Criteria
from sinsjax.errors import InputError
from sinsjax.maths.rotations import euler_vector
from sinsjax.methods.floors import NO_BIASES, mean_biases
from sinsjax.methods.method import Options, Site
from sinsjax.methods.registry import METHODS
from sinsjax.platform import runtime
from sinsjax.records import require_samples
from sinsjax.records.reference import StoredRecord, reference_attitudes
from sinsjax.strapdown import earth, processes, sensors
from sinsjax.strapdown.base_motion import Motion, Sway, attitude_path
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.strapdown.processes import Process
from sinsjax.strapdown.sensors import SensorErrors
from sinsjax.strapdown.turns import Turns
from sinsjax.study.keys import COARSE_KEYS, PASS_KEYS
from sinsjax.study.load import load_study, with_rate
from sinsjax.study.motion import data_end_s, read_attitude_file, turns_in_samples
from sinsjax.study.schema import (
    EARTH_CONSTANTS,
    TURN_KEYS,
    EarthSection,
    MotionSection,
    SensorsSection,
    keys_acting_as,
)
from sinsjax.study.study import Span, Study
from sinsjax.study.success import settling_bands
from sinsjax.study.sweep import CodedColumn
from sinsjax.study.values import Lookup, Variants, drawn_values
from sinsjax.types import Quat, Vec3
from sinsjax.units import ARCMIN, DEG, DEG_PER_H
from sinsjax.value_types import Section

PROGRAM_KEYS = ("method", "specific_force", "position", "reset_trigger", *COARSE_KEYS)
"""Keys whose values decide the compiled program."""

ENVIRONMENT_KEYS = tuple(
    key for model in (EarthSection, MotionSection, SensorsSection) for key in model.model_fields
)
"""Keys whose values decide the environment."""

MOST_STORED_SAMPLES = 2**22
"""Samples of the longest simulated record that is stored, 200 MB; more are made as runs proceed."""

NOMINAL_LATITUDE_DEG = 45.0
"""Replaces a drawn latitude where one is needed for all draws: in the gains of compass loops, which
depend on it by gravity and radius alone, 0.3 % on an ellipsoid."""

StudySource: TypeAlias = Study | str | Path
"""A study, its file, or the name of a shipped study."""

_NEVER_S = 1e12  # beginning of a turn after every run


class Scenario:
    """A study ready to be run: the runs of its programs, each made on demand.

    Attributes:
        study: checked study.
        stored: the record of a recorded study, else None.
        curves: whether curves are returned.
        variant_ids: numbers of the variants of each program.
    """

    def __init__(
        self,
        study: StudySource,
        stored: StoredRecord | None = None,
        *,
        curves: bool | None = None,
    ) -> None:
        """Check all that can be checked before any run.

        Args:
            study: study, its file, or the name of a shipped study.
            stored: the record of a recorded study, else None.
            curves: whether curves are returned; None for what the study asks.

        Raises:
            InputError: a record is missing or not needed, or double precision cannot be enabled
                (`runtime.ensure_configured`).
        """
        runtime.ensure_configured()
        study = study if isinstance(study, Study) else load_study(study)
        if study.is_recorded and stored is not None:
            study = with_rate(study, stored.record.rate_hz)
        if study.is_recorded != (stored is not None):
            text = "reads a record, none is given" if study.is_recorded else "reads no record"
            raise InputError(f"{study.name}: the study {text}: see [record]")
        self.study, self.stored = study, stored
        self.curves = study.study.curves if curves is None else curves
        self.variant_ids = list(_iter_program_variants(study))

    def keys(self, program: int, variants: Any = slice(None)) -> Variants:
        """Return the keys of a program, or of some of its variants, with their site."""
        ids = self.variant_ids[program][variants]
        site, micro_g = read_site(self.study, Variants(self.study, ids), self.stored)
        return Variants(self.study, ids, site=site, micro_g=micro_g)

    def find(self, variant_id: int) -> tuple[int, int]:
        """Return the number of a variant's program, and its place among the program's variants.

        Raises:
            InputError: the study has no such variant.
        """
        for program, ids in enumerate(self.variant_ids):
            if len(found := np.flatnonzero(ids == variant_id)):
                return program, int(found[0])
        text = f"has no variant {variant_id}, of {self.study.n_variants}"
        raise InputError(f"{self.study.name}: {text}")

    @property
    def has_truth(self) -> bool:
        """Whether runs can be judged, by the truth of a simulation or the reference of a record."""
        return self.stored is None or self.stored.reference is not None

    @cached_property
    def specs(self) -> list[ProgramSpec]:
        """The choices that decide each program."""
        variants = (Variants(self.study, ids) for ids in self.variant_ids)
        return [_program_spec(self.study, keys, self.curves) for keys in variants]

    def batch(
        self,
        program: int,
        draws: range | None = None,
        *,
        variants: Any = slice(None),
        blank: bool = False,
    ) -> Batch:
        """Return the runs of a program, on all draws or a range of them.

        Args:
            program: its number.
            draws: range of draws; None for all.
            variants: places of variants, as an index.
            blank: whether the truth of a simulation is replaced by zeros, enough to compile.

        Raises:
            InputError: a record that does not fit the study.
        """
        keys = self.keys(program, variants)
        if self.stored is None:
            draws = range(self.study.n_draws) if draws is None else draws
            environment, drawn = _simulated_inputs(self.study, keys, draws, blank=blank)
        else:
            environment, drawn = _environment_and_draws_by_start_time(self.study, keys, self.stored)
        params = _run_params(self.study, keys)
        return Batch(self.specs[program], environment, drawn, params, keys.ids)


def _iter_program_variants(study: Study) -> Iterator[np.ndarray]:
    """Yield the numbers of variants that share program and environment, by first appearance."""
    keys = {*PROGRAM_KEYS, *ENVIRONMENT_KEYS, *PASS_KEYS}
    swept = [key for key in study.axis_keys if key in keys]
    swept += ["reset_trigger"] if study.names_schedules else []
    codes = study.coded(*swept).codes if swept else np.zeros(study.n_variants, int)
    _, first, program = np.unique(codes, return_index=True, return_inverse=True)
    in_order = np.argsort(program, kind="stable")
    ids = np.split(in_order, np.cumsum(np.bincount(program))[:-1])
    yield from (ids[number] for number in np.argsort(first))


# The program


def _run_span(study: Study, keys: Variants) -> Span:
    return study.span(**{key: keys.common(key) for key in PASS_KEYS} if study.passes else {})


def _samples_read(study: Study) -> int:
    """Return the samples that the longest run reads: of one length, programs are shared."""
    return max(span.records_read for span in study.distinct_spans) * study.record_every


def _program_spec(study: Study, keys: Variants, curves: bool) -> ProgramSpec:
    """Return the program of some variants."""
    simulated, span, method = not study.is_recorded, _run_span(study, keys), keys.common("method")
    blocks = (0, 0)
    if METHODS[method].program.block_fit is not None:
        blocks = study.record_every, span.records
    reverses = study.passes is not None
    keeps = simulated and reverses and keys.is_active(*keys_acting_as("process", "quantum"))
    return ProgramSpec(
        method,
        Options(
            dt=1 / study.rate_hz,
            specific_force=keys.common("specific_force") or "measured",
            position=keys.common("position"),
            trigger=(study.has("resets") and keys.common("reset_trigger")) or "none",
            innovations=study.is_recorded,  # a simulation has the truth to be judged by
            record_every=blocks[0],
            records=blocks[1],
        ),
        study.record_every,
        span.records,
        curves,
        noisy=simulated and keys.is_active(*keys_acting_as("noise")),
        distorted=simulated and keys.is_active(*keys_acting_as("distortion")),
        sways=simulated and _base_rotates(keys),
        kept=_samples_read(study) if keeps else 0,
        reverses=reverses,
        coarse=_coarse_stage(study, keys),
    )


def _coarse_stage(study: Study, keys: Variants) -> CoarseStage | None:
    """Return coarse alignment if it is a stage of the runs of some variants, else None."""
    if not study.coarse:
        return None
    method, length_s, then = (keys.common(key) for key in COARSE_KEYS)
    if not study.has_coarse_stage(method, then):
        return None
    intervals = round(length_s * study.rate_hz / study.record_every)
    return CoarseStage(method, intervals, then == "replay")


# What runs share, and their draws


def earth_rate(model: str, rate_deg_per_h: float | None) -> float:
    """Return the rate of an Earth model by its name in a study, rad/s."""
    return earth.WGS84_RATE if model == "wgs84" else (rate_deg_per_h or 0.0) * DEG_PER_H


def read_site(study: Study, keys: Variants, stored: StoredRecord | None) -> tuple[Site, float]:
    """Return Earth and place of some variants, and their ug, m/s^2."""
    height = keys.common("height_m")
    if height is None:
        height = (stored.record.height_m if stored else None) or 0.0
    if keys.common("earth") == "wgs84":
        model, ug = earth.wgs84(height), units.micro_g()
    else:
        gravity, radius, rate = (keys.common(key) for key in EARTH_CONSTANTS)
        model = earth.sphere(rate * DEG_PER_H, radius, gravity, height)
        ug = units.micro_g(gravity)
    latitude = keys.common("latitude_deg")
    if latitude is None and stored is not None:
        latitude = stored.record.latitude_deg
    if latitude is None and "latitude_deg" in study.drawn_keys:
        latitude = NOMINAL_LATITUDE_DEG
    if latitude is None:
        source = stored.record.source if stored else study.name
        raise InputError(f"{source}: no latitude in the record: give [earth] latitude_deg")
    site = Site(model, earth.place(model, latitude * DEG), latitude * DEG)
    return jax.tree.map(np.float64, site), ug


def _bands_and_windows(study: Study, keys: Variants) -> Criteria:
    """Return the criteria by which the runs of some variants are judged."""
    settings, before = study.study, 0
    if study.counts_before:
        coarse = (keys.common(key) for key in COARSE_KEYS)
        before = study.samples_before(study.rate_hz, *coarse)
    intervals = (np.asarray(study.report_times_s) * study.rate_hz - before) / study.record_every
    return Criteria(
        bands=np.asarray(settling_bands(study)) * ARCMIN,
        window_start=np.float64(settings.window_s[0]),
        window_end=np.float64(settings.window_s[1]),
        consistency_after=np.float64(settings.consistency_after_s),
        steady_after=np.float64(settings.steady_after_s),
        report_samples=np.round(intervals) * study.record_every if len(intervals) else None,
    )


class BaseAndSensors(NamedTuple):
    """The base and the sensors of some variants, or of their draws, leaves (draws, ...)."""

    errors: SensorErrors
    motion: Motion
    disturbances: Disturbances


def _base_and_sensors(keys: Variants) -> BaseAndSensors:
    """Return base and sensors; without draws, a drawn key is zero, or its default."""
    errors = read_errors(keys.common, keys.micro_g, keys.rate_hz)
    if keys.is_active(*keys_acting_as("quantum")):
        errors = errors._replace(
            gyro_quantum=_read_vector(keys.common, keys.micro_g, "gyro_quantisation_arcsec"),
            accel_quantum=_read_vector(keys.common, keys.micro_g, "accel_quantisation_um_per_s"),
        )
    return BaseAndSensors(errors, read_rotation(keys), read_random_processes(keys, keys.rate_hz))


def _simulated_inputs(
    study: Study, keys: Variants, draws: range, *, blank: bool
) -> tuple[Environment, Draw]:
    """Return the environment and the draws of a simulation; a blank one has zeros for the truth."""
    place, span, rate_hz = keys.site.place, _run_span(study, keys), study.rate_hz
    nominal = _base_and_sensors(keys)
    errors, motion, disturbances = nominal
    times = np.concatenate([[0.0], study.stored_times(span)])
    increments, axes, rocks = None, None, disturbances.rocking is not None
    draws_motion = _draws_any(study, EarthSection, MotionSection)
    if draws_motion:
        # Each draw makes its own as it proceeds.
        increments, attitudes = np.zeros((1, 6)), np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    else:
        samples = _samples_read(study)
        samples = samples if samples <= MOST_STORED_SAMPLES else 0
        travels = disturbances.surge is not None or (rocks and motion.lever is not None)
        rows = true_increments(motion, place, rate_hz, samples, with_axes=travels, blank=blank)
        attitudes = true_attitudes(motion, times, blank=blank)
        if samples:
            increments, axes = rows[:, :6], rows[:, 6:] if travels else None
    environment = Environment(
        site=keys.site,
        errors=errors,
        biases=mean_biases(errors, motion),
        seed=np.asarray(study.seed),
        criteria=_bands_and_windows(study, keys),
        pass_intervals=np.asarray(span.pass_records),
        increments=increments,
        attitudes=attitudes[None, 1:],
        end_times=times[1:] if draws_motion else None,
        motion=motion if study.drawn_keys or increments is None or rocks else None,
        axes=axes,
        disturbances=disturbances,
    )
    n = len(draws)
    q = Quat(*(np.full(n, part) for part in attitudes[0]))
    drawn = _drawn_fields(study, keys, draws, nominal) if study.drawn_keys else {}
    ids = np.arange(draws.start, draws.stop)
    return environment, Draw(ids, np.asarray(0), np.zeros(n, int), q, **drawn)


def _draws_any(study: Study, *sections: type[Section]) -> bool:
    """Return whether a study draws a key of some sections."""
    return any(key in section.model_fields for key in study.drawn_keys for section in sections)


def _drawn_fields(
    study: Study, keys: Variants, draws: range, shaped_like: BaseAndSensors
) -> dict[str, Any]:
    """Return the drawn numbers of a simulated study as fields of `Draw`."""
    values = drawn_values(study, len(draws), first=draws.start)
    drawn = _base_and_sensors(
        Variants(study, keys.ids, values, site=keys.site, micro_g=keys.micro_g)
    )
    errors, motion, disturbances = jax.tree.map(
        lambda a, like: np.broadcast_to(a, (len(draws), *np.shape(like))), drawn, shaped_like
    )
    fields = _initial_errors(values)
    if _draws_any(study, SensorsSection):
        fields["errors"] = errors
    if _draws_any(study, MotionSection, EarthSection):
        fields["motion"] = motion
    if _draws_any(study, EarthSection):
        fields["latitude"] = values["latitude_deg"] * DEG
    if any(key in study.drawn_keys for key in keys_acting_as("process", "process_shape")):
        fields["disturbances"] = disturbances
    return fields


def _initial_errors(values: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return the drawn initial errors as fields of `Draw`."""
    angles = (values.get(f"phi_{axis}0_deg") for axis in "enu")
    e, n, u = (None if angle is None else angle * DEG for angle in angles)
    return {"phi": (e, n, u), "ve": values.get("ve0_m_per_s"), "vn": values.get("vn0_m_per_s")}


def start_samples(study: Study, rate_hz: float) -> np.ndarray:
    """Return the sample of a record at which the coarse alignment of each draw starts, (draws,)."""
    assert study.record is not None
    return np.round(np.asarray(study.record.start_s) * rate_hz).astype(int)


def _environment_and_draws_by_start_time(
    study: Study, keys: Variants, stored: StoredRecord
) -> tuple[Environment, Draw]:
    """Return the environment and the draws of a record, one per start time, coarsely aligned.

    If coarse alignment is a stage of the runs, their attitude is unknown.
    """
    record, rate, span = stored.record, study.rate_hz, _run_span(study, keys)
    if abs(record.rate_hz - rate) > 1e-6 * rate:
        raise InputError(
            f"{record.source}: the record has {record.rate_hz:g} Hz, [study] rate_hz is {rate:g}"
        )
    method, *rest = (keys.common(key) for key in COARSE_KEYS)
    coarse_n, starts = study.samples_before(rate, method, *rest), start_samples(study, rate)
    needed = coarse_n + span.records_read * study.record_every
    for start in starts / rate:
        require_samples(record, start, needed / rate)
    # Only the part of the record that is read.
    first, end = starts.min(), starts.max() + needed
    increments = aligned_record(int(end - first))
    np.concatenate([a[first:end] for a in (record.dtheta, record.dv)], axis=1, out=increments)
    n = len(starts)
    q = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    if coarse_n:
        pieces = np.stack([increments[start - first :][:coarse_n] for start in starts])
        q = coarse_attitudes(method, pieces, 1 / rate, keys.site)
    fine = starts + coarse_n
    times = [start / rate + study.stored_times(span) for start in fine]
    environment = Environment(
        site=keys.site,
        errors=sensors.error_free_sensors(),
        biases=NO_BIASES,
        seed=np.asarray(study.seed),
        criteria=_bands_and_windows(study, keys),
        pass_intervals=np.asarray(span.pass_records),
        increments=increments,
        attitudes=np.stack([reference_attitudes(stored, at) for at in times]),
    )
    initial = _initial_errors(drawn_values(study, n))
    rows, starts = np.arange(n), fine - first
    return environment, Draw(np.arange(n), starts, rows, Quat(*np.asarray(q).T), **initial)


# The base and the sensors from the keys of [motion] and [sensors]


def _read_number(common: Lookup, key: str) -> np.ndarray:
    """Return a key's number in SI, (...,); the default, or zero, in place of a drawn value."""
    value = common(key)
    if value is None:
        section = MotionSection if key in MotionSection.model_fields else SensorsSection
        value = section.model_fields[key].default or 0.0
    return np.asarray(np.asarray(value, dtype=float) * units.si_factor(key))


def _read_vector(
    common: Lookup, ug: float, key: str, count: int = 3, scale: float = 1.0
) -> np.ndarray:
    """Return a key's numbers in SI times a scale, (..., count), zero in place of a drawn value.

    One number is that of all axes.
    """
    value, factor = common(key), units.si_factor(key, ug) * scale
    given = np.asarray(0.0 if value is None else value, dtype=float) * factor
    return np.broadcast_to(given, np.broadcast_shapes(given.shape, (count,)))


def read_sways(common: Lookup) -> Motion:
    """Return the sways of the base, from `Variants.common`."""
    number = partial(_read_number, common)

    def sway(angle: str) -> Sway:
        return Sway(
            center=number(f"{angle}_center_deg"),
            amplitude=number(f"{angle}_amplitude_deg"),
            period=number(f"{angle}_period_s"),
            phase=number(f"{angle}_phase_deg"),
        )

    return Motion(sway("pitch"), sway("roll"), sway("yaw"))


def _base_rotates(keys: Variants) -> bool:
    """Return whether the base sways or is turned."""
    given = any(keys.common(key) for key in ("turn_times_s", "attitude_file"))
    return given or keys.is_active(*keys_acting_as("sway"))


def read_rotation(keys: Variants) -> Motion:
    """Return the whole motion of the base: sways, turns, given attitudes, and the lever arm."""
    motion = add_turns(read_sways(keys.common), keys)
    if (given := read_attitude_file(keys.study)) is not None:
        motion = motion._replace(path=attitude_path(given.time_s, given.attitude_deg))
    rotates = _base_rotates(keys) or keys.is_active("vibration_deg_per_h_rms")
    if rotates and keys.is_active("lever_arm_m"):
        arm = np.moveaxis(_read_vector(keys.common, keys.micro_g, "lever_arm_m"), -1, 0)
        motion = motion._replace(lever=Vec3(*arm))
    return motion


def add_turns(motion: Motion, keys: Variants) -> Motion:
    """Return the motion of the base with its turns, if it has any."""
    values, rate_hz = {key: keys.common(key) for key in TURN_KEYS}, keys.rate_hz
    turns_given = values["turn_times_s"]
    plan = turns_in_samples(rate_hz, data_end_s(keys.study), values) if turns_given else []
    if not plan:
        return motion
    begin, length, ramp, angles, rate = np.array(plan, float).T
    turns = Turns(
        begin=begin / rate_hz,
        length=length / rate_hz,
        ramp=ramp / rate_hz,
        rate=rate * DEG,
        before=np.remainder(np.cumsum(angles) - angles, 360.0) * DEG,
    )
    # With turns that never begin, so that few programs are compiled.
    unused = (0, 2 ** (len(plan) - 1).bit_length() - len(plan))
    begin = np.pad(turns.begin, unused, constant_values=_NEVER_S)
    turns = Turns(*(np.pad(a, unused, mode="edge") for a in turns))._replace(begin=begin)
    found: dict[str, Any] = {"table" if values["turn_axis"] == "body" else "vertical": turns}
    return motion._replace(**found)


def read_errors(common: Lookup, ug: float, rate_hz: float) -> SensorErrors:
    """Return the sensor errors with their ug, m/s^2, and rate, Hz."""
    dt, numbers = 1 / rate_hz, partial(_read_vector, common, ug)

    def noise(per_sample: str, density: str) -> np.ndarray:
        # The standard deviation of a sample integrates to dt times it, a density to sqrt(dt).
        if common(density) is not None:
            return numbers(density, scale=np.sqrt(dt))
        return numbers(per_sample, scale=dt)

    def matrix(scale: str, cross: str) -> np.ndarray:
        scales, angles = numbers(scale), numbers(cross, 6)
        out = np.zeros((*np.broadcast_shapes(scales.shape[:-1], angles.shape[:-1]), 3, 3))
        out[..., range(3), range(3)] = scales
        out[..., ~np.eye(3, dtype=bool)] = angles
        return out

    return SensorErrors(
        gyro_bias=numbers("gyro_bias_deg_per_h"),
        accel_bias=numbers("accel_bias_ug"),
        gyro_noise=noise("gyro_noise_deg_per_h", "gyro_arw_deg_per_sqrt_h"),
        accel_noise=noise("accel_noise_ug", "accel_vrw_ug_per_sqrt_hz"),
        gyro_matrix=matrix("gyro_scale_ppm", "gyro_misalignment_arcsec"),
        accel_matrix=matrix("accel_scale_ppm", "accel_misalignment_arcsec"),
    )


def read_random_processes(keys: Variants, rate_hz: float) -> Disturbances:
    """Return the random processes of base and sensors at some rate, Hz."""
    number, vector = partial(_read_number, keys.common), partial(_read_vector, keys.common)
    dt, ug = 1 / rate_hz, keys.micro_g

    def process(key: str, make: Callable[..., Process], *others: Any) -> Any:
        return make(vector(ug, key), *others, dt) if keys.is_active(key) else None

    surge_s, vibration = number("surge_time_s"), number("vibration_hz")
    if keys.common("surge_model") == "gauss_markov":
        surge = process("surge_m_per_s", processes.gauss_markov_process, surge_s)
    else:
        limited = surge_s, number("surge_bandwidth_hz")
        surge = process("surge_m_per_s", processes.velocity_of_bounded_position, *limited)
    resonant = vibration, number("vibration_damping")
    drift, walk = processes.sampled_mean_of_gauss_markov, processes.sampled_mean_of_random_walk
    gyro_s, accel_s = (number(f"{sensor}_instability_time_s") for sensor in ("gyro", "accel"))
    # A vibrating velocity or angle with rms 1 has a derivative with rms omega.
    omega, resonance = 2 * np.pi * vibration[..., None], processes.resonance_process
    shaking = process("vibration_ug_rms", resonance, *resonant)
    rocking = process("vibration_deg_per_h_rms", resonance, *resonant)
    return Disturbances(
        surge=surge,
        gyro_instability=process("gyro_instability_deg_per_h", drift, gyro_s),
        accel_instability=process("accel_instability_ug", drift, accel_s),
        gyro_walk=process("gyro_rrw_deg_per_h_per_sqrt_h", walk),
        accel_walk=process("accel_rrw_ug_per_sqrt_h", walk),
        shaking=shaking and shaking._replace(scale=shaking.scale / omega),
        rocking=rocking and rocking._replace(scale=rocking.scale / omega),
    )


# The numbers of runs


def _run_params(study: Study, keys: Variants) -> RunParams:
    """Return the params of some variants, leaves (variants, ...)."""
    start = [f"phi_{axis}0_deg" for axis in "enu"]
    drawn = any(key in study.drawn_keys for key in start)
    euler = keys.coded("misalignment").compute(lambda meaning: meaning == "euler", bool)
    phi = Vec3(*map(keys.si, start))
    if euler.any() and not drawn:
        phi = _rotation_vectors(keys.coded("misalignment", *start))
    return RunParams(
        phi=phi,
        ve=keys.si("ve0_m_per_s"),
        vn=keys.si("vn0_m_per_s"),
        method=METHODS[keys.common("method")].params(keys, np),
        euler=euler if drawn and euler.any() else None,
    )


_euler_vectors = jax.jit(jax.vmap(euler_vector))


def _rotation_vectors(starts: CodedColumn) -> Vec3:
    """Return rotation vectors of initial misalignments given in degrees, leaves (variants,)."""
    angles = np.asarray([values[1:] for values in starts.choices], dtype=float).T * DEG
    euler = np.asarray([values[0] == "euler" for values in starts.choices])
    vectors = np.where(euler, np.stack(_euler_vectors(*angles)), angles)
    return Vec3(*vectors[:, starts.codes])

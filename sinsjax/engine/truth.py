"""The environment and the draws of a study's runs, in SI units, from a simulation or a record."""

from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax import units
from sinsjax.engine.environment import (
    Draw,
    Environment,
    InitialErrors,
    SensorModel,
    Truth,
    aligned_record,
)
from sinsjax.engine.metrics import Criteria
from sinsjax.engine.sensor_inputs import (
    DISTURBANCE_KEYS,
    add_quantisation,
    base_motion_of,
    read_disturbances,
    read_errors,
)
from sinsjax.errors import InputError
from sinsjax.messages import format_seconds
from sinsjax.methods.coarse import align_analytically, align_by_program
from sinsjax.methods.floors import NO_BIASES, mean_biases
from sinsjax.methods.method import Options, Site
from sinsjax.methods.registry import METHODS
from sinsjax.records import require_span
from sinsjax.records.reference import StoredRecord
from sinsjax.strapdown import base_motion, earth, sensors
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.study import sampling
from sinsjax.study.keys import COARSE_KEYS, EARTH_CONSTANTS
from sinsjax.study.schema import (
    EarthSection,
    MotionSection,
    SensorsSection,
)
from sinsjax.study.study import Span, Study
from sinsjax.study.variants import Variants
from sinsjax.types import Array, Quat, Sample
from sinsjax.units import DEG, DEG_PER_H
from sinsjax.value_types import Section

MOST_STORED_SAMPLES = 2**22
"""Samples of the longest simulated record that is stored, 200 MB; more are made as runs proceed."""

_SAMPLES, _TIMES = 4000, 256
"""Samples of increments, and attitudes, per call: one program serves studies of any length."""

_LONGEST_GAP_S = 5.0  # in a reference; a swinging base turns within seconds


NOMINAL_LATITUDE_DEG = 45.0
"""Replaces a drawn latitude where one is needed for all draws: in the gains of compass loops, which
depend on it by gravity and radius alone, 0.3 % on an ellipsoid."""


def read_site(study: Study, variants: Variants, stored: StoredRecord | None) -> tuple[Site, float]:
    """Return Earth and place of a part, and its ug, m/s^2."""
    height = variants.common("height_m")
    if height is None:
        height = (stored.record.height_m if stored else None) or 0.0
    if variants.common("earth") == "wgs84":
        model, ug = earth.wgs84(height), units.micro_g()
    else:
        constants = {key: variants.common(key) for key in EARTH_CONSTANTS}
        gravity = constants["gravity_m_per_s2"]
        rate = constants["earth_rate_deg_per_h"] * DEG_PER_H
        model = earth.sphere(rate, constants["radius_m"], gravity, height)
        ug = units.micro_g(gravity)
    latitude = variants.common("latitude_deg")
    if latitude is None and stored is not None:
        latitude = stored.record.latitude_deg
    if latitude is None and "latitude_deg" in study.drawn_keys:
        latitude = NOMINAL_LATITUDE_DEG
    if latitude is None:
        source = stored.record.source if stored else study.name
        raise InputError(f"{source}: no latitude in the record: give [earth] latitude_deg")
    place = earth.place(model, latitude * DEG)
    site = Site(model, place, latitude * DEG)
    return jax.tree.map(np.float64, site), ug


def simulate_environment(
    study: Study,
    variants: Variants,
    span: Span,
    criteria: Criteria,
    draws: range,
    *,
    blank: bool = False,
) -> tuple[Environment, Draw, np.ndarray]:
    """Return environment, draws and their true initial attitudes of a simulated part.

    A drawn key has a nominal value in the environment: zero, or its default. A blank environment
    has zeros for the truth, which is enough to compile for its shapes.
    """
    site, ug = read_site(study, variants, None)
    errors, motion, disturbances = _base_and_sensors(variants, ug)
    times = np.concatenate([[0.0], study.stored_times(span)])
    increments, axes, rocks = None, None, disturbances.rocking is not None
    draws_motion = draws_any_key(study, EarthSection, MotionSection)
    if draws_motion:
        # Each draw makes its own as it proceeds.
        increments, attitudes = np.zeros((1, 6)), np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    else:
        # Of one length for all parts, so that they share a program.
        samples = max(s.records_read for s in study.distinct_spans) * study.record_every
        kept = samples if samples <= MOST_STORED_SAMPLES else 0
        travels = disturbances.surge is not None or (rocks and motion.lever is not None)
        if blank:
            rows, attitudes = _blank_truth(kept, len(times), axes=travels)
        else:
            rows = true_increments(motion, site.place, study.rate_hz, kept, axes=travels)
            attitudes = true_attitudes(motion, times)
        if kept:
            increments, axes = rows[:, :6], rows[:, 6:] if travels else None
    n = len(draws)
    environment = Environment(
        site=site,
        sensors=SensorModel(
            increments=increments,
            errors=errors,
            seed=np.asarray(study.seed),
            motion=motion if study.drawn_keys or increments is None or rocks else None,
            axes=axes,
            disturbances=disturbances,
        ),
        truth=Truth(attitudes[None, 1:], times[1:] if draws_motion else None),
        criteria=criteria,
        biases=mean_biases(errors, motion),
        pass_records=np.asarray(span.pass_records),
    )
    ids = np.arange(draws.start, draws.stop)
    nominal = errors, motion, disturbances
    drawn = _drawn_fields(study, variants.ids, draws, ug, nominal) if study.drawn_keys else {}
    return (
        environment,
        Draw(ids, np.asarray(0), np.zeros(n, int), **drawn),
        np.tile(attitudes[0], (n, 1)),
    )


def draws_any_key(study: Study, *sections: type[Section]) -> bool:
    """Return whether a study draws a key of some sections."""
    return any(key in section.model_fields for key in study.drawn_keys for section in sections)


def _drawn_fields(
    study: Study,
    ids: np.ndarray,
    draws: range,
    ug: float,
    nominal: tuple[sensors.SensorErrors, base_motion.Motion, Disturbances],
) -> dict[str, Any]:
    """Return the drawn numbers of a simulated study as fields of `Draw`."""
    values = sampling.drawn_values(study, len(draws), first=draws.start)
    variants = Variants(study, ids, values)
    drawn = _base_and_sensors(variants, ug)
    errors, motion, disturbances = jax.tree.map(
        lambda a, like: np.broadcast_to(a, (len(draws), *np.shape(like))), drawn, nominal
    )
    fields: dict[str, Any] = {"initial": _initial_errors(values)}
    if draws_any_key(study, SensorsSection):
        fields["errors"] = errors
    if draws_any_key(study, MotionSection, EarthSection):
        fields["motion"] = motion
    if draws_any_key(study, EarthSection):
        fields["latitude"] = values["latitude_deg"] * DEG
    if any(key in study.drawn_keys for key in DISTURBANCE_KEYS):
        fields["disturbances"] = disturbances
    return fields


def _base_and_sensors(
    variants: Variants, ug: float
) -> tuple[sensors.SensorErrors, base_motion.Motion, Disturbances]:
    """Return sensor errors, motion and disturbances of variants, and of their draws if given."""
    rate, common = variants.rate_hz, variants.common
    return (
        add_quantisation(read_errors(common, ug, rate), variants),
        base_motion_of(variants),
        read_disturbances(variants, ug, rate),
    )


def _initial_errors(values: Mapping[str, np.ndarray]) -> InitialErrors:
    """Return the drawn initial errors."""
    e, n, u = (values.get(f"phi_{axis}0_deg") for axis in "enu")
    return InitialErrors(
        phi=(_to_radians(e), _to_radians(n), _to_radians(u)),
        ve=values.get("ve0_m_per_s"),
        vn=values.get("vn0_m_per_s"),
    )


def _to_radians(degrees: np.ndarray | None) -> np.ndarray | None:
    return None if degrees is None else degrees * DEG


def start_samples(study: Study, rate_hz: float) -> np.ndarray:
    """Return the sample of a record at which the coarse alignment of each draw starts, (draws,)."""
    assert study.record is not None
    return np.round(np.asarray(study.record.start_s) * rate_hz).astype(int)


def record_environment(
    study: Study, variants: Variants, span: Span, criteria: Criteria, stored: StoredRecord
) -> tuple[Environment, Draw, np.ndarray]:
    """Return environment, draws (one per start time) and coarse attitudes of a recorded part.

    If coarse alignment is a stage of the runs, the attitude is unknown.
    """
    site, _ = read_site(study, variants, stored)
    record, rate = stored.record, study.rate_hz
    if abs(record.rate_hz - rate) > 1e-6 * rate:
        raise InputError(
            f"{record.source}: the record has {record.rate_hz:g} Hz, [study] rate_hz is {rate:g}"
        )
    method, *rest = (variants.common(key) for key in COARSE_KEYS)
    coarse_n, starts = study.samples_before(rate, method, *rest), start_samples(study, rate)
    for start in starts / rate:
        require_span(record, start, (coarse_n + span.records_read * study.record_every) / rate)
    # Only the part of the record that is read.
    first, end = starts.min(), starts.max() + coarse_n + span.records_read * study.record_every
    increments = aligned_record(int(end - first))
    np.concatenate([a[first:end] for a in (record.dtheta, record.dv)], axis=1, out=increments)
    q = np.tile([1.0, 0.0, 0.0, 0.0], (len(starts), 1))
    if coarse_n:
        pieces = np.stack([increments[s - first :][:coarse_n] for s in starts])
        samples = jax.vmap(sensors.compensate_record)(pieces, pieces[:, 0])
        q = _coarse_alignment(method, 1 / rate)(samples, site)
    fine = starts + coarse_n
    truth = np.stack(
        [reference_attitudes(stored, s / rate + study.stored_times(span)) for s in fine]
    )
    environment = Environment(
        site=site,
        sensors=SensorModel(increments, sensors.error_free_sensors(), np.asarray(study.seed)),
        truth=Truth(truth),
        criteria=criteria,
        biases=NO_BIASES,
        pass_records=np.asarray(span.pass_records),
    )
    n = len(starts)
    initial = _initial_errors(sampling.drawn_values(study, n))
    draws = Draw(np.arange(n), fine - first, np.arange(n), initial=initial)
    return environment, draws, np.asarray(q)


@cache
def _coarse_alignment(method: str, dt: float) -> Callable[[Sample, Site], Array]:
    """Return (samples, leaves (starts, n), site) -> attitudes at their ends, (starts, 4)."""
    align: Callable[[Sample, Site], Quat] = partial(align_analytically, dt=dt)
    if method != "analytic":
        align = partial(align_by_program, METHODS[method].build(Options(dt)))
    aligned = jax.vmap(lambda samples, site: jnp.stack(align(samples, site)), in_axes=(0, None))
    return jax.jit(aligned)


def reference_attitudes(stored: StoredRecord, times: np.ndarray) -> np.ndarray:
    """Return the reference attitude at times from the record's start, (n, 4); NaN without one."""
    reference = stored.reference
    if reference is None:
        return np.full((len(times), 4), np.nan)
    first, last = reference.time_s[0], reference.time_s[-1]
    begin, end = times.min(), times.max()  # a backward pass ends before it begins
    slack = 1e-6 + 1 / stored.record.rate_hz
    late, early = float(first - begin), float(end - last)
    if max(late, early) > slack:
        clock = stored.record.t0_s
        lack, remedy = f"ends {early:.3g} s too early", "a shorter [study] duration_s would do"
        if late >= early:
            lack, remedy = f"begins {late:.3g} s too late", "a later [record] start_s would do"
        if max(late, early) > end - begin:
            remedy = "do their clocks differ?"
        raise InputError(
            f"{reference.source}: covers {format_seconds(clock + first)} to"
            f" {format_seconds(clock + last)} s, but the study needs"
            f" {format_seconds(clock + begin)} to {format_seconds(clock + end)} s by the"
            f" clock of {stored.record.source}: it {lack} ({remedy})"
        )
    # With the samples on either side, between which the ends are interpolated.
    low = np.searchsorted(reference.time_s, begin, side="right") - 1
    high = np.searchsorted(reference.time_s, end)
    gap = np.diff(reference.time_s[max(0, low) : high + 1]).max(initial=0.0)
    if gap > _LONGEST_GAP_S:
        raise InputError(
            f"{reference.source}: has a gap of {gap:g} s where the study needs it"
            f" (at most {_LONGEST_GAP_S:g} s are interpolated)"
        )
    # Half the import time of sinsjax, and needed only with a reference.
    from scipy.spatial.transform import Rotation, Slerp

    pitch, roll, yaw = reference.attitude_deg.T
    attitudes = Rotation.from_euler("ZXY", np.column_stack([yaw, pitch, roll]), degrees=True)
    return Slerp(reference.time_s, attitudes)(np.clip(times, first, last)).as_quat(
        scalar_first=True
    )


# The true motion of a base over a whole study, made in calls of one size

_increments = jax.jit(base_motion.ideal_increments, static_argnums=3)
_increments_and_axes = jax.jit(base_motion.ideal_increments_and_axes, static_argnums=3)


@jax.jit
def _attitudes(motion: base_motion.Motion, times: Array) -> Array:
    return jax.vmap(lambda t: jnp.stack(base_motion.attitude(motion, t)))(times)


def true_increments(
    motion: base_motion.Motion, place: earth.Place, rate_hz: float, samples: int, *, axes: bool
) -> np.ndarray:
    """Return ideal increments, rad and m/s: (samples, 6), or with the axes of n (samples, 15).

    Args:
        motion: of the base.
        place: Earth rates and gravity.
        rate_hz: sample rate, Hz.
        samples: number of samples.
        axes: whether the axes of n in b, means over each sample, are included.
    """
    increments, _ = _blank_truth(samples, 0, axes=axes)
    integrate = _increments_and_axes if axes else _increments
    for first in range(0, samples, _SAMPLES):
        block = increments[first : first + _SAMPLES]
        block[:] = integrate(motion, place, rate_hz, _SAMPLES, float(first))[: len(block)]
    return increments


def true_attitudes(motion: base_motion.Motion, times: np.ndarray) -> np.ndarray:
    """Return true attitudes, body to n, (n, 4) quaternions at times (n,), s."""
    _, attitudes = _blank_truth(0, len(times), axes=False)
    for first in range(0, len(times), _TIMES):
        block = attitudes[first : first + _TIMES]
        padded = np.resize(times[first : first + _TIMES], _TIMES)
        block[:] = _attitudes(motion, padded)[: len(block)]
    return attitudes


def _blank_truth(samples: int, times: int, *, axes: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return zeros of the shapes of `true_increments` and `true_attitudes`."""
    return np.zeros((samples, 15 if axes else 6)), np.zeros((times, 4))

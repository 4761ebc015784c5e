"""The environment of a study's runs: Earth, base motion and sensors, or a record in their place.

Everything that runs of a part share is made here, in SI units, from the study's own.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax import units
from sinsjax.engine import true_motion
from sinsjax.engine.metrics import Criteria
from sinsjax.engine.realisations import (
    Draw,
    DrawnNormally,
    Environment,
    InitialErrors,
    aligned_record,
)
from sinsjax.engine.simulator import (
    OF_DISTURBANCES,
    disturbances_of,
    errors_of,
    motion_of,
    with_lever_arm,
    with_quanta,
)
from sinsjax.errors import InputError
from sinsjax.messages import format_seconds
from sinsjax.methods.base import Site
from sinsjax.methods.coarse import COARSE
from sinsjax.methods.inertial_frame.method import optimised
from sinsjax.methods.limits import NO_BIASES, mean_biases
from sinsjax.records import require_span
from sinsjax.records.reference import StoredRecord
from sinsjax.strapdown import base_motion, earth, sensors
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.study import sampling
from sinsjax.study.keys import COARSE_KEYS, EARTH_CONSTANTS
from sinsjax.study.schema import (
    BIAS_KEYS,
    NUMBERS_DRAWN,
    EarthSection,
    MotionSection,
    SensorsSection,
    is_normal,
)
from sinsjax.study.study import Span, Study
from sinsjax.study.variants import Variants
from sinsjax.units import DEG, DEG_PER_H
from sinsjax.value_types import Section

MOST_STORED_SAMPLES = 2**22
"""Samples of the longest simulated record that is stored, 200 MB; more are made as runs go."""

_COARSE = COARSE | {"optimisation": optimised}
_LONGEST_GAP_S = 5.0  # in a reference; a swinging base turns within seconds


NOMINAL_LATITUDE_DEG = 45.0
"""What stands for a drawn latitude where one is needed for all draws: in the gains of compass
loops, which know of it by gravity and radius alone, 0.3 % on an ellipsoid."""


def site_of(study: Study, variants: Variants, stored: StoredRecord | None) -> tuple[Site, float]:
    """The Earth and place of a part, and its ug in m/s^2."""
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


def simulated(
    study: Study,
    variants: Variants,
    span: Span,
    criteria: Criteria,
    draws: range,
    *,
    blank: bool = False,
) -> tuple[Environment, Draw, np.ndarray]:
    """Environment, draws and their true starting attitudes of a simulated part.

    A key that is drawn has a nominal value in the environment: zero, or its default. A blank one
    has zeros for the truth: shapes are all that a program is compiled for.
    """
    site, ug = site_of(study, variants, None)
    errors, motion, disturbances = _base_and_sensors(variants, ug)
    times = np.concatenate([[0.0], study.stored_times(span)])
    increments, axes = None, None
    if draws_own(study, EarthSection, MotionSection):
        # Each draw makes its own as it goes.
        increments, attitudes = np.zeros((1, 6)), np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    else:
        # Of one length for all parts, so that they share a program.
        samples = max(s.read for s in study.distinct_spans) * study.record_every
        kept = samples if samples <= MOST_STORED_SAMPLES else 0
        surges = disturbances.surge is not None
        if blank:
            rows, attitudes = true_motion.blank(kept, len(times), axes=surges)
        else:
            rows = true_motion.rows(motion, site.place, study.rate_hz, kept, axes=surges)
            attitudes = true_motion.attitudes(motion, times)
        if kept:
            increments, axes = rows[:, :6], rows[:, 6:] if surges else None
    n = len(draws)
    environment = Environment(
        site=site,
        increments=increments,
        truth=attitudes[None, 1:],
        errors=errors,
        seed=np.asarray(study.seed),
        criteria=criteria,
        biases=mean_biases(errors, motion),
        pass_records=np.asarray(span.pass_records),
        times=times[1:] if draws_own(study, EarthSection, MotionSection) else None,
        motion=motion if study.drawn_keys or increments is None else None,
        axes=axes,
        disturbances=disturbances,
        drawn=_drawn_normally(study, variants.ids, ug),
    )
    ids = np.arange(draws.start, draws.stop)
    nominal = errors, motion, disturbances
    own = _own(study, variants.ids, draws, ug, nominal) if study.drawn_keys else {}
    return (
        environment,
        Draw(ids, np.asarray(0), np.zeros(n, int), **own),
        np.tile(attitudes[0], (n, 1)),
    )


def draws_own(study: Study, *sections: type[Section]) -> bool:
    """Whether a study draws a key of some sections."""
    return any(key in section.model_fields for key in study.drawn_keys for section in sections)


def _own(
    study: Study,
    ids: np.ndarray,
    draws: range,
    ug: float,
    nominal: tuple[sensors.SensorErrors, base_motion.Motion, Disturbances],
) -> dict[str, Any]:
    """What the draws of a simulated study have for themselves, as fields of `Draw`."""
    values = sampling.values(study, len(draws), first=draws.start)
    variants = Variants(study, ids, values)
    drawn = _base_and_sensors(variants, ug)
    errors, motion, disturbances = jax.tree.map(
        lambda a, like: np.broadcast_to(a, (len(draws), *np.shape(like))), drawn, nominal
    )
    own: dict[str, Any] = {"begins": _begins(values)}
    if draws_own(study, SensorsSection):
        own["errors"] = errors
    if draws_own(study, MotionSection, EarthSection):
        own["motion"] = motion
    if draws_own(study, EarthSection):
        own["latitude"] = values["latitude_deg"] * DEG
    if any(key in study.drawn_keys for key in OF_DISTURBANCES):
        own["disturbances"] = disturbances
    return own


def _drawn_normally(study: Study, ids: np.ndarray, ug: float) -> DrawnNormally | None:
    """Means and standard deviations where all that draws have for themselves has such."""
    laws = {} if study.drawn is None else study.drawn.laws
    if not laws or any(not is_normal(key, law) for key, law in laws.items()):
        return None
    moments = np.array([law.normal for law in laws.values()]).T
    means, sigmas = (
        {
            k: np.full((1, NUMBERS_DRAWN[k]) if k in BIAS_KEYS else 1, a)
            for k, a in zip(laws, row, strict=True)
        }
        for row in moments
    )
    errors, spread = (_base_and_sensors(Variants(study, ids, a), ug)[0] for a in (means, sigmas))
    begins, sigma = (jax.tree.map(lambda a: a[0], _begins(a)) for a in (means, sigmas))
    gyro, accel = (key in laws for key in BIAS_KEYS)
    biases = [
        np.reshape(np.broadcast_to(a, (1, 3)), 3) for a in (errors.gyro_bias, errors.accel_bias)
    ]
    mean = errors._replace(gyro_bias=biases[0], accel_bias=biases[1])
    return DrawnNormally(
        begins,
        mean if gyro or accel else None,
        np.array([a or 0.0 for a in (*sigma.phi, *sigma[1:])]),
        np.reshape(spread.gyro_bias, 3) if gyro else None,
        np.reshape(spread.accel_bias, 3) if accel else None,
    )


def _base_and_sensors(
    variants: Variants, ug: float
) -> tuple[sensors.SensorErrors, base_motion.Motion, Disturbances]:
    """Sensors, base, and what disturbs both, of some variants and of their draws if given."""
    rate, common = variants.rate_hz, variants.common
    return (
        with_quanta(errors_of(common, ug, rate), variants),
        with_lever_arm(motion_of(common), variants),
        disturbances_of(variants, ug, rate),
    )


def _begins(values: Mapping[str, np.ndarray]) -> InitialErrors:
    """What draws begin with, where that is drawn."""
    e, n, u = (values.get(f"phi_{axis}0_deg") for axis in "enu")
    return InitialErrors(
        phi=(_angle(e), _angle(n), _angle(u)),
        ve=values.get("ve0_m_per_s"),
        vn=values.get("vn0_m_per_s"),
    )


def _angle(degrees: np.ndarray | None) -> np.ndarray | None:
    return None if degrees is None else degrees * DEG


def starts_of(study: Study, rate_hz: float) -> np.ndarray:
    """(draws,) the sample of a record at which the coarse alignment of each begins."""
    assert study.record is not None
    return np.round(np.asarray(study.record.start_s) * rate_hz).astype(int)


def recorded(
    study: Study, variants: Variants, span: Span, criteria: Criteria, stored: StoredRecord
) -> tuple[Environment, Draw, np.ndarray]:
    """Environment, draws (one a start time) and coarsely aligned attitudes of a recorded part.

    Where coarse alignment is a stage of the runs, nothing is known of the attitude.
    """
    site, _ = site_of(study, variants, stored)
    record, rate = stored.record, study.rate_hz
    if abs(record.rate_hz - rate) > 1e-6 * rate:
        raise InputError(
            f"{record.source}: the record has {record.rate_hz:g} Hz, [study] rate_hz is {rate:g}"
        )
    method, *rest = (variants.common(key) for key in COARSE_KEYS)
    coarse_n, starts = study.samples_before(rate, method, *rest), starts_of(study, rate)
    for start in starts / rate:
        require_span(record, start, (coarse_n + span.read * study.record_every) / rate)
    # No more of the record than is read.
    first, end = starts.min(), starts.max() + coarse_n + span.read * study.record_every
    increments = aligned_record(int(end - first))
    np.concatenate([a[first:end] for a in (record.dtheta, record.dv)], axis=1, out=increments)
    q = np.tile([1.0, 0.0, 0.0, 0.0], (len(starts), 1))
    if coarse_n:
        align = jax.jit(_COARSE[method])
        pieces = np.stack([increments[s - first :][:coarse_n] for s in starts])
        samples = jax.vmap(sensors.compensate_record)(pieces, pieces[:, 0])
        q = jax.vmap(lambda s: jnp.stack(align(s, site.place, 1 / rate)))(samples)
    fine = starts + coarse_n
    truth = np.stack([_reference_at(stored, s / rate + study.stored_times(span)) for s in fine])
    environment = Environment(
        site=site,
        increments=increments,
        truth=truth,
        errors=sensors.perfect(),
        seed=np.asarray(study.seed),
        criteria=criteria,
        biases=NO_BIASES,
        pass_records=np.asarray(span.pass_records),
    )
    n = len(starts)
    begins = _begins(sampling.values(study, n))
    draws = Draw(np.arange(n), fine - first, np.arange(n), begins=begins)
    return environment, draws, np.asarray(q)


def _reference_at(stored: StoredRecord, times: np.ndarray) -> np.ndarray:
    """(n, 4) reference attitude at times from the record's start; NaN without a reference."""
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
    # Half the time that importing all of sinsjax takes, and only a reference needs it.
    from scipy.spatial.transform import Rotation, Slerp

    pitch, roll, yaw = reference.attitude_deg.T
    attitudes = Rotation.from_euler("ZXY", np.column_stack([yaw, pitch, roll]), degrees=True)
    return Slerp(reference.time_s, attitudes)(np.clip(times, first, last)).as_quat(
        scalar_first=True
    )

"""Warnings about a study before it runs: its record, or its sample rate."""

from collections.abc import Iterator

import jax
import numpy as np

from sinsjax.engine import batch, simulate
from sinsjax.engine.build import parts
from sinsjax.engine.lanes import Group, shown, tiles_of
from sinsjax.engine.study_limits import hidden_north
from sinsjax.engine.truth import site_of, starts_of
from sinsjax.errors import InputError
from sinsjax.messages import format_seconds, to_one_line
from sinsjax.methods.filters.parameters import level_settling_s
from sinsjax.methods.registry import METHODS, PACKAGES, from_package
from sinsjax.records import Layout, Record, require_span
from sinsjax.records.oddities import told
from sinsjax.records.plausible import StationaryValues, findings
from sinsjax.records.reference import StoredRecord
from sinsjax.study import sampling
from sinsjax.study.keys import COARSE_KEYS
from sinsjax.study.process_noise import assumed_noise
from sinsjax.study.study import Study
from sinsjax.study.variants import Variants
from sinsjax.units import DEG_PER_H, micro_g

_BIASES = {"gyro_bias_deg_per_h": 10.0, "accel_bias_ug": 5000.0}
_TRUST = "[record] trust = true aligns it anyway"
_DRAWS = 1024  # draws in which a drawn period is checked


def study_warnings(study: Study, stored: StoredRecord | None = None) -> list[str]:
    """Warnings for the user before a study runs, one line each.

    Args:
        study: checked study, at the rate of its record.
        stored: the record of a recorded study.

    Raises:
        InputError: the record is certainly wrong and the study does not trust it, or it does not
            cover the span that the study reads.
    """
    if stored is None:
        hidden = hidden_north(study)
        told = [*_fast_sways(study), *_rough_surges(study)]
        return [*told, *([str(hidden)] if hidden else [])]
    return list(_of_record(study, stored))


def check_methods(study: Study, stored: StoredRecord | None = None) -> list[str]:
    """Trace what methods of other packages compute, as a run would.

    Args:
        study: checked study, at the rate of its record.
        stored: the record of a recorded study.

    Returns:
        Warnings where a method's P is not what its description says, one line each.

    Raises:
        InputError: one of them cannot be run; names its package.
    """
    told: dict[str, str | None] = {}
    if PACKAGES.keys().isdisjoint(study.methods):
        return []
    for part in parts(study, stored):
        static, environment = part.group.static, part.group.environment
        if static.method not in PACKAGES:
            continue
        tiles = tiles_of(part.group, batch.plan(part.group)[0])
        try:
            batch.program(
                static, environment, tiles, shown(part.group)
            )  # a sweep takes it from there
        except InputError:
            raise
        except Exception as error:  # what JAX says of another's function
            of = from_package(static.method)
            what = f"{type(error).__name__}: {to_one_line(str(error).strip(), 600)}"
            raise InputError(f"{of}: does not trace: {what}") from error
        if static.method not in told:
            told[static.method] = _odd_covariance(part.group)
    return [f"{from_package(name)}: covariance: {odd}" for name, odd in told.items() if odd]


def _odd_covariance(group: Group) -> str | None:
    """How P at the start of a first run contradicts the description of its method, in words."""
    draw = jax.tree.map(lambda a: a[0] if np.ndim(a) else a, group.draws)
    params = jax.tree.map(lambda a: np.asarray(a)[0], group.variants)
    first = jax.jit(simulate.first_covariance, static_argnums=0)
    p = first(group.static, group.environment, draw, params)
    described, given = METHODS[group.static.method].has_covariance, not np.isnan(p).all()
    if given and not described:
        return "gives one, but has_covariance is False (say True, or give no_covariance)"
    if described and not given:
        return "gives none as a run begins, but has_covariance is True (without any, say False)"
    if min(p.ee, p.nn, p.uu) < 0:
        return "gives a negative variance as a run begins"
    return None


def process_noise(study: Study) -> str | None:
    """Compare Q with the white noise of the sensors, as standard deviations, in one sentence.

    The largest axis counts. None without a filter, and without white noise that all draws have.

    Args:
        study: checked study with simulated sensors.
    """
    times = assumed_noise(study)
    words = {name: _number_of_times(ratios) for name, ratios in times.items() if ratios}
    if not words:
        return None
    if len(words) == len(times) and len({*words.values()}) == 1:
        often = words.popitem()[1]
        return f"The filter assumes {often}the sensors'{'' if often else ' own'} noise" + (
            ", in standard deviation" if often else ""
        )
    parts = (f"{often}the noise of the {name}" for name, often in words.items())
    return f"The filter assumes {' and '.join(parts)}, in standard deviation"


def _number_of_times(ratios: set[float]) -> str:
    """``100 times``, ``5 to 20 times``, or nothing for once, before a noun."""
    text = _span({float(f"{ratio:.2g}") for ratio in ratios})
    return "" if text == "1" else f"{text} times "


def _span(numbers: set[float]) -> str:
    return " to ".join(f"{number:,g}" for number in sorted({min(numbers), max(numbers)}))


def feedback(study: Study) -> str | None:
    """Compare the time between feedbacks with the settling time of the filter's level.

    None without a filter whose measured velocity tells level alone.

    Args:
        study: checked study whose rate is known.
    """
    if not study.has("filter"):
        return None
    every: set[float] = set()
    settling: set[float] = set()
    of_level = ("p0_velocity_m_per_s", "p0_level_deg", "r_velocity_m_per_s")
    of_r = ("r_reading", "r_scale")
    for point in study.combinations("method", "feedback_interval_s", *of_level, *of_r):
        method = METHODS[point["method"]]
        if "filter" not in method.sections or "surge" in method.sections:
            continue
        every.add(point["feedback_interval_s"])
        time_s = level_settling_s(study.rate_hz, *(point[key] for key in (*of_level, *of_r)))
        settling.add(float(f"{time_s:.2g}"))
    if not every:
        return None
    return (
        f"The filter feeds back every {_span(every)} s; its level settles in {_span(settling)} s"
        " (to a tenth of its initial standard deviation)"
    )


def layout_of(study: Study) -> Layout:
    """Layout of a study's record."""
    assert study.record is not None
    return study.record.layout(study.study.rate_hz)


def _of_record(study: Study, stored: StoredRecord) -> Iterator[str]:
    section, record = study.record, stored.record
    assert section is not None
    layout = record.layout or layout_of(study)
    if record.filled:
        key = "max_gap_s" if record.layout else "[record] max_gap_s"
        yield (
            f"{record.source}: {record.filled} missing samples are interpolated (gaps up to"
            f" {key} = {layout.max_gap_s:g} s)"
        )
    site, _ = site_of(study, Variants(study, np.zeros(1, int)), stored)
    bias = {
        key: default if getattr(section, key) is None else getattr(section, key)
        for key, default in _BIASES.items()
    }
    expected = StationaryValues(
        earth_rate=float(site.earth.rate),
        latitude=float(site.latitude),
        gravity=float(site.place.gravity),
        gyro_bias=bias["gyro_bias_deg_per_h"] * DEG_PER_H,
        accel_bias=bias["accel_bias_ug"] * micro_g(),
    )
    used = _used(study, record)
    for odd in told(record.oddities, used):
        if odd.hard and not section.trust:
            raise InputError(f"{record.source}: {odd.text} ({_TRUST})")
        yield f"{record.source}: {odd.text}"
    dead = [odd.text for odd in record.oddities if (odd.begin, odd.end) == (0, len(record.dv))]
    for begin, end in used:
        begin_s, end_s = (format_seconds(sample / record.rate_hz) for sample in (begin, end))
        where = f"{record.source}: {begin_s} to {end_s} s"
        for finding in findings(record, (begin, end), layout, expected):
            if finding.hard and not section.trust:
                # A channel that never changes may be the cause, and only the refusal is seen.
                text = "; ".join([finding.text, *dead])
                raise InputError(f"{where}: {text} ({_TRUST})")
            yield f"{where}: {finding.text}"


def _used(study: Study, record: Record) -> list[tuple[int, int]]:
    """Spans of samples that a study reads, merged where they overlap; none are missing."""
    starts = starts_of(study, record.rate_hz)
    before = [
        study.samples_before(record.rate_hz, **point) for point in study.combinations(*COARSE_KEYS)
    ]
    fine = max(span.read for span in study.distinct_spans) * study.record_every
    needed, coarse = max(before) + fine, ""
    if max(before):
        lengths = [f"{format_seconds(count / record.rate_hz)} s" for count in (max(before), fine)]
        coarse = f" ({lengths[0]} of coarse alignment + {lengths[1]})"
    merged: list[tuple[int, int]] = []
    for start in sorted(starts.tolist()):
        require_span(record, start / record.rate_hz, needed / record.rate_hz, coarse)
        if merged and start <= merged[-1][1]:
            merged[-1] = merged[-1][0], start + needed
        else:
            merged.append((start, start + needed))
    assert study.record is not None
    end = study.record.to_s
    if end is not None and merged[-1][1] / record.rate_hz > end * (1 + 1e-9):
        raise InputError(
            f"{record.source}: the study needs data up to"
            f" {format_seconds(merged[-1][1] / record.rate_hz)} s, but [record] to_s is"
            f" {format_seconds(end)}"
        )
    return merged


def _rough_surges(study: Study) -> Iterator[str]:
    """The acceleration of first-order surges, which the sample rate decides."""
    keys = ("surge_model", "surge_m_per_s", "surge_time_s")
    worst = 0.0
    for model, surge, time in (tuple(p[key] for key in keys) for p in study.combinations(*keys)):
        if model == "gauss_markov" and surge is not None and time is not None:
            changes = np.sqrt(-2 * np.expm1(-1 / (time * study.rate_hz)))
            worst = max(worst, float(np.max(surge)) * changes * study.rate_hz)
    if worst:
        yield (
            f"[motion] surge_model: the acceleration of a 'gauss_markov' surge grows with the rate,"
            f" {worst:.3g} m/s^2 rms at {study.rate_hz:g} Hz"
        )


def _fast_sways(study: Study) -> Iterator[str]:
    """Warnings about sways above the Nyquist frequency."""
    half = study.rate_hz / 2
    for angle in ("pitch", "roll", "yaw"):
        amplitude, period = f"{angle}_amplitude_deg", f"{angle}_period_s"
        points = list(study.combinations(amplitude, period))
        periods = [p[period] for p in points if p[amplitude] or amplitude in study.drawn_keys]
        if periods and period in study.drawn_keys:
            periods = sampling.values(study, min(study.n_draws, _DRAWS))[period].tolist()
        if periods and 1 / min(periods) > half:
            yield (
                f"[motion] {period}: a sway of {1 / min(periods):.4g} Hz is above half of rate_hz ="
                f" {study.rate_hz:g}, so it is aliased to a slower one"
            )

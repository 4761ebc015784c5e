"""The rules between the keys of a study, checked before anything runs; the end lists them.

A rule is a function that refuses a study with ``[section] key: what is wrong (way on)``.
Rules hold for every variant, and are checked over the distinct combinations of the values of their
keys: a sweep of a million variants costs no more than its axes.

The usual ranges of numbers are part of their keys, see `value_types.KeyInfo`, and generous: a value
outside is most likely a mistake or in another unit. ``[study] unchecked = true`` accepts it.
"""

import math
import statistics
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NoReturn

import numpy as np

from sinsjax import columns
from sinsjax.errors import ErrorCollector, InputError
from sinsjax.messages import shorten
from sinsjax.methods.filters.keys import RESET_KEYS, SCHEDULE_KEYS, scheduled_reset_times
from sinsjax.methods.registry import METHODS, unread_keys
from sinsjax.study import sampling, search_space, success
from sinsjax.study.attitude_file import refuse_other_angles
from sinsjax.study.keys import (
    COARSE_KEYS,
    EARTH_CONSTANTS,
    KEYS,
    PASS_KEYS,
    SECTION_OF,
    SECTIONS,
    has_effect,
    key_summary,
)
from sinsjax.study.measurement_noise import check_measurement_noise
from sinsjax.study.process_noise import check_process_noise
from sinsjax.study.reset_schedules import DERIVED, LAW_KEYS, check_law
from sinsjax.study.schema import NUMBERS_DRAWN, Distribution
from sinsjax.study.study import Study
from sinsjax.study.sweep import value_error
from sinsjax.study.turns import check_turn_keys, check_turns
from sinsjax.study.variants import Variants
from sinsjax.value_types import ROUNDING, KeyCondition

KeyTables = Mapping[str, str]
"""The table, in brackets, that gives, sweeps or draws a key, for each key of a file."""

_MAX_SAMPLES, _MAX_RUNS = 10**8, 10**9
_DRAWS_PER_BLOCK = 2**19  # draws that are checked together, which bounds the memory
_MAX_CHECKED_DRAWS = (
    2**22
)  # about one second; of more draws, only the limits of the law are checked
_MAX_SIGMAS = 8.3  # the furthest of 2^52 points of a normal law
_MAX_DEPTH = 0.99  # of the radius, since the polar radius of an ellipsoid is smaller

ACCEPT_HINT = "[study] unchecked = true accepts it"


def broken_rules(study: Study, key_tables: KeyTables) -> tuple[str, ...]:
    """Return a line for each rule that a study breaks, those of the first stage with any.

    Args:
        study: sections, axes and cases, each value checked.
        key_tables: table of each key that the file gives.
    """
    timed = TIME_RULES if study.study.rate_hz else ()  # else the record will give the rate
    for stage in ((_check_required_keys,), PRESENCE_RULES, *timed, VALUE_RULES):
        errors = ErrorCollector()
        for rule in stage:
            with errors.collect():
                rule(study, key_tables)
        if errors.lines:
            return tuple(errors.lines)
    return ()


class _CheckedKeys(Variants):
    """A study as the rules of its methods see it: its keys with the tables that give them."""

    def __init__(self, study: Study, key_tables: KeyTables) -> None:
        super().__init__(study, np.arange(study.n_variants))
        self._key_tables, self.end = key_tables, _describe_end(study)

    def place(self, key: str) -> str | None:
        """Return the table, in brackets, that gives a key; None if it is left out."""
        return self._key_tables.get(key)

    def refuse(self, key: str, text: str) -> NoReturn:
        """Raise the error of a key."""
        _refuse_key(key, self._key_tables, text)


def _refuse_key(key: str, key_tables: KeyTables, text: str) -> NoReturn:
    _refuse_place(f"{key_tables.get(key, f'[{SECTION_OF[key]}]')} {key}", text)


def _refuse_place(place: str, text: str) -> NoReturn:
    raise InputError(f"{place}: {text}")


def _check_required_keys(study: Study, key_tables: KeyTables) -> None:
    """Refuse missing keys, and keys without effect, because of the values of other keys."""
    errors, simulated = ErrorCollector(), not study.is_recorded

    def refuse(key: str, text: str) -> None:
        with errors.collect():
            _refuse_key(key, key_tables, text)

    untimed = (
        study.record and study.record.format in ("csv", "parquet") and not study.record.time_column
    )
    if "rate_hz" not in key_tables and (simulated or untimed):
        reason = "without a time_column in [record]" if untimed else key_summary("study", "rate_hz")
        refuse("rate_hz", f"required ({reason})")
    for key in ("latitude_deg", "yaw_center_deg") if simulated else ():
        from_file = key == "yaw_center_deg" and "attitude_file" in key_tables
        if key not in key_tables and not from_file:
            refuse(key, f"required ({key_summary(SECTION_OF[key], key)})")
    for angle in ("pitch", "roll", "yaw") if simulated else ():
        amplitude, period = f"{angle}_amplitude_deg", f"{angle}_period_s"
        sways = amplitude in study.drawn_keys or any(
            p[amplitude] for p in study.combinations(amplitude)
        )
        if period not in key_tables and sways:
            refuse(period, f"required with {amplitude} > 0")
    if all(point["earth"] != "constants" for point in study.combinations("earth")):
        for key in EARTH_CONSTANTS:
            if key in key_tables:
                refuse(key, "requires earth = 'constants' (drop it with 'wgs84')")
    errors.raise_all()


def _check_study_size(study: Study, key_tables: KeyTables) -> None:
    """Refuse a study that no machine could run, from the lengths of its axes alone."""
    settings = study.study
    if settings.duration_s * settings.rate_hz > _MAX_SAMPLES * (1 + ROUNDING):
        text = f"{settings.duration_s:.12g} s at rate_hz = {settings.rate_hz:.12g}"
        hint = "is time_unit right?" if study.is_recorded else "shorten the run"
        _refuse_key(
            "duration_s", key_tables, f"{text} is more than {_MAX_SAMPLES} samples per run ({hint})"
        )
    if study.n_draws * study.n_variants > _MAX_RUNS:
        key = "start_s" if study.is_recorded else "draws"
        text = f"{study.n_draws} draws x {study.n_variants} variants of [axes] and [[cases]]"
        _refuse_key(key, key_tables, f"{text} are more than {_MAX_RUNS} runs (reduce one of them)")


def _check_intervals(study: Study, key_tables: KeyTables) -> None:
    """Refuse times that are not whole numbers of samples, and runs without a record time."""
    rate, record = study.rate_hz, study.study.record_interval_s
    _check_whole_samples(study, key_tables, "record_interval_s", record)
    for point in study.combinations("feedback_interval_s"):
        if point["feedback_interval_s"] is not None:
            _check_whole_samples(
                study, key_tables, "feedback_interval_s", point["feedback_interval_s"]
            )
    for point in study.combinations("coarse_duration_s") if study.coarse else ():
        _check_whole_samples(
            study, key_tables, "coarse_duration_s", point["coarse_duration_s"], least=2
        )
    start_by_sample: dict[int, float] = {}
    for start in study.record.start_s if study.record else ():
        _check_whole_samples(study, key_tables, "start_s", start, least=0)
        if start_by_sample.setdefault(round(start * rate), start) != start:
            _refuse_key(
                "start_s", key_tables, f"{start!r} s is the sample of another start time (drop one)"
            )
    if study.study.duration_s < record * (1 - ROUNDING):
        duration = f"duration_s = {study.duration_s:.12g}"
        _refuse_key(
            "record_interval_s", key_tables, f"{record:.12g} s is longer than a run, {duration}"
        )


def _check_passes(study: Study, key_tables: KeyTables) -> None:
    """Refuse a stored record of a wrong length, and passes that do not fit into the run."""
    duration = study.duration_s * (1 + ROUNDING)
    for point in study.combinations(*PASS_KEYS) if study.passes else ():
        record_s, passes = point["stored_s"], point["passes"]
        rewinds = point["direction"] == "rewind"
        if record_s is None:
            if (passes or 1) > 1:
                _refuse_key(
                    "passes", key_tables, f"{passes} passes need a stored record (give stored_s)"
                )
            continue
        _check_record_multiple(study, key_tables, "stored_s", record_s)
        if record_s > duration:
            _refuse_key(
                "stored_s",
                key_tables,
                f"{record_s:.12g} s is longer than a run ({_describe_end(study)})",
            )
        if passes and passes * record_s > duration:
            text = f"{passes} passes of {record_s:.12g} s take {passes * record_s:.12g} s"
            _refuse_key("passes", key_tables, f"{text}, longer than a run ({_describe_end(study)})")
        if passes and passes % 2 == 0 and point["ending"] == "forward" and not rewinds:
            text = f"{passes} passes end backward, which ending = 'forward' excludes"
            _refuse_key("passes", key_tables, f"{text} (give an odd number)")


def _check_coarse_method(study: Study, key_tables: KeyTables) -> None:
    """Refuse a method of coarse alignment with which no run can start."""
    for point in study.combinations(*COARSE_KEYS) if study.coarse else ():
        method, _, then = (point[key] for key in COARSE_KEYS)
        if study.is_recorded and method == "none":
            text = "'none' needs an initial attitude, which a record does not give"
            _refuse_key("coarse_method", key_tables, f"{text} (use 'inertial')")
        if method == "analytic" and study.has_coarse_stage(method, then):
            text = "'analytic' can only hand over a record (use 'inertial')"
            _refuse_key("coarse_method", key_tables, text)


def _check_reset_law(study: Study, key_tables: KeyTables) -> None:
    """Refuse a law of resets for a band that noise exceeds, and policies that look the same."""
    if study.has("resets") and study.names_schedules:
        keys = [key for key in (*LAW_KEYS, *DERIVED) if study.is_readable(key)]
        for point in study.given_combinations(*keys):
            check_law(study.rate_hz, study.run_s, dict.fromkeys(LAW_KEYS) | point)
        if any(len(set(points)) < len(points) for points in study.axes_shown.values()):
            text = "a name is there twice, and its times differ from run to run"
            _refuse_key("schedule", key_tables, f"{text} (list it in [[cases]], with a case each)")


def _check_coarse_times(study: Study, key_tables: KeyTables) -> None:
    """Refuse coarse alignment that leaves no time for the method, and resets before its end."""
    record_interval_s = study.record_every / study.rate_hz
    stored = ("stored_s",) if study.passes else ()
    resets = RESET_KEYS if study.has("resets") else ()
    for point in study.combinations(*COARSE_KEYS, *stored, *resets) if study.coarse else ():
        method, length_s, then = (point[key] for key in COARSE_KEYS)
        if not study.has_coarse_stage(method, then):
            continue
        _check_record_multiple(study, key_tables, "coarse_duration_s", length_s)
        end_s = min(study.run_s - record_interval_s, point.get("stored_s") or math.inf)
        if length_s > end_s * (1 + ROUNDING):
            text = f"{length_s:.12g} s leaves no time for the method (at most {end_s:.12g})"
            _refuse_key("coarse_duration_s", key_tables, text)
        times = scheduled_reset_times(*(point[key] for key in SCHEDULE_KEYS)) if resets else ()
        if then == "replay" or not times:
            continue
        if (first_s := min(times)) <= length_s:
            key = "reset_times_s" if point["reset_times_s"] is not None else "reset_count"
            text = f"the reset at {first_s:.12g} s is not after the end of coarse alignment"
            _refuse_key(key, key_tables, f"{text}, at {length_s:.12g} s (reset later)")
        interval_s = point["feedback_interval_s"]
        if point["reset_at_feedback"] and _count_samples(study, length_s) % _count_samples(
            study, interval_s
        ):
            text = (
                f"coarse alignment of {length_s:.12g} s is not a whole number of feedback intervals"
            )
            _refuse_key(
                "reset_at_feedback", key_tables, f"{text} (feedback_interval_s = {interval_s:.12g})"
            )


def _count_samples(study: Study, time_s: float) -> int:
    return round(time_s * study.rate_hz)


def _check_record_multiple(study: Study, key_tables: KeyTables, key: str, time: float) -> None:
    """Refuse a time that is not a whole number of record intervals."""
    record = study.study.record_interval_s
    count = time / record
    if abs(count - round(count)) > ROUNDING * count or round(count) < 1:
        near = sorted({max(1, math.floor(count)), max(1, math.ceil(count))})
        shown = " or ".join(f"{n * record:.12g}" for n in near)
        text = f"{time:.12g} s is not a whole number of record intervals of {record:.12g} s"
        _refuse_key(key, key_tables, f"{text} (nearest: {shown})")


def _check_whole_samples(
    study: Study, key_tables: KeyTables, key: str, time: float, *, least: int = 1
) -> None:
    """Refuse a time that is not a whole number of samples, or less than ``least`` of them.

    For a record, whose rate is given, the time is rounded to a whole number of samples.
    """
    rate, samples = study.rate_hz, time * study.rate_hz
    deviation = 0.0 if study.is_recorded else abs(samples - round(samples))
    if deviation > ROUNDING * samples or round(samples) < least:
        counts = {max(least, math.floor(samples)), max(least, math.ceil(samples))}
        near = " or ".join(f"{n / rate:.12g}" for n in sorted(counts))
        at_least = f", {least} or more" if least > 1 else ""
        text = f"{time:.12g} s is not a whole number of samples of {1 / rate:.12g} s{at_least}"
        is_slow = study.is_recorded and rate < 1
        hint = f"{rate:.6g} Hz: is time_unit right?" if is_slow else f"nearest: {near}"
        _refuse_key(key, key_tables, f"{text} ({hint})")


def _check_statistics_window(study: Study, key_tables: KeyTables) -> None:
    """Refuse a window in which no run has the two record times of a standard deviation.

    Some of the runs may end before the window.
    """
    (start, end), record_every, rate = study.study.window_s, study.record_every, study.rate_hz
    longest = max(span.records for span in study.distinct_spans)
    last = min(longest, int(end * rate / record_every) + 1)
    # Compared as the engine does, rounding and all.
    while last * record_every / rate > end:
        last -= 1
    if (last - 1) * record_every / rate <= start:
        text = f"fewer than 2 record times are after {start:.12g} s and up to {end:.12g} s"
        _refuse_key("window_s", key_tables, f"{text} (widen it; {_describe_end(study)})")


def _check_report_times(study: Study, key_tables: KeyTables) -> None:
    """Refuse report times that are not record times of every run."""
    key, rate, record_every = "report_times_s", study.rate_hz, study.record_every
    counts_before = {0}
    if study.counts_before:
        coarse = study.combinations(*COARSE_KEYS)
        counts_before = {study.samples_before(rate, **point) for point in coarse}
    for time in study.report_times_s:
        _check_record_multiple(study, key_tables, key, time)
        if time > (min(counts_before) / rate + study.run_s) * (1 + ROUNDING):
            _refuse_key(
                key, key_tables, f"{time:.12g} s is not within the run ({_describe_end(study)})"
            )
        for samples_before in sorted(counts_before, reverse=True):
            runs = f"runs after coarse alignment of {samples_before / rate:.12g} s"
            if round(time * rate) <= samples_before:
                _refuse_key(
                    key, key_tables, f"{time:.12g} s is before the first record time of {runs}"
                )
            if samples_before % record_every:
                _refuse_key(key, key_tables, f"{time:.12g} s is between two record times of {runs}")


def _check_success_criteria(study: Study, key_tables: KeyTables) -> None:
    """Refuse a success that no run can reach, and bands whose columns would share a name."""
    names = [columns.settle_column(band).name for band in success.settling_bands(study)]
    if len(set(names)) < len(names):
        key = (
            "success_band_arcmin" if "success_band_arcmin" in key_tables else "settle_bands_arcmin"
        )
        text = "two bands agree to the 6 digits of their column names (drop one)"
        _refuse_key(key, key_tables, text)
    dwell = study.study.dwell_s
    if dwell is not None and dwell >= study.run_s:
        _refuse_key(
            "dwell_s",
            key_tables,
            f"{dwell:.12g} s is not shorter than the run ({_describe_end(study)})",
        )


def _describe_end(study: Study) -> str:
    """Return the end of a study and of its shortest run, as text."""
    text = f"duration_s = {study.duration_s:.12g}"
    whole_s = study.duration_s - study.dropped_s
    if study.dropped_s:
        text += f"; the last partial record interval, after {whole_s:.12g} s, is not run"
    if study.run_s < whole_s * (1 - ROUNDING):
        text += f"; the shortest run ends at {study.run_s:.12g} s"
    return text


def _check_stop_when(study: Study, key_tables: KeyTables) -> None:
    """Refuse a statistic that the study does not have, and a share that is always met."""
    if study.stop_when is None:
        return
    bands = success.settling_bands(study)
    known = ["success_rate", *(f"{columns.settle_column(band).name}_mean" for band in bands)]
    if study.stop_when.statistic not in known:
        text = f"'{shorten(study.stop_when.statistic, 60)}' is not one of {', '.join(known)}"
        _refuse_key("statistic", key_tables, text)
    if study.stop_when.statistic == "success_rate" and study.stop_when.half_width >= 1:
        _refuse_key(
            "half_width",
            key_tables,
            f"must be less than 1, a share, not {study.stop_when.half_width:.12g}",
        )


def _check_rules_of_methods(study: Study, key_tables: KeyTables) -> None:
    """Apply the rules of the study's methods."""
    checked, errors = _CheckedKeys(study, key_tables), ErrorCollector()
    for rule in dict.fromkeys(rule for name in study.methods for rule in METHODS[name].all_rules):
        with errors.collect():
            rule(checked)
    errors.raise_all()


def _check_unreached_values(study: Study, key_tables: KeyTables) -> None:
    """Refuse values that no run reaches: times after its end, and keys that have no effect.

    A time may be after the end of some runs of a sweep if other runs with it are longer.
    """
    errors = ErrorCollector()
    for (name, key), entry in KEYS.items():
        if entry.info.time and name in SECTIONS and study.has(name):
            with errors.collect():
                _check_time_within_runs(study, key_tables, key)
    for name, section in SECTIONS.items():
        for condition in section.conditions if study.has(name) else ():
            if condition.refused:
                with errors.collect():
                    _check_has_effect(study, key_tables, name, condition)
    errors.raise_all()


def _check_time_within_runs(study: Study, key_tables: KeyTables, key: str) -> None:
    """Refuse a time that is after the end of all runs that use it."""
    entry = KEYS[SECTION_OF[key], key]
    latest: dict[float, float] = {}  # the end of the longest run with each value
    interval_s = study.study.record_interval_s
    passes = PASS_KEYS if study.passes else ()
    for point in study.combinations(key, *entry.depends_on, *passes):
        value = point[key]
        span = study.span(**{k: point[k] for k in passes})
        last = value[-1] if isinstance(value, tuple) and value else value
        filled_in = entry.info.default is not None and last == entry.info.default
        if last in (None, ()) or filled_in or not has_effect(key, point):
            continue
        time_s = last * span.pass_records * interval_s if entry.info.time == "pass" else last
        latest[time_s] = max(latest.get(time_s, 0.0), span.records * interval_s)
    for time_s, end in latest.items():
        if time_s > end * (1 + ROUNDING):
            text = f"{time_s:.12g} s is after the end of all runs that use it, at {end:.12g} s"
            _refuse_key(key, key_tables, f"{text} (give an earlier time, or longer runs)")


def _check_has_effect(
    study: Study, key_tables: KeyTables, section: str, condition: KeyCondition
) -> None:
    """Refuse values of keys, other than their defaults, that have no effect."""
    for key in condition.keys:
        default: Any = SECTIONS[section].model_fields[key].default
        for point in study.combinations(key, *condition.given):
            values = [point[given] for given in condition.given]
            if point[key] != default and not condition.acts(*values):
                given = next(k for k in condition.given if k in key_tables)
                text = f"has no effect with {given} in {key_tables[given]} (give one of them)"
                raise InputError(f"{key_tables.get(key, f'[{section}]')} {key}: {text}")


def _check_plausible_values(study: Study, key_tables: KeyTables) -> None:
    """Refuse unusual values, except those of drawn keys, which `_check_drawn_values` checks."""
    if study.study.unchecked:
        return
    errors = ErrorCollector()
    for section in SECTIONS:
        section_values = getattr(study, section)
        for key in SECTIONS[section].model_fields if section_values else ():
            value = getattr(section_values, key)
            if value is not None and KEYS[section, key].info.usual_range:
                with errors.collect():
                    _check_value(f"[{section}] {key}", section, key, value)
    for dimension in study.dimensions:
        for key, values in dimension.items():
            for value in dict.fromkeys(values) if key != "case" else ():
                if describe_implausible(key, value):
                    with errors.collect():
                        place = f"{key_tables[key]} {key}[{values.index(value)}]"
                        _check_value(place, SECTION_OF[key], key, value)
    errors.raise_all()


def describe_implausible(key: str, value: Any) -> str | None:
    """Return the question about an unusual value of a leaf key; None for a usual value."""
    for index, number in _iter_numbers(value):
        if text := _describe_out_of_range(SECTION_OF[key], key, number):
            return f"{index}{text}"
    return None


def _check_value(place: str, section: str, key: str, value: Any) -> None:
    for index, number in _iter_numbers(value):
        if text := _describe_out_of_range(section, key, number):
            raise InputError(f"{place}{index}: {text}")


def _describe_out_of_range(section: str, key: str, number: float) -> str | None:
    low, high = KEYS[section, key].info.usual_range or (-math.inf, math.inf)
    if low <= number <= high:
        return None
    return f"{number:.12g} is outside the usual range of {low:g} to {high:g} ({ACCEPT_HINT})"


def _iter_numbers(value: Any, index: str = "") -> Iterator[tuple[str, float]]:
    """Yield the numbers of a value, each after its index in lists."""
    if isinstance(value, tuple):
        for i, entry in enumerate(value):
            yield from _iter_numbers(entry, f"{index}[{i}]")
    elif isinstance(value, int | float):
        yield index, float(value)


def _check_feedback_interval(study: Study, key_tables: KeyTables) -> None:
    """Refuse a feedback interval that is longer than any run."""
    if study.study.unchecked or not study.study.rate_hz:
        return
    longest = max(span.records for span in study.distinct_spans) * study.record_every
    run_s = longest / study.rate_hz
    for point in study.combinations("feedback_interval_s"):
        interval = point["feedback_interval_s"]
        if interval is not None and interval > run_s * (1 + ROUNDING):
            text = f"{interval:.12g} s is longer than a run of {run_s:.12g} s: there is no feedback"
            place = key_tables.get("feedback_interval_s", "[alignment]")
            _refuse_place(f"{place} feedback_interval_s", f"{text} ({ACCEPT_HINT})")


def _check_earth_centre(study: Study, key_tables: KeyTables) -> None:
    """Refuse a place at the centre of the Earth, without north, east and up."""
    for point in study.combinations("height_m", "radius_m"):
        radius = point["radius_m"] or EARTH_CONSTANTS["radius_m"]
        if point["height_m"] is not None and point["height_m"] <= -_MAX_DEPTH * radius:
            text = (
                f"{point['height_m']:.12g} m reaches the centre of the Earth (give the height in m)"
            )
            raise InputError(f"{key_tables.get('height_m', '[earth]')} height_m: {text}")


def _check_drawn_values(study: Study, key_tables: KeyTables) -> None:
    """Refuse drawn values that their key does not accept, and list entries that no draw reaches.

    Draws are checked one by one if their law does not exclude such values, unless there are too
    many of them.
    """
    laws = study.drawn.laws if study.drawn else {}
    _check_list_lengths(study, laws)
    unchecked = bool(study.study.unchecked)
    unbounded_keys = [
        k
        for k, law in laws.items()
        if any(_drawn_value_error(k, v, unchecked) for v in _law_limits(law))
    ]
    errors = ErrorCollector()
    if study.n_draws > _MAX_CHECKED_DRAWS:
        for key in unbounded_keys:
            for value in _law_limits(laws[key], _extreme_sigmas(study.n_draws)):
                if text := _drawn_value_error(key, value, unchecked):
                    text = f"one of {study.n_draws} draws may give {value:.6g}: {text}"
                    raise InputError(f"[drawn] {key}: {text}")
        return
    for first in range(0, study.n_draws if unbounded_keys else 0, _DRAWS_PER_BLOCK):
        count = min(_DRAWS_PER_BLOCK, study.n_draws - first)
        drawn = sampling.drawn_values(study, count, first=first)
        for key, rows in ((key, drawn[key]) for key in unbounded_keys):
            with errors.collect():
                for position in map(int, (rows.argmin(), rows.argmax())):
                    value = float(rows.flat[position])
                    if text := _drawn_value_error(key, value, unchecked):
                        draw = first + position // NUMBERS_DRAWN[key]
                        raise InputError(f"[drawn] {key}: draw {draw} gives {value!r}: {text}")
        errors.raise_all()


def _check_list_lengths(study: Study, laws: Mapping[str, Distribution]) -> None:
    """Refuse lists of values and grids that are longer than the number of draws."""
    draws = f"{study.n_draws} {'start times' if study.is_recorded else 'draws'}"
    for key, law in laws.items():
        if law.values and len(law.values) > study.n_draws:
            text = f"has {len(law.values)} entries for {draws} (drop those that are never drawn)"
            raise InputError(f"[drawn] {key}.values: {text}")
    grids = {key: len(law.grid) for key, law in laws.items() if law.grid}
    if math.prod(grids.values()) > study.n_draws and grids:
        text = f"{math.prod(grids.values())} points of the grid of {', '.join(grids)}"
        text = f"{text} are more than {draws} (drop some, or draw more)"
        raise InputError(f"[drawn] {next(iter(grids))}.grid: {text}")


def _extreme_sigmas(draws: int) -> float:
    """Return the sigmas that one of many normal draws exceeds with probability 0.001."""
    return min(_MAX_SIGMAS, statistics.NormalDist().inv_cdf(1 - 1e-3 / draws))


def _law_limits(law: Distribution, sigmas: float = _MAX_SIGMAS) -> tuple[float, ...]:
    """Return the limits of the values of a law, of a normal one within some sigmas."""
    if law.uniform:
        return law.uniform
    if law.normal:
        mean, deviation = law.normal
        return mean - sigmas * deviation, mean + sigmas * deviation
    numbers = [n for entry in law.values or law.grid or () for n in np.ravel(entry).tolist()]
    return min(numbers), max(numbers)


def _drawn_value_error(key: str, value: float, unchecked: bool) -> str | None:
    """Return the error text of a drawn number; None if it is valid."""
    return value_error(value, key) or (None if unchecked else describe_implausible(key, value))


def _check_tune_section(study: Study, key_tables: KeyTables) -> None:
    """Refuse a [tune] that conflicts with the rest of its study."""
    tune = study.tune
    if tune is None:
        return
    if study.stop_when:
        _refuse_place("[stop_when]", "conflicts with [tune], which fixes its draws (drop one)")
    if study.record and len(study.record.start_s) < 2:
        text = "tuning needs two start times or more, to search and to evaluate"
        _refuse_place("[record] start_s", text)
    bands = success.settling_bands(study)
    if tune.objective_band_arcmin not in bands:
        text = f"{tune.objective_band_arcmin:g} is not one of {', '.join(f'{b:g}' for b in bands)}"
        hint = "settle_bands_arcmin and success_band_arcmin"
        _refuse_place("[tune] objective_band_arcmin", f"{text} ({hint})")
    unread = unread_keys(study.methods) & tune.variables.keys()
    if unread and "method" not in tune.variables:
        text = f"does not apply to method {' or '.join(sorted(study.methods))} (tune other keys)"
        _refuse_place(f"[tune.variables] {min(unread)}", text)
    space = search_space.SearchSpace.from_study(study)
    max_variables = max(
        (len(space.used_variables(point)) for point in space.combinations), default=0
    )
    if "grid" in tune.searches and max_variables > search_space.MAX_GRID_VARIABLES:
        text = (
            f"'grid' is for up to {search_space.MAX_GRID_VARIABLES} variables, not {max_variables}"
        )
        _refuse_place("[tune] searches", f"{text} (use 'sobol')")
    if "gradient" in tune.searches and not max_variables and tune.variables:
        _refuse_place(
            "[tune] searches", "'gradient' needs a variable with low and high (use 'grid')"
        )


StudyRule = Callable[[Study, KeyTables], None]

PRESENCE_RULES: tuple[StudyRule, ...] = (
    check_process_noise,
    check_measurement_noise,
    check_turn_keys,
    refuse_other_angles,
)
"""Rules for the presence of keys."""

TIME_RULES: tuple[tuple[StudyRule, ...], ...] = (
    (_check_study_size, _check_intervals),
    (_check_passes,),
    (
        _check_coarse_method,
        _check_coarse_times,
        check_turns,
        _check_reset_law,
        _check_statistics_window,
        _check_report_times,
        _check_success_criteria,
        _check_stop_when,
        _check_rules_of_methods,
    ),
    (_check_unreached_values,),
    (_check_tune_section,),
)
"""Rules for times and counts, which need the sample rate; each stage relies on the earlier ones."""

VALUE_RULES: tuple[StudyRule, ...] = (
    _check_earth_centre,
    _check_plausible_values,
    _check_feedback_interval,
    _check_drawn_values,
)
"""Rules for values alone, such as their usual ranges."""

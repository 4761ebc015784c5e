"""The rules between the keys of a study, checked before anything runs; the end lists them.

A rule is a function that refuses a study with ``[section] key: what is wrong (way on)``, over the
distinct combinations of the values of its keys: a sweep of a million variants costs no more than
its axes. Usual ranges of numbers are part of their keys, see `value_types.KeyInfo`.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np

from sinsjax import columns
from sinsjax.errors import ErrorCollector, InputError
from sinsjax.messages import shorten
from sinsjax.methods.filters.keys import (
    RESET_KEYS,
    SCHEDULE_KEYS,
    TRIGGER_KEYS,
    has_trigger,
    scheduled_reset_times,
)
from sinsjax.methods.registry import METHODS, unread_keys
from sinsjax.study import search_space, success
from sinsjax.study.filter_noise import NOISE_RULES
from sinsjax.study.keys import (
    COARSE_KEYS,
    KEYS,
    PASS_KEYS,
    SECTION_OF,
    SECTIONS,
    SWEEPABLE,
    Key,
    deciding_keys,
    has_effect,
    key_summary,
    leaf_info,
    reading_methods,
)
from sinsjax.study.motion import check_turns, refuse_drawn_motion
from sinsjax.study.study import Study
from sinsjax.study.sweep import value_error
from sinsjax.study.values import Variants, drawn_values
from sinsjax.value_types import ROUNDING, KeyInfo

_MAX_SAMPLES, _MAX_RUNS = 10**8, 10**9
_CHECKED_DRAWS = 2**19  # which bounds the memory


def check_rules(study: Study) -> None:
    """Refuse a study that breaks rules, with a line for each of the first stage with any."""
    for always, timed in ((_PRESENCE, _LENGTHS), (_VALUES, _TIMES)):
        has_rate = bool(study.study.rate_hz)  # a record gives it later
        _check_all([partial(rule, study) for rule in (*always, *(timed if has_rate else ()))])


def _check_all(rules: Iterable[Callable[[], None]]) -> None:
    """Apply some rules, and raise their errors as one."""
    errors = ErrorCollector()
    for rule in rules:
        with errors.collect():
            rule()
    errors.raise_all()


def _refuse_all(study: Study, texts: Mapping[str, str]) -> None:
    """Refuse some keys, each with its text."""
    _check_all([partial(study.refuse, key, text) for key, text in texts.items()])


def _check_required_keys(study: Study) -> None:
    """Refuse keys that are missing because of the values of other keys."""
    found, record, simulated = dict[str, str](), study.record, not study.is_recorded
    untimed = record and record.format in ("csv", "parquet") and not record.time_column
    if not study.gives("rate_hz") and (simulated or untimed):
        reason = "without a time_column in [record]" if untimed else key_summary("study", "rate_hz")
        found["rate_hz"] = f"required ({reason})"
    for key in ("latitude_deg", "yaw_center_deg") if simulated else ():
        from_file = key == "yaw_center_deg" and study.gives("attitude_file")
        values = {point[key] for point in study.combinations(key)}
        if None in values and key not in study.drawn_keys and not from_file:
            found[key] = f"required ({key_summary(SECTION_OF[key], key)})"
    for angle in ("pitch", "roll", "yaw") if simulated else ():
        amplitude, period = f"{angle}_amplitude_deg", f"{angle}_period_s"
        sways = any(point[amplitude] != 0 for point in study.combinations(amplitude))
        if sways and not study.gives(period):
            found[period] = f"required with {amplitude} > 0"
    _refuse_all(study, found)


def _check_trigger_and_threshold(study: Study) -> None:
    """Refuse a trigger without a threshold, and keys of triggers without a trigger."""
    keys = ("reset_trigger", "trigger_threshold")
    points = list(study.combinations(*keys)) if study.has("resets") else []
    triggered = [point for point in points if has_trigger(point["reset_trigger"])]
    for point in triggered:
        if point["trigger_threshold"] is None:
            text = f"required with reset_trigger = '{point['reset_trigger']}'"
            study.refuse("trigger_threshold", text)
    for key in TRIGGER_KEYS if points and not triggered else ():
        if study.gives(key):
            study.refuse(key, "requires a reset_trigger (give one, or drop this)")


def _refuse_excluded_keys(study: Study) -> None:
    """Refuse keys that have no effect with the values of keys that exclude them."""
    found = dict[str, str]()
    sections = [section for name, section in SECTIONS.items() if study.has(name)]
    for section, condition in ((s, c) for s in sections for c in s.conditions if c.refused):
        if not condition.acts_at(study.combinations(*condition.given)):
            for key in condition.keys:
                default = section.model_fields[key].default
                if any(point[key] != default for point in study.combinations(key)):
                    values = ", ".join(condition.given)
                    found[key] = f"has no effect with the value of {values} (drop one)"
    _refuse_all(study, found)


def _check_study_size(study: Study) -> None:
    """Refuse a study that no machine could run, from the lengths of its axes alone."""
    settings = study.study
    if settings.duration_s * settings.rate_hz > _MAX_SAMPLES * (1 + ROUNDING):
        text = f"{settings.duration_s:.12g} s at rate_hz = {settings.rate_hz:.12g}"
        hint = "is time_unit right?" if study.is_recorded else "shorten the run"
        study.refuse("duration_s", f"{text} is more than {_MAX_SAMPLES} samples per run ({hint})")
    if study.n_draws * study.n_variants > _MAX_RUNS:
        key = "start_s" if study.is_recorded else "draws"
        text = f"{study.n_draws} draws x {study.n_variants} variants of [axes] and [[cases]]"
        study.refuse(key, f"{text} are more than {_MAX_RUNS} runs (reduce one of them)")


def _check_intervals_are_whole_samples(study: Study) -> None:
    """Refuse times that are not whole numbers of samples, and runs without a record time."""
    record = study.study.record_interval_s
    _check_whole_multiple(study, "record_interval_s", record, "samples")
    for key, least in (("feedback_interval_s", 1), ("coarse_duration_s", 2)):
        for point in study.combinations(key) if study.is_readable(key) else ():
            if point[key] is not None:
                _check_whole_multiple(study, key, point[key], "samples", least)
    if study.study.duration_s < record * (1 - ROUNDING):
        duration = f"duration_s = {study.study.duration_s:.12g}"
        study.refuse("record_interval_s", f"{record:.12g} s is longer than a run, {duration}")


def _check_passes_fit_into_run(study: Study) -> None:
    """Refuse a stored record of a wrong length, and passes that do not fit into the run."""
    duration = study.duration_s * (1 + ROUNDING)
    for point in study.combinations(*PASS_KEYS) if study.passes else ():
        record_s, passes = point["stored_s"], point["passes"]
        if record_s is None:
            if (passes or 1) > 1:
                study.refuse("passes", f"{passes} passes need a stored record (give stored_s)")
            continue
        _check_whole_multiple(study, "stored_s", record_s, "record intervals")
        if record_s > duration:
            study.refuse("stored_s", f"{record_s:.12g} s is longer than a run ({study.end})")
        if passes and passes * record_s > duration:
            text = f"{passes} passes of {record_s:.12g} s take {passes * record_s:.12g} s"
            study.refuse("passes", f"{text}, longer than a run ({study.end})")
        if passes and passes % 2 == 0 and point["ending"] == "forward":
            text = f"{passes} passes end backward, which ending = 'forward' excludes"
            study.refuse("passes", f"{text} (give an odd number)")


def _check_coarse_method(study: Study) -> None:
    """Refuse a method of coarse alignment with which no run can start."""
    for point in study.combinations(*COARSE_KEYS) if study.coarse else ():
        if study.is_recorded and point["coarse_method"] == "none":
            text = "'none' needs an initial attitude, which a record does not give"
            study.refuse("coarse_method", f"{text} (use 'inertial')")


def _check_reset_law(study: Study) -> None:
    """Refuse resets that the law cannot schedule, and schedules that look the same."""
    if study.names_schedules:
        list(study.combinations(*SCHEDULE_KEYS))
        if any(len(set(points)) < len(points) for points in study.axes_shown.values()):
            text = "a name is there twice (list its variants in [[cases]], with a case each)"
            study.refuse("schedule", text)


def _check_coarse_duration_and_resets(study: Study) -> None:
    """Refuse coarse alignment that leaves no time for the method, and resets before its end."""
    record_interval_s = study.record_every / study.rate_hz
    stored = ("stored_s",) if study.passes else ()
    resets = RESET_KEYS if study.has("resets") else ()
    for point in study.combinations(*COARSE_KEYS, *stored, *resets) if study.coarse else ():
        method, length_s, then = (point[key] for key in COARSE_KEYS)
        if not study.has_coarse_stage(method, then):
            continue
        _check_whole_multiple(study, "coarse_duration_s", length_s, "record intervals")
        end_s = min(study.run_s - record_interval_s, point.get("stored_s") or math.inf)
        if length_s > end_s * (1 + ROUNDING):
            text = f"{length_s:.12g} s leaves no time for the method (at most {end_s:.12g})"
            study.refuse("coarse_duration_s", text)
        times = scheduled_reset_times(*(point[key] for key in SCHEDULE_KEYS)) if resets else ()
        if then == "replay" or not times:
            continue
        if (first_s := min(times)) <= length_s:
            key = "reset_times_s" if point["reset_times_s"] is not None else "reset_count"
            text = f"the reset at {first_s:.12g} s is not after the end of coarse alignment"
            study.refuse(key, f"{text}, at {length_s:.12g} s (reset later)")
        interval_s = point["feedback_interval_s"]
        length, interval = (round(time * study.rate_hz) for time in (length_s, interval_s))
        if point["reset_at_feedback"] and length % interval:
            text = f"coarse alignment of {length_s:.12g} s is no whole number of feedback intervals"
            study.refuse("reset_at_feedback", f"{text} (feedback_interval_s = {interval_s:.12g})")


def _check_whole_multiple(study: Study, key: str, time: float, what: str, least: int = 1) -> None:
    """Refuse a time that is not a whole number of samples or record intervals, or too few of them.

    For a record, whose rate is given, the time is rounded to a whole number of samples.
    """
    step = study.study.record_interval_s if what == "record intervals" else 1 / study.rate_hz
    count, is_rounded = time / step, study.is_recorded and what == "samples"
    deviation = 0.0 if is_rounded else abs(count - round(count))
    if deviation > ROUNDING * count or round(count) < least:
        nearest = sorted({max(least, math.floor(count)), max(least, math.ceil(count))})
        hint = f"nearest: {' or '.join(f'{number * step:.12g}' for number in nearest)}"
        if is_rounded and study.rate_hz < 1:
            hint = f"{study.rate_hz:.6g} Hz: is time_unit right?"
        text = f"{time:.12g} s is not a whole number of {what} of {step:.12g} s"
        text += f", {least} or more" if least > 1 else ""
        study.refuse(key, f"{text} ({hint})")


def _check_window_has_two_record_times(study: Study) -> None:
    """Refuse a window in which no run has the two record times of a standard deviation."""
    (start, end), record_every, rate = study.study.window_s, study.record_every, study.rate_hz
    longest = max(span.records for span in study.distinct_spans)
    last = min(longest, int(end * rate / record_every) + 1)
    # Compared as the engine does, rounding and all.
    while last * record_every / rate > end:
        last -= 1
    if (last - 1) * record_every / rate <= start:
        text = f"fewer than 2 record times are after {start:.12g} s and up to {end:.12g} s"
        study.refuse("window_s", f"{text} (widen it; {study.end})")


def _check_report_times_are_record_times(study: Study) -> None:
    """Refuse report times that are not record times of every run."""
    rate, before = study.rate_hz, {0}  # samples
    if study.counts_before:
        before = {study.samples_before(rate, **p) for p in study.combinations(*COARSE_KEYS)}
    for time in study.report_times_s:
        _check_whole_multiple(study, "report_times_s", time, "record intervals")
        if time > (min(before) / rate + study.run_s) * (1 + ROUNDING):
            study.refuse("report_times_s", f"{time:.12g} s is not within the run ({study.end})")
        for count in before:
            if round(time * rate) <= count or count % study.record_every:
                text = f"{time:.12g} s is no record time of runs after coarse alignment of"
                study.refuse("report_times_s", f"{text} {count / rate:.12g} s")


def _check_dwell(study: Study) -> None:
    """Refuse a success that no run can reach."""
    dwell = study.study.dwell_s
    if dwell is not None and dwell >= study.run_s:
        study.refuse("dwell_s", f"{dwell:.12g} s is not shorter than the run ({study.end})")


def _check_stop_statistic_and_half_width(study: Study) -> None:
    """Refuse a statistic that the study does not have, and a share that is always met."""
    if study.stop_when is None:
        return
    statistic, width = study.stop_when.statistic, study.stop_when.half_width
    bands = success.settling_bands(study)
    known = ["success_rate", *(f"{columns.settle_column(band).name}_mean" for band in bands)]
    if statistic not in known:
        study.refuse("statistic", f"'{shorten(statistic, 60)}' is not one of {', '.join(known)}")
    if statistic == "success_rate" and width >= 1:
        study.refuse("half_width", f"must be less than 1, a share, not {width:.12g}")


def _check_rules_of_methods(study: Study) -> None:
    """Apply the rules of the study's methods."""
    variants = Variants.all_of(study)
    methods = [METHODS[name] for name in dict.fromkeys(study.methods)]
    rules = dict.fromkeys(rule for method in methods for rule in method.rules)
    checks = [method.check_passes_and_coarse_start for method in methods if not method.is_external]
    _check_all([partial(rule, variants) for rule in (*checks, *rules)])


def _check_times_within_runs(study: Study) -> None:
    """Refuse times after the end of all runs that use them; others of a sweep may be shorter."""
    sections = {name for name in SECTIONS if study.has(name)}
    times = [key for key in KEYS.values() if key.info.time and key.section in sections]
    _check_all([partial(_check_time_within_longest_run, study, key) for key in times])


def _check_time_within_longest_run(study: Study, key: Key) -> None:
    latest: dict[float, float] = {}  # the end of the longest run with each value
    interval_s = study.study.record_interval_s
    passes = PASS_KEYS if study.passes else ()
    for point in study.combinations(key.name, *key.depends_on, *passes):
        value, span = point[key.name], study.span(**{name: point[name] for name in passes})
        time_s = value[-1] if isinstance(value, tuple) and value else value
        is_filled_in = key.info.default is not None and time_s == key.info.default
        if time_s in (None, ()) or is_filled_in or not has_effect(key.name, point):
            continue
        latest[time_s] = max(latest.get(time_s, 0.0), span.records * interval_s)
    for time_s, end in latest.items():
        if time_s > end * (1 + ROUNDING):
            text = f"{time_s:.12g} s is after the end of all runs that use it, at {end:.12g} s"
            study.refuse(key.name, f"{text} (give an earlier time, or longer runs)")


def _refuse_implausible_values(study: Study) -> None:
    """Refuse unusual values, except those of drawn keys, which `_check_drawn_values` checks."""
    if study.study.unchecked:
        return
    errors = ErrorCollector()
    for (name, key), entry in KEYS.items():
        value = getattr(getattr(study, name, None), key, None)
        if text := _describe_unusual(entry.info, value):
            errors.add(f"[{name}] {key}{text}")
    for key, values in study.values_varied.items():
        for value in dict.fromkeys(values) if key != "case" else ():
            if text := _describe_unusual(leaf_info(key), value):
                errors.add(f"{study.given_in(key)} {key}[{values.index(value)}]{text}")
    errors.raise_all()


def _describe_unusual(info: KeyInfo, value: Any) -> str | None:
    """Return the index of an unusual number in a value, if a list, and the question about it."""
    if info.usual_range is None or value is None:
        return None
    low, high = info.usual_range
    for place, number in np.ndenumerate(np.asarray(value, float)):
        if not low <= number <= high:
            index = "".join(f"[{i}]" for i in place)
            text = f"{number:.12g} is outside the usual range of {low:g} to {high:g}"
            return f"{index}: {text} ([study] unchecked = true accepts it)"
    return None


def _check_drawn_values(study: Study) -> None:
    """Refuse draws that their key does not accept, and lists longer than the draws."""
    laws, found = study.drawn.laws if study.drawn else {}, dict[str, str]()
    for key, law in laws.items():
        if len(law.values or ()) > study.n_draws:
            draws = "start times" if study.is_recorded else "draws"
            text = f"{len(law.values or ())} are more than {study.n_draws} {draws}"
            raise InputError(f"[drawn] {key}.values: {text} (drop some, or draw more)")

        def problem_of(value: float, key: str = key) -> str | None:
            usual = None if study.study.unchecked else _describe_unusual(leaf_info(key), value)
            return value_error(value, key) or (usual and usual.removeprefix(": "))

        limits = law.limits
        if law.normal and any(map(problem_of, limits)):
            drawn = drawn_values(study, min(study.n_draws, _CHECKED_DRAWS))[key]
            limits = float(drawn.min()), float(drawn.max())
        for value in limits:
            if problem := problem_of(value):
                found.setdefault(key, f"may be drawn as {value!r}: {problem}")
    _refuse_all(study, found)


def _check_tune_section(study: Study) -> None:
    """Refuse a [tune] that conflicts with the rest of its study."""
    tune = study.tune
    if tune is None:
        return
    if study.stop_when:
        raise InputError("[stop_when]: conflicts with [tune], which fixes its draws (drop one)")
    if study.record and len(study.record.start_s) < 2:
        text = "tuning needs two start times or more, to search and to evaluate"
        raise InputError(f"[record] start_s: {text}")
    bands = success.settling_bands(study)
    if tune.objective_band_arcmin not in bands:
        text = f"{tune.objective_band_arcmin:g} is not one of {', '.join(f'{b:g}' for b in bands)}"
        hint = "settle_bands_arcmin and success_band_arcmin"
        raise InputError(f"[tune] objective_band_arcmin: {text} ({hint})")
    unread = unread_keys(study.methods) & tune.variables.keys()
    if unread and "method" not in tune.variables:
        text = f"does not apply to method {' or '.join(sorted(study.methods))} (tune other keys)"
        raise InputError(f"[tune.variables] {min(unread)}: {text}")
    space = search_space.SearchSpace.from_study(study)
    most = max((len(space.used_variables(point)) for point in space.combinations), default=0)
    if "grid" in tune.searches and most > search_space.MAX_GRID_VARIABLES:
        text = f"'grid' is for up to {search_space.MAX_GRID_VARIABLES} variables, not {most}"
        raise InputError(f"[tune] searches: {text} (use 'sobol')")
    if "gradient" in tune.searches and not most and tune.variables:
        text = "'gradient' needs a variable with low and high (use 'grid')"
        raise InputError(f"[tune] searches: {text}")


def describe_idle_keys(study: Study) -> list[str]:
    """List the keys that have no effect on any run of a study, in one line if there are any.

    Keys at their defaults are left out, and those that a tuning may give an effect.
    """
    tuned = {*study.tune.variables, *study.tune.baseline} if study.tune else set()
    idle: dict[str, dict[str, list[str]]] = {}  # keys by table, by the reason
    for key, table in _iter_varied_or_non_default_keys_and_tables(study):
        deciding = deciding_keys(key)
        if SECTION_OF[key] not in SWEEPABLE or not tuned.isdisjoint(deciding):
            continue
        if {*study.methods}.isdisjoint(reading_methods(key)):
            reason = f"method {' or '.join(sorted(study.methods))}"
        elif study.is_readable(key) and study.without_effect(key).all():
            others = [other for other in deciding if other != "method"] or ["coarse_method"]
            reason = f"the values of {', '.join(others)}"
        else:
            continue
        idle.setdefault(reason, {}).setdefault(table, []).append(key)
    parts = []
    for reason, tables in idle.items():
        verb = "has" if sum(map(len, tables.values())) == 1 else "have"
        listed = ", ".join(f"{table} {', '.join(keys)}" for table, keys in tables.items())
        parts.append(f"{listed} {verb} no effect with {reason}")
    return [f"{'; '.join(parts)}."] if parts else []


def _iter_varied_or_non_default_keys_and_tables(study: Study) -> Iterator[tuple[str, str]]:
    """Yield the keys that a study varies or changes from their defaults, and their tables."""
    for name in filter(study.has, SWEEPABLE):
        section, fields = getattr(study, name), SECTIONS[name].model_fields
        for key in (key for key in fields if key in section.model_fields_set):
            if getattr(section, key) != fields[key].default:
                yield key, f"[{name}]"
    for key in (*study.axis_keys, *study.drawn_keys):
        if key != "case":
            yield key, str(study.given_in(key))
    for name in ("variables", "baseline") if study.tune else ():
        yield from ((key, f"[tune.{name}]") for key in getattr(study.tune, name))


_PRESENCE = (
    _check_required_keys,
    _refuse_excluded_keys,
    *NOISE_RULES,
    _check_trigger_and_threshold,
    refuse_drawn_motion,
)
_LENGTHS = (_check_study_size, _check_intervals_are_whole_samples, _check_passes_fit_into_run)
_VALUES = (_refuse_implausible_values, _check_drawn_values)
_TIMES = (
    _check_coarse_method,
    _check_coarse_duration_and_resets,
    check_turns,
    _check_reset_law,
    _check_window_has_two_record_times,
    _check_report_times_are_record_times,
    _check_dwell,
    _check_stop_statistic_and_half_width,
    _check_rules_of_methods,
    _check_times_within_runs,
    _check_tune_section,
)

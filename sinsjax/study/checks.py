"""The rules between the keys of a study, checked before anything runs.

They hold for every variant, and are checked over the distinct values that the keys of a rule take
together: a sweep of a million variants costs no more than its axes.
"""

import math
from typing import NoReturn

from sinsjax import columns
from sinsjax.alignment.filters.section import OF_RESETS, OF_SCHEDULES, reset_times
from sinsjax.alignment.methods import METHODS, keys_unread
from sinsjax.errors import InputError
from sinsjax.study import estimating, ignored, success
from sinsjax.study.keys import COARSE_KEYS, EARTH_CONSTANTS, PASS_KEYS, SECTION_OF, SECTIONS
from sinsjax.study.study import Study
from sinsjax.study.times import counts_before, report_times, samples_before
from sinsjax.value_types import ROUNDING

Where = dict[str, str]
"""The table, in brackets, of every key that a file gives: that which sweeps or draws it if any."""

_MAX_SAMPLES, _MAX_RUNS = 10**8, 10**9


def check_study(study: Study, where: Where) -> None:
    """Checks the rules between keys for every variant.

    Args:
        study: sections, axes and cases, each value checked.
        where: the keys that the file gives.

    Raises:
        InputError: ``[section] key: what is wrong (hint)``.
    """
    _check_required(study, where)
    _check_methods(study, where)
    estimating.check(study, where)
    if not study.study.rate_hz:  # checked again once the record has told it
        return
    _check_size(study, where)
    _check_intervals(study, where)
    _check_passes(study, where)
    _check_coarse(study, where)
    _check_window(study, where)
    _check_report_times(study, where)
    _check_success(study, where)
    _check_stop(study, where)
    checked = _Checked(study, where)
    for check in dict.fromkeys(rule for name in study.methods for rule in METHODS[name].rules):
        check(checked)
    ignored.check(study, where)


class _Checked:
    """A study as the rules of its methods see it, see `alignment.description.CheckedStudy`."""

    def __init__(self, study: Study, where: Where) -> None:
        self._study, self._where = study, where
        self.rate_hz, self.run_s = study.rate_hz, study.run_s
        self.is_recorded, self.end = study.is_recorded, _end(study)
        self.has, self.combinations, self.place = study.has, study.combinations, where.get

    def refuse(self, key: str, text: str) -> NoReturn:
        """Raise the error of a key."""
        _refuse(key, self._where, text)


def _refuse(key: str, where: Where, text: str) -> NoReturn:
    raise InputError(f"{where.get(key, f'[{SECTION_OF[key]}]')} {key}: {text}")


def _check_required(study: Study, where: Where) -> None:
    """Refuses a key that is missing, or given for nothing, because of another key's value."""
    simulated = not study.is_recorded
    untimed = (
        study.record and study.record.format in ("csv", "parquet") and not study.record.time_column
    )
    if "rate_hz" not in where and (simulated or untimed):
        description = SECTIONS["study"].model_fields["rate_hz"].description
        why = "[record] has no time_column to tell it" if untimed else description
        _refuse("rate_hz", where, f"required ({why})")
    for key in ("latitude_deg", "yaw_center_deg") if simulated else ():
        if key not in where:
            description = SECTIONS[SECTION_OF[key]].model_fields[key].description
            _refuse(key, where, f"required ({description})")
    for angle in ("pitch", "roll", "yaw") if simulated else ():
        amplitude, period = f"{angle}_amplitude_deg", f"{angle}_period_s"
        sways = amplitude in study.drawn_keys or any(
            p[amplitude] for p in study.combinations(amplitude)
        )
        if period not in where and sways:
            _refuse(period, where, f"required where {amplitude} > 0")
    if all(point["earth"] != "constants" for point in study.combinations("earth")):
        for key in EARTH_CONSTANTS:
            if key in where:
                _refuse(key, where, "requires earth = 'constants'")


def _check_size(study: Study, where: Where) -> None:
    """Refuses what no machine could run, from the lengths of the axes alone."""
    settings = study.study
    if settings.duration_s * settings.rate_hz > _MAX_SAMPLES * (1 + ROUNDING):
        text = f"{settings.duration_s:.12g} s at rate_hz = {settings.rate_hz:.12g}"
        hint = " (is time_unit right?)" if study.is_recorded else ""
        _refuse("duration_s", where, f"{text} is more than {_MAX_SAMPLES} samples a run{hint}")
    if study.n_draws * study.n_variants > _MAX_RUNS:
        key = "start_s" if study.is_recorded else "draws"
        text = f"{study.n_draws} draws x {study.n_variants} variants of [axes] and [[cases]]"
        _refuse(key, where, f"{text} are more than {_MAX_RUNS} runs")


def _check_intervals(study: Study, where: Where) -> None:
    """Refuses times that are no whole number of samples, and a study shorter than a record."""
    rate, record = study.rate_hz, study.study.record_interval_s
    _check_whole(study, where, "record_interval_s", record)
    for point in study.combinations("feedback_interval_s"):
        if point["feedback_interval_s"] is not None:
            _check_whole(study, where, "feedback_interval_s", point["feedback_interval_s"])
    for point in study.combinations("coarse_duration_s") if study.coarse else ():
        _check_whole(study, where, "coarse_duration_s", point["coarse_duration_s"], least=2)
    taken: dict[int, float] = {}
    for start in study.record.start_s if study.record else ():
        _check_whole(study, where, "start_s", start, least=0)
        if taken.setdefault(round(start * rate), start) != start:
            _refuse("start_s", where, f"{start!r} s falls on the sample of another start time")
    if study.study.duration_s < record * (1 - ROUNDING):
        duration = f"duration_s = {study.duration_s:.12g}"
        _refuse("record_interval_s", where, f"{record:.12g} s is longer than the study, {duration}")


def _check_methods(study: Study, where: Where) -> None:
    """Refuses keys that no method of the study reads, those of a whole section at once."""
    methods = sorted(study.methods)
    text = f"does not apply to method {' or '.join(methods)}"
    unread = keys_unread(methods)
    for key in sorted(unread & where.keys()):
        section = f"[{SECTION_OF[key]}]"
        here = [other for other, place in where.items() if place == section]
        if where[key] == section and len(here) > 1 and unread.issuperset(here):
            how = f"drop it, as by --set {SECTION_OF[key]}={{}}"
            raise InputError(f"{section}: {text} ({how}: {', '.join(here)})")
        if where[key].startswith("[axes"):
            text += f" (drop it, as by --set {where[key].strip('[]')}.{key}={{}})"
        _refuse(key, where, text)


def _check_passes(study: Study, where: Where) -> None:
    """Refuses a stored record of no whole number of record intervals, or passes that do not fit."""
    duration = study.duration_s * (1 + ROUNDING)
    for point in study.combinations(*PASS_KEYS) if study.passes else ():
        record_s, passes = point["stored_s"], point["passes"]
        rewinds = point["direction"] == "rewind"
        if record_s is None:
            if (passes or 1) > 1:
                _refuse("passes", where, f"{passes} need a stored record to repeat (give stored_s)")
            continue
        _check_multiple(study, where, "stored_s", record_s)
        if record_s > duration:
            _refuse("stored_s", where, f"{record_s:.12g} s is longer than the study, {_end(study)}")
        if passes and passes * record_s > duration:
            text = f"{passes} over a record of {record_s:.12g} s last {passes * record_s:.12g} s"
            _refuse("passes", where, f"{text}, longer than the study ({_end(study)})")
        if passes and passes % 2 == 0 and point["ending"] == "forward" and not rewinds:
            _refuse("passes", where, f"{passes} end backward, not as ending = 'forward' says")


def _check_coarse(study: Study, where: Where) -> None:
    """Refuses coarse alignment that no run can begin with, and resets before its hand-over."""
    every_s = study.record_every / study.rate_hz
    stored = ("stored_s",) if study.passes else ()
    resets = OF_RESETS if study.has("resets") else ()
    for point in study.combinations(*COARSE_KEYS, *stored, *resets) if study.coarse else ():
        method, length_s, then = (point[key] for key in COARSE_KEYS)
        if study.is_recorded and method == "none":
            _refuse("coarse_method", where, "a record tells no attitude to begin with")
        if not study.has_coarse_stage(method, then):
            continue
        if method == "analytic":
            _refuse("coarse_method", where, "'analytic' is only for the hand-over of a record")
        _check_multiple(study, where, "coarse_duration_s", length_s)
        end_s = min(study.run_s - every_s, point.get("stored_s") or math.inf)
        if length_s > end_s * (1 + ROUNDING):
            text = f"{length_s:.12g} s leaves nothing to fine alignment (at most {end_s:.12g})"
            _refuse("coarse_duration_s", where, text)
        times = reset_times(*(point[key] for key in OF_SCHEDULES)) if resets else ()
        if then == "replay" or not times:
            continue
        if (first_s := min(times)) <= length_s:
            key = "reset_times_s" if point["reset_times_s"] is not None else "reset_count"
            text = f"a reset at {first_s:.12g} s is not after coarse alignment, {length_s:.12g} s"
            _refuse(key, where, text)
        interval_s = point["feedback_interval_s"]
        if point["reset_at_feedback"] and _samples(study, length_s) % _samples(study, interval_s):
            text = f"coarse alignment of {length_s:.12g} s is no whole number of feedback intervals"
            _refuse("reset_at_feedback", where, f"{text}, feedback_interval_s = {interval_s:.12g}")


def _samples(study: Study, time_s: float) -> int:
    return round(time_s * study.rate_hz)


def _check_multiple(study: Study, where: Where, key: str, time: float) -> None:
    """Refuses a time that is no whole number of record intervals."""
    record = study.study.record_interval_s
    count = time / record
    if abs(count - round(count)) > ROUNDING * count or round(count) < 1:
        near = sorted({max(1, math.floor(count)), max(1, math.ceil(count))})
        shown = " or ".join(f"{n * record:.12g}" for n in near)
        text = f"{time:.12g} s is no whole number of record intervals, record_interval_s ="
        _refuse(key, where, f"{text} {record:.12g} (nearest: {shown})")


def _check_whole(study: Study, where: Where, key: str, time: float, *, least: int = 1) -> None:
    """Refuses a time that is no whole number of samples, or less than ``least`` of them.

    A record has the rate that it has: there the nearest number of samples is taken.
    """
    rate, samples = study.rate_hz, time * study.rate_hz
    off = 0.0 if study.is_recorded else abs(samples - round(samples))
    if off > ROUNDING * samples or round(samples) < least:
        whole = {max(least, math.floor(samples)), max(least, math.ceil(samples))}
        near = " or ".join(f"{n / rate:.12g}" for n in sorted(whole))
        more = f", {least} or more" if least > 1 else ""
        text = f"{time:.12g} s is no whole number of samples of {1 / rate:.12g} s{more}"
        slow = study.is_recorded and rate < 1
        hint = f"{rate:.6g} Hz: is time_unit right?" if slow else f"nearest: {near}"
        _refuse(key, where, f"{text} ({hint})")


def _check_window(study: Study, where: Where) -> None:
    """Refuses a window in which no run has a standard deviation, of two record times or more.

    Runs that end before it have none; those of other lengths do.
    """
    (start, end), every, rate = study.study.window_s, study.record_every, study.rate_hz
    longest = max(span.records for span in study.distinct_spans)
    last = min(longest, int(end * rate / every) + 1)
    # Compared as the engine does, rounding and all.
    while last * every / rate > end:
        last -= 1
    if (last - 1) * every / rate <= start:
        text = f"fewer than 2 records are after {start:.12g} s and up to {end:.12g} s"
        _refuse("window_s", where, f"{text} ({_end(study)})")


def _check_report_times(study: Study, where: Where) -> None:
    """Refuses report times that are no record times of every run."""
    key, rate, every = "report_times_s", study.rate_hz, study.record_every
    befores = {0}
    if counts_before(study):
        coarse = study.combinations(*COARSE_KEYS)
        befores = {samples_before(study, rate, **point) for point in coarse}
    for time in report_times(study):
        _check_multiple(study, where, key, time)
        if time > (min(befores) / rate + study.run_s) * (1 + ROUNDING):
            _refuse(key, where, f"{time:.12g} s is not within the run ({_end(study)})")
        for before in sorted(befores, reverse=True):
            after = f"runs that follow coarse alignment of {before / rate:.12g} s"
            if round(time * rate) <= before:
                _refuse(key, where, f"{time:.12g} s is before the first record of {after}")
            if before % every:
                _refuse(key, where, f"{time:.12g} s is between two records of {after}")


def _check_success(study: Study, where: Where) -> None:
    """Refuses a success that no run can reach, or that is judged from a missing bias floor."""
    names = [columns.settle_column(band).name for band in success.bands(study)]
    if len(set(names)) < len(names):
        key = "success_band_arcmin" if "success_band_arcmin" in where else "settle_bands_arcmin"
        text = "gives another of the bands the same name, to the 6 digits that its column shows"
        _refuse(key, where, text)
    dwell = study.study.dwell_s
    if dwell is not None and dwell >= study.run_s:
        _refuse("dwell_s", where, f"{dwell:.12g} s is not less than the run ({_end(study)})")


def _end(study: Study) -> str:
    """Where a study and its shortest run end, in words."""
    text = f"duration_s = {study.duration_s:.12g}"
    whole_s = study.duration_s - study.dropped_s
    if study.dropped_s:
        text += f"; the last partial record interval, after {whole_s:.12g} s, is not run"
    if study.run_s < whole_s * (1 - ROUNDING):
        text += f"; the shortest run ends at {study.run_s:.12g} s"
    return text


def _check_stop(study: Study, where: Where) -> None:
    """Refuses a statistic that the study has not, and a share that says nothing."""
    if study.stop_when is None:
        return
    bands = success.bands(study)
    known = ["success_rate", *(f"{columns.settle_column(band).name}_mean" for band in bands)]
    if study.stop_when.statistic not in known:
        text = f"'{study.stop_when.statistic}' is none of {', '.join(known)}"
        _refuse("statistic", where, text)
    if study.stop_when.statistic == "success_rate" and study.stop_when.half_width >= 1:
        _refuse(
            "half_width",
            where,
            f"must be less than 1, a share, not {study.stop_when.half_width:.12g}",
        )

"""When the records of a run are, and where on its record each pass is then."""

import numpy as np

from sinsjax.study.study import Span, Study


def spans_s(study: Study) -> np.ndarray:
    """(variants, 2) lengths of every variant's run and of a pass over its stored record, s."""
    return (
        study.lengths.each(lambda span: (span.records, span.pass_records), int)
        * study.record_every
        / study.rate_hz
    )


def update_times(study: Study, span: Span) -> np.ndarray:
    """(records,) update times of a run's records from the start of fine alignment, s."""
    return np.arange(1, span.records + 1) * study.record_every / study.rate_hz


def stored_times(study: Study, span: Span) -> np.ndarray:
    """(records,) where in its stored record a run is at its records, s from the beginning."""
    ended = np.arange(span.records)
    place = ended % span.pass_records + 1
    forward = span.rewinds | (pass_numbers(span) % 2 == 1)
    place = np.where(forward, place, span.pass_records - place)
    return place * study.record_every / study.rate_hz


def pass_numbers(span: Span) -> np.ndarray:
    """(records,) the pass, from 1, that each record of a run ends or lies in."""
    return np.arange(span.records) // span.pass_records + 1


def samples_before(
    study: Study,
    rate_hz: float,
    coarse_method: str,
    coarse_duration_s: float,
    coarse_then: str | None,
) -> int:
    """Samples of a record that are coarsely aligned before runs begin, by `COARSE_KEYS`."""
    if study.has_coarse_stage(coarse_method, coarse_then):
        return 0
    return round(coarse_duration_s * rate_hz)


def counts_before(study: Study) -> bool:
    """Whether data before t = 0 of some runs count, because other runs begin with the first.

    Where none does, data are counted from t = 0 too.
    """
    return study.is_recorded and bool(study.coarse_stages)


def report_times(study: Study) -> tuple[float, ...]:
    """The times at which runs are reported besides their end, s of data; none by default."""
    return study.study.report_times_s or ()


def report_samples(study: Study, before: int) -> np.ndarray:
    """(times,) numbers, from 1, of the samples of a run at the report times.

    Args:
        study: whose records the report times are.
        before: samples of data that count before the run's first, see `counts_before`.
    """
    samples = np.asarray(report_times(study)) * study.rate_hz - before
    return np.round(samples / study.record_every) * study.record_every

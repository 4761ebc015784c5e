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

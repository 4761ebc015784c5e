"""Paper 1's statements about its simulation, judged on the runs of one reading.

What the paper's words mean was fixed before the first result, see `Meaning`. A verdict follows the
number itself, and says where its 95 % interval straddles the threshold.

Judged from the summary alone, hence not judged: the convergence trend of the first 100 s
(section 3.1) and the two added stable processes after resets (3.3.2), which need curves; that
pitch and roll converge, as settling is counted for yaw; the car test (4.2), which is a record.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from sinsjax.analysis import (
    Estimate,
    difference,
    format_difference,
    format_estimate,
    mean,
    numbers,
    paired,
    proportion,
    quantile,
    quantile_difference,
)
from sinsjax.errors import InputError

RESET = "5 with resets"
CONDITIONS = ("1", "2", "3", "4", "5", RESET)
EQUAL_WITHIN = 0.1  # "approximately equal" covariances: sigma_u
_ABOVE = "the filter's yaw variance above the squared yaw error"

_FIG2 = "section 2.4.2, Fig. 2"
_FIG3 = "section 3.1, Fig. 3"
_FIG5 = "section 3.3.2, Fig. 5"
_FIG6 = "section 3.3.2, Fig. 6"
STATEMENTS = {
    "S1a": ("condition 1 converges", _FIG2),
    "S1b": ("condition 2 converges", _FIG2),
    "S2a": ("condition 1 converges in a short time", _FIG2),
    "S2b": ("condition 2 converges in a short time", _FIG2),
    "S3": ("condition 3 converges", _FIG2),
    "S4a": ("condition 3 takes longer than condition 2", _FIG2),
    "S4b": ("condition 3 takes longer than condition 1", _FIG2),
    "S5": ("condition 4 converges", _FIG2),
    "S6a": ("condition 4 takes longer than condition 2", _FIG2),
    "S6b": ("condition 4 takes longer than condition 1", _FIG2),
    "S7a": ("condition 4 has larger errors than condition 2", _FIG2),
    "S7b": ("condition 4 has larger errors than condition 1", _FIG2),
    "S8": ("condition 5 cannot converge", _FIG2),
    "S9": (
        "condition 1: the filter's yaw covariance is larger than the true one throughout",
        _FIG3,
    ),
    "S10": (
        "condition 5: the filter's yaw covariance is smaller than the true one when steady",
        _FIG3,
    ),
    "S11": ("condition 5 with resets converges", _FIG5),
    "S12": ("condition 5 with resets is as precise as condition 1", _FIG5),
    "S13": ("condition 5 with resets: the yaw covariance is larger throughout", _FIG6),
    "S14": ("condition 5 with resets and condition 1 end with about equal yaw covariance", _FIG6),
}
"""Each statement in short and where the paper makes it."""


class Meaning(NamedTuple):
    """What the paper's words mean, as numbers.

    Attributes:
        covariance_after_s: records count after this time, s; the study's ``consistency_after_s``.
        steady_after_s: start of the steady filtering process, s; the study's ``steady_after_s``.
        converges_share: *converges*: at least this share of draws has ``settle_10_s``.
        short_time_s: *in a short time*: the median of ``settle_10_s`` is at most this, s.
        cannot_share: *cannot converge*: less than this share of draws has ``settle_10_s``.
        as_precise_arcmin: *as precise*: the mean paired difference is under this, arcmin.
        covariance_share: *throughout*: at least this share of records.
    """

    covariance_after_s: float
    steady_after_s: float
    converges_share: float = 0.95
    short_time_s: float = 200.0
    cannot_share: float = 0.05
    as_precise_arcmin: float = 1.0
    covariance_share: float = 0.95


class StatementVerdict(NamedTuple):
    """One statement, judged.

    Attributes:
        statement_id: key of :data:`STATEMENTS`.
        text: the statement in short.
        where: section and figure of the paper.
        holds: whether the number meets the meaning.
        straddles: whether the interval reaches across the threshold, or is unknown there.
        number: what was found, with its 95 % interval.
        unit: of the number; empty for shares and ratios.
        measure: what the number is, and its threshold.
        sides: whose settling times the number is the difference of; empty for all other numbers.
    """

    statement_id: str
    text: str
    where: str
    holds: bool
    straddles: bool
    number: Estimate
    unit: str
    measure: str
    sides: tuple[str, ...] = ()

    def told(self, digits: int) -> str:
        """The number with its interval and unit as text."""
        if len(self.sides) == 2:
            return format_difference(self.number, self.unit, digits, self.sides)
        return format_estimate(self.number, self.unit, digits)


class _Finding(NamedTuple):
    holds: bool
    straddles: bool
    number: Estimate
    unit: str
    measure: str
    sides: tuple[str, ...] = ()


def judge(conditions: Mapping[str, pa.Table], meaning: Meaning) -> list[StatementVerdict]:
    """Judges every statement of :data:`STATEMENTS` on one reading's runs.

    Args:
        conditions: the summary of each of :data:`CONDITIONS`, one row a draw, same draws in all.
        meaning: what the words mean.

    Returns:
        The verdicts in the order of :data:`STATEMENTS`.

    Raises:
        InputError: a condition or a column is missing, a condition has no runs, or draws differ.
    """
    for name in CONDITIONS:
        if name not in conditions or conditions[name].num_rows == 0:
            raise InputError(f"paper 1's statements: there are no runs of condition {name}")
    findings = dict(_findings(conditions, meaning))
    return [
        StatementVerdict(statement_id, text, where, *findings[statement_id])
        for statement_id, (text, where) in STATEMENTS.items()
    ]


def _findings(runs: Mapping[str, pa.Table], meaning: Meaning) -> Iterator[tuple[str, _Finding]]:
    converging = {"S1a": "1", "S1b": "2", "S3": "3", "S5": "4", "S11": RESET}
    longer = {"S4a": ("3", "2"), "S4b": ("3", "1"), "S6a": ("4", "2"), "S6b": ("4", "1")}
    for statement_id, name in converging.items():
        yield statement_id, _converges(runs[name], meaning)
    for statement_id, name in {"S2a": "1", "S2b": "2"}.items():
        yield statement_id, _in_a_short_time(runs[name], meaning)
    for statement_id, (name, other) in longer.items():
        yield (
            statement_id,
            _longer(runs[name], runs[other])._replace(
                sides=(f"condition {name}", f"condition {other}")
            ),
        )
    for statement_id, other in {"S7a": "2", "S7b": "1"}.items():
        yield statement_id, _larger_errors(runs["4"], runs[other])
    yield "S8", _cannot_converge(runs["5"], meaning)
    yield "S9", _larger_throughout(runs["1"], meaning)
    yield "S10", _smaller_when_steady(runs["5"], meaning)
    yield "S12", _as_precise(runs[RESET], runs["1"], meaning)
    yield "S13", _larger_throughout(runs[RESET], meaning)
    yield "S14", _equal_at_the_end(runs[RESET], runs["1"])


def _straddles(number: Estimate, *thresholds: float) -> bool:
    # Said as "not clear of it", so that an unknown end straddles.
    return any(not (number.low > t or number.high < t) for t in thresholds)


def _settled(table: pa.Table) -> Estimate:
    return proportion(int(np.count_nonzero(~np.isnan(numbers(table, "settle_10_s")))), len(table))


def _converges(table: pa.Table, meaning: Meaning) -> _Finding:
    share, least = _settled(table), meaning.converges_share
    measure = f"share of draws that settle to 10 arcmin, at least {least:g}"
    return _Finding(share.value >= least, _straddles(share, least), share, "", measure)


def _cannot_converge(table: pa.Table, meaning: Meaning) -> _Finding:
    share, limit = _settled(table), meaning.cannot_share
    measure = f"share of draws that settle to 10 arcmin, under {limit:g}"
    return _Finding(share.value < limit, _straddles(share, limit), share, "", measure)


def _in_a_short_time(table: pa.Table, meaning: Meaning) -> _Finding:
    time, limit = quantile(numbers(table, "settle_10_s")), meaning.short_time_s
    measure = f"median settling time to 10 arcmin, at most {limit:g} s"
    return _Finding(time.value <= limit, _straddles(time, limit), time, "s", measure)


def _longer(table: pa.Table, other: pa.Table) -> _Finding:
    extra = quantile_difference(*paired(table, other, "settle_10_s"))
    measure = "difference of the median settling times to 10 arcmin, interval above 0"
    return _Finding(extra.low > 0, _straddles(extra, 0.0), extra, "s", measure)


def _larger_errors(table: pa.Table, other: pa.Table) -> _Finding:
    yaw = paired(table, other, "phi_u_mean_arcmin")
    floor = paired(table, other, "floor_arcmin")
    extra = difference(*(np.abs(mean_yaw - at) for mean_yaw, at in zip(yaw, floor, strict=True)))
    measure = (
        "mean paired difference of how far the mean yaw error lies from its limit, interval above 0"
    )
    return _Finding(extra.low > 0, _straddles(extra, 0.0), extra, "arcmin", measure)


def _larger_throughout(table: pa.Table, meaning: Meaning) -> _Finding:
    least = meaning.covariance_share
    # A run without a share (not finite) shows no record in which P is the larger.
    share = _of_all_records(table, "p_above_error_share", missing=0.0)
    after = meaning.covariance_after_s
    measure = f"share of records after {after:g} s with {_ABOVE}, at least {least:g}"
    return _Finding(share.value >= least, _straddles(share, least), share, "", measure)


def _smaller_when_steady(table: pa.Table, meaning: Meaning) -> _Finding:
    most = 1 - meaning.covariance_share
    # A run without a share (not finite) shows no record in which P is the smaller.
    share = _of_all_records(table, "p_above_error_steady_share", missing=1.0)
    after = meaning.steady_after_s
    measure = f"share of records after {after:g} s with {_ABOVE}, at most {most:g}"
    return _Finding(share.value <= most, _straddles(share, most), share, "", measure)


def _of_all_records(table: pa.Table, column: str, *, missing: float) -> Estimate:
    # Every run has equally many records, so the mean share is that of all records together.
    found = mean(np.nan_to_num(numbers(table, column), nan=missing))
    return found._replace(low=max(found.low, 0.0), high=min(found.high, 1.0))


def _as_precise(table: pa.Table, other: pa.Table, meaning: Meaning) -> _Finding:
    limit = meaning.as_precise_arcmin
    apart = difference(*paired(table, other, "phi_u_mean_arcmin"))
    inside = -limit < apart.low and apart.high < limit
    measure = (
        f"mean paired difference of the window mean of phi_u, interval within {limit:g} arcmin"
    )
    # A draw without a finite value is left out of the mean, but is not as precise.
    holds = inside and apart.n == len(table)
    return _Finding(holds, _straddles(apart, -limit, limit), apart, "arcmin", measure)


def _equal_at_the_end(table: pa.Table, other: pa.Table) -> _Finding:
    sigma, reference = paired(table, other, "sigma_u_arcmin")
    ratio = mean(sigma / reference)
    holds = abs(ratio.value - 1) <= EQUAL_WITHIN and ratio.n == len(table)
    straddles = _straddles(ratio, 1 - EQUAL_WITHIN, 1 + EQUAL_WITHIN)
    measure = f"mean paired ratio of sigma_u at the end, within {EQUAL_WITHIN:g} of 1"
    return _Finding(holds, straddles, ratio, "", measure)

"""What no sensor puts out on a base at rest: samples beyond any range, or stuck; no Earth rate.

They are found where a file is read, for only there the rows are known.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sinsjax.messages import format_count
from sinsjax.records.layout import Oddity, spans_of
from sinsjax.records.means import EARTH_RATE
from sinsjax.units import DEG, STANDARD_GRAVITY

_MOST_G, _MOST_DEG_PER_S = 20.0, 1000.0  # swaying bases and cars stay far below
_STANDS_OUT = 0.1
"""Of the limit: where most samples are larger, it is the unit that is wrong, as the mean tells."""

_MOST_TOLD = 6  # of what may be right, in messages
_REMOVED = 0.01  # of Earth rate, in every gyro: biases do not cancel it so well in all three
_STUCK_S = 1.0  # of all six channels: one of few counts may repeat itself for long


def oddities(
    names: Sequence[str],
    columns: Sequence[NDArray[Any]],
    factors: Sequence[float],
    rate_hz: float,
    row: Callable[[int], int],
) -> tuple[Oddity, ...]:
    """What is odd about single samples of a record.

    Args:
        names: of the columns, three of gyros before three of accelerometers.
        columns: (T,) each, in any unit, nan where missing.
        factors: from each column's unit to rad/s or m/s^2.
        rate_hz: sample rate, Hz.
        row: the row to name in a message about sample k.
    """
    beyond = _beyond(names, columns, factors, row)
    return (*beyond, *_removed(columns[:3], factors), *_stuck(names, columns, rate_hz, row))


def told(found: Sequence[Oddity], spans: Sequence[tuple[int, int]]) -> Iterator[Oddity]:
    """Those that concern some spans of samples, as messages tell them.

    Of what is certainly wrong the first place, and how many more there are.

    Args:
        found: in a record.
        spans: first sample of each, and the one after its last.
    """
    read = [
        odd for odd in found if any(odd.begin < end and odd.end > begin for begin, end in spans)
    ]
    certain = [odd for odd in read if odd.hard]
    if certain:
        first, more = min(certain, key=lambda odd: odd.begin), len(certain) - 1
        text = f"{first.text}; {format_count(more, 'more such place')}" if more else first.text
        yield first._replace(text=text)
    yield from [odd for odd in read if not odd.hard][:_MOST_TOLD]


def _beyond(
    names: Sequence[str],
    columns: Sequence[NDArray[Any]],
    factors: Sequence[float],
    row: Callable[[int], int],
) -> Iterator[Oddity]:
    for place, (name, values, factor) in enumerate(zip(names, columns, factors, strict=True)):
        is_gyro = place < 3
        unit, shown = (DEG, "deg/s") if is_gyro else (STANDARD_GRAVITY, "g")
        limit = _MOST_DEG_PER_S if is_gyro else _MOST_G
        most = limit * unit / factor
        large = (values > most) | (values < -most)
        if not large.any() or np.nanmedian(np.abs(values)) > _STANDS_OUT * most:
            continue
        for begin, end in spans_of(large):
            value = float(values[begin])
            yield Oddity(
                begin,
                end,
                True,
                f"{_rows(row, begin, end)}: column {name!r}: {value:.6g} is"
                f" {value * factor / unit:.4g} {shown}, and no base at rest has more than"
                f" {limit:g} {shown}: leave such cells empty, as missing samples",
            )


def _removed(gyros: Sequence[NDArray[Any]], factors: Sequence[float]) -> Iterator[Oddity]:
    """Earth rate that was removed by subtracting the mean of the whole log from each gyro.

    The mean over a part of it, which a study aligns, is that of its sways then.
    """
    if any(map(_is_constant, gyros)):
        return
    means = [
        float(np.nansum(gyro)) / max(1, int(np.isfinite(gyro).sum())) * factor
        for gyro, factor in zip(gyros, factors, strict=False)
    ]
    if max(map(abs, means)) < _REMOVED * EARTH_RATE:
        text = (
            f"the mean of each gyro over the whole log is below {_REMOVED:.0%} of Earth rate: has"
        )
        yield Oddity(0, len(gyros[0]), True, f"{text} Earth rate been removed?")


def _stuck(
    names: Sequence[str],
    columns: Sequence[NDArray[Any]],
    rate_hz: float,
    row: Callable[[int], int],
) -> Iterator[Oddity]:
    count = len(columns[0])
    least = max(2, round(_STUCK_S * rate_hz))
    if count < least:
        return
    dead = [name for name, values in zip(names, columns, strict=True) if _is_constant(values)]
    if len(dead) == len(names):
        yield Oddity(0, count, False, "no channel changes in any row: is this a log of sensors?")
        return
    for name in dead:
        value = float(columns[names.index(name)][0])
        text = f"column {name!r} holds {value:.6g} in every row: is that sensor dead?"
        yield Oddity(0, count, False, text)
    same = np.ones(count - 1, bool)
    for values in columns:
        same &= values[1:] == values[:-1]
    for begin, last in spans_of(same):
        if last + 1 - begin >= least:
            yield Oddity(
                begin,
                last + 1,
                False,
                f"{_rows(row, begin, last + 1)}: all six channels are stuck for"
                f" {(last + 1 - begin) / rate_hz:.3g} s: did the sensor or the logger stop?",
            )


def dead_among(channels: NDArray[Any]) -> list[bool]:
    """Whether each of some channels (n, T) never changes while another one does."""
    constant = list(map(_is_constant, channels))
    return [False] * len(constant) if all(constant) else constant


def _is_constant(values: NDArray[Any]) -> bool:
    """Whether a channel (T,) never changes."""
    return bool(values[0] == values[-1] and (values == values[0]).all())


def _rows(row: Callable[[int], int], begin: int, end: int) -> str:
    first, last = row(begin), row(end - 1)
    return f"row {first}" if first == last else f"rows {first} to {last}"

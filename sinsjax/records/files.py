"""Bytes, lines and numbers out of a file."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from sinsjax.errors import InputError

CUT_OFF = " (the last row: is the file cut off?)"

LARGEST = 1e30
"""Beyond it a number of a record is none; squares and sums of what is below are finite."""

BATCH = 2**22
"""Bytes of a text file that are looked at together: some 30,000 rows of a record."""


def load(path: str | Path) -> bytes:
    """The whole content of a file that is not empty; raises InputError where there is none."""
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    if not data:
        raise InputError(f"{path}: the file is empty")
    return data


class Lines(NamedTuple):
    """Some lines of a text file in a row.

    Attributes:
        first: row of the first one, from 1.
        lines: without their ends.
        ends: whether the file ends with them.
    """

    first: int
    lines: list[bytes]
    ends: bool


def line_batches(path: str | Path, size: int | None = None) -> Iterator[Lines]:
    """The lines of a text file, a batch at a time: a long record is larger than what is made of it.

    Args:
        path: the file.
        size: bytes that are read at a time, or `BATCH`.

    Raises:
        InputError: the file cannot be read, is empty, or is not text.
    """
    first, rest = 1, b""
    for block, ends in _blocks(path, size or BATCH):
        block = rest + block
        if b"\0" in block:
            row = first + block.count(b"\n", 0, block.index(b"\0"))
            raise InputError(f"{path}: row {row}: not a text file (a zero byte)")
        # A line ends with either or both, which are never parted.
        cut = block.rfind(b"\n") + 1 or block.rfind(b"\r", 0, -1) + 1
        cut = len(block) if ends else cut
        if not ends and not cut:
            rest = block
            continue
        lines, rest = block[:cut].splitlines(), block[cut:]
        yield Lines(first, lines, ends)
        first += len(lines)


def _blocks(path: str | Path, size: int) -> Iterator[tuple[bytes, bool]]:
    """Blocks of a file without its byte order mark, and whether each is the last one."""
    try:
        with open(path, "rb") as file:
            block = file.read(size)
            if not block:
                raise InputError(f"{path}: the file is empty")
            block = block.removeprefix(b"\xef\xbb\xbf")
            while following := file.read(size):
                yield block, False
                block = following
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    yield block, True


def number_or_nan(text: str) -> float:
    """As `number`, but nan for what is empty or not finite: a value that is missing."""
    try:
        return number(text)
    except ValueError:
        if text.strip().lstrip("+-").lower() in ("", "nan", "inf", "infinity"):
            return math.nan
        raise


def number(text: str) -> float:
    """Reads one finite number; a ValueError says what is wrong with the text."""
    text = text.strip()
    if not text:
        raise ValueError("is empty")
    shown = repr(text if len(text) <= 24 else text[:24] + "...")
    try:
        value = float(text.replace("_", "?"))  # Python's own 1_000 is not a number in a file
    except ValueError:
        raise ValueError(f"{shown} is not a number") from None
    if not math.isfinite(value):
        raise ValueError(f"{shown} is not finite")
    if abs(value) > LARGEST:
        raise ValueError(f"{shown} is beyond {LARGEST:g}, which nothing measures")
    return value

"""Reading bytes, lines and numbers from a file."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from sinsjax.errors import InputError

CUT_OFF_HINT = " (the last row: is the file cut off?)"

MAX_MAGNITUDE = 1e30
"""Largest magnitude accepted in a record; squares and sums of such numbers stay finite."""

BATCH_BYTES = 2**22
"""Bytes of a text file read at a time: about 30,000 rows of a record."""


def read_bytes(path: str | Path) -> bytes:
    """Read a whole file; raises InputError if it is empty or cannot be read."""
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    if not data:
        raise InputError(f"{path}: the file is empty")
    return data


class Lines(NamedTuple):
    """Consecutive lines of a text file.

    Attributes:
        first: row of the first line, from 1.
        lines: the lines without line endings.
        is_last: whether these are the last lines of the file.
    """

    first: int
    lines: list[bytes]
    is_last: bool


def read_line_batches(path: str | Path, size: int | None = None) -> Iterator[Lines]:
    """Yield the lines of a text file in batches, since long files exceed their arrays in size.

    Args:
        path: the file.
        size: bytes to read at a time; `BATCH_BYTES` by default.

    Raises:
        InputError: the file cannot be read, is empty, or is not text.
    """
    first, rest = 1, b""
    for block, is_last in _read_blocks(path, size or BATCH_BYTES):
        block = rest + block
        if b"\0" in block:
            row = first + block.count(b"\n", 0, block.index(b"\0"))
            raise InputError(
                f"{path}: row {row}: not a text file: a zero byte (of MATLAB or another"
                " binary format? export it as CSV or Parquet)"
            )
        # A line ends with \r, \n or both; a pair must not be split between two batches.
        cut = block.rfind(b"\n") + 1 or block.rfind(b"\r", 0, -1) + 1
        cut = len(block) if is_last else cut
        if not is_last and not cut:
            rest = block
            continue
        lines, rest = block[:cut].splitlines(), block[cut:]
        yield Lines(first, lines, is_last)
        first += len(lines)


def _read_blocks(path: str | Path, size: int) -> Iterator[tuple[bytes, bool]]:
    """Yield the blocks of a file without byte order mark, each with whether it is the last."""
    try:
        with open(path, "rb") as file:
            block = file.read(size)
            if not block:
                raise InputError(f"{path}: the file is empty")
            block = block.removeprefix(b"\xef\xbb\xbf")
            while next_block := file.read(size):
                yield block, False
                block = next_block
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    yield block, True


def parse_number_or_nan(text: str) -> float:
    """Parse one number like `parse_number`, with nan for an empty or non-finite value."""
    try:
        return parse_number(text)
    except ValueError:
        if text.strip().lstrip("+-").lower() in ("", "nan", "inf", "infinity"):
            return math.nan
        raise


def parse_number(text: str) -> float:
    """Parse one finite number; the ValueError of an invalid text states what is wrong."""
    text = text.strip()
    if not text:
        raise ValueError("is empty")
    shown_text = repr(text if len(text) <= 24 else text[:24] + "...")
    try:
        value = float(text.replace("_", "?"))  # 1_000 is a number in Python, not in a data file
    except ValueError:
        raise ValueError(f"{shown_text} is not a number") from None
    if not math.isfinite(value):
        raise ValueError(f"{shown_text} is not finite")
    if abs(value) > MAX_MAGNITUDE:
        raise ValueError(f"{shown_text} is out of range (beyond {MAX_MAGNITUDE:g})")
    return value

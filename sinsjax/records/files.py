"""Bytes, lines and numbers out of a file."""

import math
from pathlib import Path

from sinsjax.types import InputError

CUT_OFF = " (the last row: is the file cut off?)"


def load(path: str | Path) -> bytes:
    """The whole content of a file that is not empty; raises InputError where there is none."""
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    if not data:
        raise InputError(f"{path}: the file is empty")
    return data


def load_lines(path: str | Path) -> list[bytes]:
    """The lines of a text file without their ends; raises InputError for what is not text."""
    data = load(path)
    if b"\0" in data:
        row = data.count(b"\n", 0, data.index(b"\0")) + 1
        raise InputError(f"{path}: row {row}: not a text file (a zero byte)")
    return data.removeprefix(b"\xef\xbb\xbf").splitlines()


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
    return value

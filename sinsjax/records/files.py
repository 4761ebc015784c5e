"""Reading bytes, lines and numbers from a file, compressed or not: UTF-8, UTF-16 or cp1252."""

import bz2
import codecs
import gzip
import lzma
import math
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from sinsjax.errors import InputError

CUT_OFF_HINT = " (the last row: is the file cut off?)"

MAX_MAGNITUDE = 1e30
"""Largest magnitude accepted in a record; squares and sums of such numbers stay finite."""

_COMPRESSIONS: dict[bytes, Callable[[Any], Any]] = {
    b"\x1f\x8b": gzip.open,
    b"BZh": bz2.open,
    b"\xfd7zXZ": lzma.open,
}

BATCH_BYTES = 2**22
"""Bytes of a text file read at a time: about 30,000 rows of a record."""

_SAVE = "numpy.savetxt('log.csv', table, delimiter=',', header='time_s,gyro_x,...', comments='')"
_OTHER_FORMATS = {
    b"MATLAB": f"a MATLAB file: in Python table = scipy.io.loadmat('log.mat')['NAME']; {_SAVE}",
    b"\x89HDF": "an HDF5 file (MATLAB 7.3): in Python"
    f" table = h5py.File('log.mat')['NAME'][()].T; {_SAVE}",
    b"\x93NUMPY": f"a NumPy file: in Python table = numpy.load('log.npy'); {_SAVE}",
    b"#ROSBAG": "a ROS bag: export it by `rostopic echo -b log.bag -p /imu > log.csv`",
    b"ULog": "a PX4 log: export it by `ulog2csv log.ulg`",
    b"\xd0\xcf\x11\xe0": "an Excel file: save it as CSV",
}
"""How to convert files of other formats, by their first bytes."""


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
        is_unterminated: whether the last of them has no line ending.
    """

    first: int
    lines: list[bytes]
    is_last: bool
    is_unterminated: bool = False


def read_line_batches(path: str | Path, size: int | None = None) -> Iterator[Lines]:
    """Yield the lines of a text file in batches, since long files exceed their arrays in size.

    Args:
        path: the file.
        size: bytes to read at a time; `BATCH_BYTES` by default.

    Returns:
        Lines in UTF-8; one that is not is taken for cp1252, as Windows in Europe writes.

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
        if not block.isascii():
            lines = [_to_utf8(line) for line in lines]
        yield Lines(first, lines, is_last, is_last and not block.endswith((b"\n", b"\r")))
        first += len(lines)


def _to_utf8(line: bytes) -> bytes:
    """Return a line of UTF-8 or cp1252 in UTF-8."""
    try:
        line.decode()
    except UnicodeDecodeError:
        return line.decode("cp1252", errors="replace").encode()
    return line


def _read_blocks(path: str | Path, size: int) -> Iterator[tuple[bytes, bool]]:
    """Yield the blocks of a file without byte order mark, each with whether it is the last."""
    try:
        with open_binary(path) as file:
            block = file.read(size)
            if not block:
                raise InputError(f"{path}: the file is empty")
            decoder = _utf16_decoder(block)
            block = decoder(block, False).removeprefix(b"\xef\xbb\xbf")
            while next_block := file.read(size):
                yield block, False
                block = decoder(next_block, False)
            yield block + decoder(b"", True), True
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: damaged UTF-16 text: {error.reason}") from None
    except (EOFError, lzma.LZMAError, zlib.error, zipfile.BadZipFile):
        raise InputError(f"{path}: a damaged or incomplete archive (unpack it)") from None
    except OSError as error:
        reason = error.strerror or "a damaged archive (unpack it)"
        raise InputError(f"{path}: cannot be read: {reason}") from None


def _utf16_decoder(start: bytes) -> Callable[[bytes, bool], bytes]:
    """Return a function of the next bytes, and whether they are the last, to UTF-8."""
    if not start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return lambda block, final: block
    decoder = codecs.getincrementaldecoder("utf-16")()
    return lambda block, final: decoder.decode(block, final).encode()


@contextmanager
def open_binary(path: str | Path) -> Iterator[BinaryIO]:
    """Open a file, or the content of a compressed file or of an archive of one file.

    Raises:
        InputError: it is of a known format that sinsjax does not read; names the conversion.
        OSError: it cannot be opened.
    """
    with ExitStack() as stack:
        file: Any = stack.enter_context(open(path, "rb"))
        if file.seekable():
            start = file.read(8)
            file.seek(0)
            file = stack.enter_context(_open_content(path, file, start))
        yield file


def _open_content(path: str | Path, file: BinaryIO, start: bytes) -> Any:
    """Return the content of an opened file, by its first bytes."""
    for magic, hint in _OTHER_FORMATS.items():
        if start.startswith(magic):
            raise InputError(f"{path}: {hint}")
    for magic, opener in _COMPRESSIONS.items():
        if start.startswith(magic):
            return opener(file)
    return _open_member(path, file) if start.startswith(b"PK\x03\x04") else nullcontext(file)


def _open_member(path: str | Path, file: BinaryIO) -> Any:
    """Open the only file of a ZIP archive."""
    archive = zipfile.ZipFile(file)
    names = [name for name in archive.namelist() if not name.endswith("/")]
    if any(name.startswith("xl/") for name in names):
        raise InputError(f"{path}: an Excel file: save it as CSV")
    if any(name.endswith(".npy") for name in names):
        load = "in Python table = numpy.load('log.npz')['NAME']"
        raise InputError(f"{path}: a NumPy file: {load}; {_SAVE}")
    if len(names) != 1 or archive.getinfo(names[0]).flag_bits & 1:
        kind = "encrypted archive" if len(names) == 1 else f"archive of {len(names)} files"
        raise InputError(f"{path}: an {kind} (unpack it, and give the log)")
    return archive.open(names[0])


def cut_row_text(row: int) -> str:
    """Return the remark about a last row that is cut off."""
    return f"row {row}, the last one, is cut off and left out"


def is_number(text: str) -> bool:
    """Return whether a text is a number, or one of the words for none."""
    try:
        parse_number(text)
    except ValueError:
        return text.lower() in ("nan", "inf", "-inf")
    return True


def is_cut_short(last: str, others: Sequence[str]) -> bool:
    """Return whether the last cell of a file without a final line ending is cut off.

    Args:
        last: the last cell.
        others: cells above it. A cell that is shorter than all of them, ends within an exponent or
            is far from all of them is cut off.
    """
    texts = [text.strip() for text in others if is_number(text)]
    if not texts or last.strip().lower() == "nan":
        return False
    if not last.strip():
        return len(texts) == len(others)
    if not is_number(last) or len(last.strip()) < min(map(len, texts)):
        return True
    numbers = [parse_number_or_nan(text) for text in texts]
    low, high = min(numbers), max(numbers)
    return not low - (high - low) <= parse_number_or_nan(last) <= high + (high - low)


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
        # 1_000 and digits of other scripts are numbers in Python, not in a data file.
        value = float(text.replace("_", "?") if text.isascii() else "?")
    except ValueError:
        raise ValueError(f"{shown_text} is not a number") from None
    if not math.isfinite(value):
        raise ValueError(f"{shown_text} is not finite")
    if abs(value) > MAX_MAGNITUDE:
        raise ValueError(f"{shown_text} is out of range (beyond {MAX_MAGNITUDE:g})")
    return value

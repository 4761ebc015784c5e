"""Files that carry a checksum of their own content, so that any later change is noticed.

The checksum of a Parquet page leaves out the footer, and a JSON file has none. A sealed file
contains the SHA-256 of its own bytes, computed with zeros in place of the 64 digits. It needs no
second file and stays valid when the file is copied or renamed.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from sinsjax.errors import InputError
from sinsjax.platform.files import read_regular_file

KEY = "sinsjax.sha256"
_BLANK = "0" * 64
# What separates the key from its value in JSON, and in the footer of a Parquet file.
_SEAL = re.compile(rb'sinsjax\.sha256(?:": "|\x18\x40)([0-9a-f]{64})')


class Damaged(InputError):
    """A sealed file that has changed since it was written, or carries no seal."""


def sealed_json(content: Mapping[str, Any]) -> bytes:
    """Return a JSON object as text, sealed by its last entry."""
    text = json.dumps({**content, KEY: _BLANK}, indent=1, allow_nan=False)
    return _sealed(f"{text}\n".encode())


def sealed_parquet(table: pa.Table, marks: Mapping[str, str] | None = None) -> bytes:
    """Return a table as a sealed Parquet file; the same rows and marks give the same bytes.

    Args:
        table: the rows, with the metadata of its schema.
        marks: further entries of the file's metadata.
    """
    metadata = {key.decode(): value for key, value in (table.schema.metadata or {}).items()}
    metadata.pop(KEY, None)  # of the file that the rows were read from
    schema = table.schema.with_metadata(metadata | dict(marks or {}))
    sink = pa.BufferOutputStream()
    # Numbers seldom repeat: a dictionary would make them larger and three times as slow.
    options = {"compression": "zstd", "use_dictionary": False, "write_page_checksum": True}
    with pq.ParquetWriter(sink, schema, **options) as writer:
        writer.write_table(table.replace_schema_metadata(schema.metadata))
        # In the footer alone: the schema would store a second copy, in another encoding.
        writer.add_key_value_metadata({KEY: _BLANK})
    return _sealed(sink.getvalue().to_pybytes())


def read_json(path: Path) -> dict[str, Any]:
    """Read a sealed JSON object.

    Raises:
        FileNotFoundError: there is no such file.
        Damaged: it has changed since it was written, or is no sealed JSON object.
        InputError: it is no regular file, or cannot be read.
    """
    content = _intact(path)
    try:
        found = json.loads(content)
    except (ValueError, RecursionError) as error:  # a seal within other text
        raise Damaged(f"{path}: is no JSON object") from error
    if not isinstance(found, dict):
        raise Damaged(f"{path}: is no JSON object")
    return found


def read_parquet(path: Path) -> pa.Table:
    """Read a sealed Parquet file, whose seal is among the metadata of its schema.

    Raises:
        FileNotFoundError: there is no such file.
        Damaged: it has changed since it was written, or is no sealed Parquet file.
        InputError: it is no regular file, or cannot be read.
    """
    try:
        return pq.read_table(pa.BufferReader(_intact(path)))
    except pa.ArrowException as error:  # a seal within other content
        raise Damaged(f"{path}: is no Parquet file") from error


def is_intact(content: bytes) -> bool:
    """Whether a file's content matches its seal; False without one."""
    found = _last_seal(content)
    return found is not None and found[1].decode() == _digest(content, found)


def _intact(path: Path) -> bytes:
    content = read_regular_file(path)
    if not is_intact(content):
        raise Damaged(f"{path}: has changed since it was written (its checksum does not match)")
    return content


def _sealed(content: bytes) -> bytes:
    found = _last_seal(content)
    assert found is not None
    return content[: found.start(1)] + _digest(content, found).encode() + content[found.end(1) :]


def _last_seal(content: bytes) -> re.Match[bytes] | None:
    """The seal is the last entry; a text before it may look like one."""
    start = content.rfind(KEY.encode())
    return _SEAL.match(content, start) if start >= 0 else None


def _digest(content: bytes, found: re.Match[bytes]) -> str:
    """SHA-256 of the content with a blank seal, as hex digits."""
    whole = hashlib.sha256(memoryview(content)[: found.start(1)])
    whole.update(_BLANK.encode())
    whole.update(memoryview(content)[found.end(1) :])
    return whole.hexdigest()

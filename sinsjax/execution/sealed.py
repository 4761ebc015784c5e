"""Files with a checksum of their own content, which reveals any later change.

The checksums of Parquet pages do not cover the footer, and JSON has none. A sealed file contains
the SHA-256 of its own bytes, computed with zeros in place of the 64 digits. It needs no second file
and remains valid when the file is copied or renamed.
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

SEAL_KEY = "sinsjax.sha256"
_BLANK_DIGEST = "0" * 64
# The separators of key and value in JSON, and in the footer of a Parquet file.
_SEAL = re.compile(rb'sinsjax\.sha256(?:": "|\x18\x40)([0-9a-f]{64})')


class DamagedError(InputError):
    """A sealed file that has changed since it was written, or has no seal."""


def to_sealed_json(content: Mapping[str, Any]) -> bytes:
    """Return a JSON object as text, sealed by its last entry."""
    text = json.dumps({**content, SEAL_KEY: _BLANK_DIGEST}, indent=1, allow_nan=False)
    return _fill_seal(f"{text}\n".encode())


def to_sealed_parquet(table: pa.Table, extra_metadata: Mapping[str, str] | None = None) -> bytes:
    """Return a table as a sealed Parquet file; equal rows and metadata give equal bytes.

    Args:
        table: the rows, with the metadata of its schema.
        extra_metadata: further entries of the file's metadata.
    """
    metadata = {key.decode(): value for key, value in (table.schema.metadata or {}).items()}
    metadata.pop(SEAL_KEY, None)  # that of the file from which the rows were read
    schema = table.schema.with_metadata(metadata | dict(extra_metadata or {}))
    sink = pa.BufferOutputStream()
    # Numbers seldom repeat: a dictionary would make them larger and three times as slow.
    options = {"compression": "zstd", "use_dictionary": False, "write_page_checksum": True}
    with pq.ParquetWriter(sink, schema, **options) as writer:
        writer.write_table(table.replace_schema_metadata(schema.metadata))
        # In the footer only: the schema would store a second copy, in another encoding.
        writer.add_key_value_metadata({SEAL_KEY: _BLANK_DIGEST})
    return _fill_seal(sink.getvalue().to_pybytes())


def read_sealed_json(path: Path) -> dict[str, Any]:
    """Read a sealed JSON object, refused as by `read_sealed_parquet`."""
    entries: dict[str, Any] = json.loads(_read_intact(path))
    return entries


def read_sealed_parquet(path: Path) -> pa.Table:
    """Read a sealed Parquet file, whose seal is among the metadata of its schema.

    Raises:
        FileNotFoundError: there is no such file.
        DamagedError: it has changed since it was written, or has no seal.
        InputError: it is no regular file, or cannot be read.
    """
    return pq.read_table(pa.BufferReader(_read_intact(path)))


def is_intact(content: bytes) -> bool:
    """Return whether a file's content matches its seal; False without one."""
    seal = _find_seal(content)
    return seal is not None and seal[1].decode() == _digest(content, seal)


def _read_intact(path: Path) -> bytes:
    content = read_regular_file(path)
    if not is_intact(content):
        text = "has changed since it was written (its checksum does not match)"
        raise DamagedError(f"{path}: {text}")
    return content


def _fill_seal(content: bytes) -> bytes:
    seal = _find_seal(content)
    assert seal is not None
    return content[: seal.start(1)] + _digest(content, seal).encode() + content[seal.end(1) :]


def _find_seal(content: bytes) -> re.Match[bytes] | None:
    """Return the last seal in the content, if there is one."""
    start = content.rfind(SEAL_KEY.encode())
    return _SEAL.match(content, start) if start >= 0 else None


def _digest(content: bytes, seal: re.Match[bytes]) -> str:
    """Return the SHA-256 of the content with a blank seal, as hex digits."""
    digest = hashlib.sha256(memoryview(content)[: seal.start(1)])
    digest.update(_BLANK_DIGEST.encode())
    digest.update(memoryview(content)[seal.end(1) :])
    return digest.hexdigest()

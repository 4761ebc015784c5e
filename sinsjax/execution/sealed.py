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
    return _seal(f"{text}\n".encode())


def to_sealed_parquet(table: pa.Table, extra_metadata: Mapping[str, str] | None = None) -> bytes:
    """Return a table as a sealed Parquet file with more metadata; equal ones give equal bytes."""
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
    return _seal(sink.getvalue().to_pybytes())


def read_sealed_json(path: Path) -> dict[str, Any]:
    """Read a sealed JSON object, or raise as `read_sealed_parquet`."""
    entries: dict[str, Any] = json.loads(_read_intact(path))
    return entries


def read_sealed_parquet(path: Path) -> pa.Table:
    """Read a sealed Parquet file; `DamagedError`, `FileNotFoundError` or another `InputError`."""
    return pq.read_table(pa.BufferReader(_read_intact(path)))


def is_intact(content: bytes) -> bool:
    """Return whether a file's content matches its seal; False without one."""
    return content != b"" and _seal(content) == content


def _read_intact(path: Path) -> bytes:
    content = read_regular_file(path)
    if not is_intact(content):
        text = "has changed since it was written (its checksum does not match)"
        raise DamagedError(f"{path}: {text}")
    return content


def _seal(content: bytes) -> bytes:
    """Return content with the SHA-256 of all the rest in its last seal; nothing without one."""
    start = content.rfind(SEAL_KEY.encode())
    seal = _SEAL.match(content, start) if start >= 0 else None
    if seal is None:
        return b""
    before, after = memoryview(content)[: seal.start(1)], memoryview(content)[seal.end(1) :]
    digest = hashlib.sha256(before)
    digest.update(_BLANK_DIGEST.encode())
    digest.update(after)
    return b"".join([before, digest.hexdigest().encode(), after])

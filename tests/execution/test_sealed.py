"""Every change of a sealed file is detected, and only regular files are read."""

import os

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sinsjax.errors import InputError
from sinsjax.execution import sealed
from sinsjax.platform import files

ROWS = pa.table({"run_id": np.arange(40), "phi_u_arcmin": np.linspace(-3, 3, 40)})
CONTENTS = {
    "parquet": sealed.to_sealed_parquet(ROWS, {"sinsjax.study": "0123"}),
    "json": sealed.to_sealed_json({"state": "complete", "chunks": [{"name": "part-0000"}]}),
}


@pytest.mark.parametrize("kind", CONTENTS)
def test_any_flipped_bit_is_noticed(kind: str) -> None:
    content = CONTENTS[kind]
    assert sealed.is_intact(content)
    for place in range(len(content)):
        flipped = bytearray(content)
        flipped[place] ^= 1 << place % 8
        assert not sealed.is_intact(bytes(flipped)), place


@pytest.mark.parametrize("kind", CONTENTS)
def test_truncated_file_is_noticed(kind: str) -> None:
    content = CONTENTS[kind]
    assert not any(sealed.is_intact(content[:size]) for size in range(len(content)))


def test_parquet_keeps_rows_marks_and_bytes(tmp_path) -> None:
    path = tmp_path / "part.parquet"
    path.write_bytes(CONTENTS["parquet"])
    assert CONTENTS["parquet"] == sealed.to_sealed_parquet(ROWS, {"sinsjax.study": "0123"})
    assert sealed.read_sealed_parquet(path).equals(ROWS)
    assert pq.read_table(path).equals(ROWS)  # by anyone else
    assert pq.read_metadata(path).metadata[b"sinsjax.study"] == b"0123"


def test_text_that_looks_like_a_seal_is_content() -> None:
    content = {"warnings": [f'{sealed.SEAL_KEY}": "{"1" * 64}'], sealed.SEAL_KEY: "2" * 64}
    assert sealed.is_intact(sealed.to_sealed_json(content))


def test_json_of_nothing_sealed_is_damaged(tmp_path) -> None:
    path = tmp_path / "manifest.json"
    for content in (b"", b"{}", b"\xff", f'{{"{sealed.SEAL_KEY}": "{"0" * 64}"}}'.encode()):
        path.write_bytes(content)
        with pytest.raises(sealed.DamagedError, match="manifest.json: has changed"):
            sealed.read_sealed_json(path)


def test_nothing_is_read_through_links_or_pipes(tmp_path) -> None:
    file, link, pipe = (tmp_path / name for name in ("file", "link", "pipe"))
    file.write_bytes(b"content")
    link.symlink_to(file)
    os.mkfifo(pipe)
    assert files.read_regular_file(file) == b"content"
    for path, why in (
        (link, "is a symbolic link"),
        (pipe, "is no(t a)? regular file"),
        (tmp_path, ""),
    ):
        with pytest.raises(InputError, match=f"{path.name}: {why}"):
            files.read_regular_file(path)
    with pytest.raises(FileNotFoundError):
        files.read_regular_file(tmp_path / "nothing")


def test_file_larger_than_limit_is_refused(tmp_path, monkeypatch) -> None:
    path = tmp_path / "large"
    path.write_bytes(b"12345")
    monkeypatch.setattr(files, "MAX_BYTES", 4)
    with pytest.raises(InputError, match="large: is larger than"):
        files.read_regular_file(path)


def test_writing_follows_no_link(tmp_path) -> None:
    target, victim = tmp_path / "study.toml", tmp_path / "victim"
    victim.write_bytes(b"precious")
    target.symlink_to(victim)
    (tmp_path / f".study.toml.{os.getpid()}.tmp").symlink_to(victim)
    with files.atomic_write(target) as file:
        file.write(b"new")
    assert victim.read_bytes() == b"precious"
    assert target.read_bytes() == b"new" and not target.is_symlink()

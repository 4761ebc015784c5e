"""The instruction set; and a folder in which nobody else can write."""

import os
import stat
from pathlib import Path

import pytest

from sinsjax.platform import machine

X86 = "fpu sse4_2 avx f16c"


@pytest.mark.parametrize(
    ("told", "limit", "expected"),
    [
        ({"flags": X86}, "", "AVX"),
        ({"flags": f"{X86} avx2 avx512f avx512_bf16 amx_tile"}, "", "AVX512"),
        ({"flags": f"{X86} avx2 avx512f"}, "avx2", "AVX2"),
        ({"flags": X86}, "AVX2", "AVX"),
        ({"Features": "fp asimd sve2 sve"}, "", "SVE"),
        ({"Features": "fp asimd"}, "", "NEON"),
        ({}, "", "x86_64"),
        ({}, "AVX2", "x86_64 to AVX2"),
    ],
)
def test_instruction_set_follows_cpu_flags_and_xla_limit(
    monkeypatch: pytest.MonkeyPatch, told: dict[str, str], limit: str, expected: str
) -> None:
    monkeypatch.setattr(machine, "cpu_info", lambda: told)
    monkeypatch.setattr(machine.platform, "machine", lambda: "x86_64")
    assert machine.instruction_set(limit) == expected


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="this system has no such modes")
@pytest.mark.parametrize("mode", [0o700, 0o755, 0o775, 0o777])
def test_folder_is_private_or_refused(
    mode: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = machine.ensure_private_folder(tmp_path / "a" / "b")
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    folder.chmod(mode)
    if mode & 0o022:
        with pytest.raises(PermissionError, match="other users can write there"):
            machine.ensure_private_folder(folder)
        return
    assert machine.ensure_private_folder(folder) == folder
    monkeypatch.setattr(os, "geteuid", lambda: folder.stat().st_uid + 1)
    with pytest.raises(PermissionError, match="owned by another user"):
        machine.ensure_private_folder(folder)

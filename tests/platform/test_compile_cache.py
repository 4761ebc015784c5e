"""JAX's compilation cache: when it is on, in which private folder, and after interruptions."""

import importlib.metadata
import os
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest
from support.commands import run_python

from sinsjax.errors import InputError
from sinsjax.platform import machine, runtime

KEYS = (
    "jax_compilation_cache_dir",
    "jax_compilation_cache_max_size",
    "jax_persistent_cache_min_compile_time_secs",
)


@pytest.fixture
def settings(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[pytest.MonkeyPatch]:
    """Undo the settings of a test, and use a separate cache folder."""
    before = {key: jax.config.values[key] for key in KEYS}
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.setattr(machine, "user_cache_folder", lambda: tmp_path / "sinsjax")
    here = {importlib.metadata.version("jaxlib")}
    monkeypatch.setattr(runtime, "CACHE_SAFE_JAXLIB", here)
    for variable in (runtime.CACHE_VARIABLE, runtime._CACHE_SIZE):
        monkeypatch.delenv(variable, raising=False)
    yield monkeypatch
    for key, value in before.items():
        jax.config.update(key, value)


def test_cache_is_on_by_default_with_tested_jaxlib_or_on_request(
    settings: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    settings.setenv(runtime.CACHE_VARIABLE, "0")
    assert runtime.enable_cache() is None and not list(tmp_path.iterdir())
    assert runtime.reason_cache_is_off() == "SINSJAX_COMPILE_CACHE=0"
    settings.setenv(runtime.CACHE_VARIABLE, " ")
    here = runtime.enable_cache()
    assert here is not None and here.parent == tmp_path / "sinsjax" / "compiled"
    assert jax.config.values["jax_compilation_cache_max_size"] == runtime.MAX_CACHE_BYTES
    jax.config.update("jax_compilation_cache_dir", None)
    settings.setattr(runtime, "CACHE_SAFE_JAXLIB", frozenset())
    assert runtime.enable_cache() is None
    assert runtime.reason_cache_is_off().startswith("not tested with jaxlib")
    settings.setenv(runtime.CACHE_VARIABLE, "1")
    assert runtime.enable_cache() == here


def test_cache_has_a_folder_per_jaxlib_and_cpu(settings: pytest.MonkeyPatch) -> None:
    settings.setenv(runtime.CACHE_VARIABLE, "1")
    folders = [runtime.enable_cache()]
    for flags in ("avx2", "avx512f"):
        cpu = {"model name": "another", "flags": flags}
        settings.setattr(machine, "cpu_info", lambda cpu=cpu: cpu)
        folders.append(runtime.enable_cache())
    settings.setattr(runtime.importlib.metadata, "version", lambda _: "99.0")
    folders.append(runtime.enable_cache())
    assert len({*folders}) == 4 and len({folder.parent for folder in folders if folder}) == 1


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="this system has no such modes")
@pytest.mark.parametrize("mode", [0o755, 0o775, 0o777])
def test_folder_is_private_or_not_used(settings: pytest.MonkeyPatch, mode: int) -> None:
    folder = runtime.enable_cache()
    assert folder is not None and stat.S_IMODE(folder.stat().st_mode) == 0o700
    reason, is_ours = "other users can write there, and cached programs are executed", True
    if mode == 0o755:
        reason, is_ours = "owned by another user", False
        assert machine.ensure_private_folder(folder) == folder
    folder.chmod(mode)
    settings.setattr(os, "geteuid", lambda: folder.stat().st_uid + (not is_ours))
    jax.config.update("jax_compilation_cache_dir", None)
    assert runtime.enable_cache() is None and runtime.reason_cache_is_off().endswith(reason)
    settings.setenv(runtime.CACHE_VARIABLE, "1")
    with pytest.raises(InputError, match=f"^SINSJAX_COMPILE_CACHE: .*: {reason}$"):
        runtime.enable_cache()
    assert jax.config.values["jax_compilation_cache_dir"] is None


def test_entries_of_interrupted_writes_alone_are_removed_at_start(
    settings: pytest.MonkeyPatch,
) -> None:
    here = runtime.enable_cache()
    assert here is not None
    complete = [here / "jit_a-0-cache", here / "jit_a-0-atime", here / "notes.txt"]
    for path in (*complete, here / "jit_b-1-cache"):
        path.write_bytes(b"x")
    settings.setenv(runtime.CACHE_VARIABLE, "1")
    assert runtime.enable_cache() == here
    assert sorted(here.iterdir()) == sorted(complete)


SCRIPT = """
import jax, jax.numpy as jnp, sinsjax
from sinsjax.platform import compile_cache
runtime._MIN_COMPILE_S = 0
sinsjax.configure(devices=1)
hits = []
jax.monitoring.register_event_listener(lambda name, **_: hits.append(name))
x = jax.jit(lambda x: jax.lax.scan(lambda c, t: (jnp.sin(c) + t, c), x, jnp.arange(9.0))[0])(0.3)
print(float(x).hex(), "/jax/compilation_cache/cache_hits" in hits)
"""


def run_process(folder: Path) -> tuple[str, bool, str]:
    """Return the bits of its result, whether it found the program, and its standard error."""
    done = run_python(SCRIPT, **{runtime.CACHE_VARIABLE: str(folder)})
    bits, is_found = done.stdout.split()
    return bits, is_found == "True", done.stderr


@pytest.mark.nightly
def test_second_process_reuses_programs_and_compiles_those_that_are_cut_short(
    tmp_path: Path,
) -> None:
    folder, copy = tmp_path / "cache", tmp_path / "copy"
    bits = run_process(folder)[0]
    assert run_process(folder) == (bits, True, "")
    shutil.copytree(folder, copy)
    for length in (100, 0):
        shutil.rmtree(folder)
        shutil.copytree(copy, folder)
        for entry in folder.glob("jaxlib-*/*-cache"):
            entry.write_bytes(entry.read_bytes()[:length])
        *found, errors = run_process(folder)
        assert found == [bits, False]
        assert "UserWarning: Error reading persistent compilation cache entry" in errors

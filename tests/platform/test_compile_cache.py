import importlib.metadata
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import pytest

import sinsjax
from sinsjax.errors import InputError
from sinsjax.platform import compile_cache, machine

KEYS = (
    "jax_compilation_cache_dir",
    "jax_compilation_cache_max_size",
    "jax_persistent_cache_min_compile_time_secs",
)


@pytest.fixture
def restored_settings(monkeypatch, tmp_path):
    """Undo the settings of a test, and use a separate cache folder."""
    before = {key: jax.config.values[key] for key in KEYS}
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.setattr(machine, "user_cache_folder", lambda: tmp_path / "sinsjax")
    for variable in (compile_cache.VARIABLE, compile_cache._SIZE):
        monkeypatch.delenv(variable, raising=False)
    yield monkeypatch
    for key, value in before.items():
        jax.config.update(key, value)


def test_cache_is_off_when_variable_is_zero(restored_settings, tmp_path):
    restored_settings.setenv(compile_cache.VARIABLE, "0")
    assert compile_cache.enable_cache() is None
    assert compile_cache.reason_off() == "SINSJAX_COMPILE_CACHE=0"
    assert jax.config.values["jax_compilation_cache_dir"] is None
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("asked", ["", " "])
def test_cache_is_on_by_default_with_bounded_size(restored_settings, tmp_path, asked):
    restored_settings.setenv(compile_cache.VARIABLE, asked)
    restored_settings.setattr(compile_cache, "SAFE_JAXLIB", {importlib.metadata.version("jaxlib")})
    here = compile_cache.enable_cache()
    assert here.parent == tmp_path / "sinsjax" / "compiled"
    assert jax.config.values["jax_compilation_cache_max_size"] == compile_cache.MAX_BYTES


def test_cache_is_off_by_default_with_untested_jaxlib(restored_settings, tmp_path):
    restored_settings.setattr(compile_cache, "SAFE_JAXLIB", frozenset())
    assert compile_cache.enable_cache() is None
    assert compile_cache.reason_off().startswith("not tested with jaxlib")
    restored_settings.setenv(compile_cache.VARIABLE, "1")
    assert compile_cache.enable_cache().is_relative_to(tmp_path)


def test_cache_folder_is_private_and_separate_per_jaxlib_and_cpu(restored_settings, tmp_path):
    restored_settings.setenv(compile_cache.VARIABLE, "1")
    here = compile_cache.enable_cache()
    assert str(here) == jax.config.values["jax_compilation_cache_dir"]
    assert here.parent == tmp_path / "sinsjax" / "compiled"
    assert here.stat().st_mode & 0o077 == 0
    restored_settings.setattr(
        machine, "cpu_info", lambda: {"model name": "another", "flags": "avx2"}
    )
    other_cpu = compile_cache.enable_cache()
    restored_settings.setattr(
        machine, "cpu_info", lambda: {"model name": "another", "flags": "avx512f"}
    )
    other_features = compile_cache.enable_cache()
    restored_settings.setattr(compile_cache.importlib.metadata, "version", lambda _: "99.0")
    other_jaxlib = compile_cache.enable_cache()
    assert len({here, other_cpu, other_features, other_jaxlib}) == 4
    assert here.parent == other_cpu.parent == other_jaxlib.parent


@pytest.mark.parametrize("asked", [False, True])
def test_folder_writable_by_others_is_refused_or_not_used(restored_settings, tmp_path, asked):
    restored_settings.setattr(compile_cache, "SAFE_JAXLIB", {importlib.metadata.version("jaxlib")})
    compile_cache.enable_cache().chmod(0o777)
    jax.config.update("jax_compilation_cache_dir", None)
    reason = "other users can write there, and cached programs are executed"
    if asked:
        restored_settings.setenv(compile_cache.VARIABLE, "1")
        with pytest.raises(InputError, match=f"^SINSJAX_COMPILE_CACHE: .*: {reason}$"):
            compile_cache.enable_cache()
    else:
        assert compile_cache.enable_cache() is None
        assert compile_cache.reason_off().endswith(reason)
    assert jax.config.values["jax_compilation_cache_dir"] is None


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ("{}/file", ".*/file/jaxlib.*: Not a directory"),
        ("~nosuchuser/x", "~nosuchuser/x: no such user"),
    ],
)
def test_cache_folder_that_cannot_be_created_raises_input_error(
    restored_settings, tmp_path, asked, told
):
    (tmp_path / "file").write_text("")
    restored_settings.setenv(compile_cache.VARIABLE, asked.format(tmp_path))
    with pytest.raises(InputError, match=f"^SINSJAX_COMPILE_CACHE: {told}"):
        compile_cache.enable_cache()


SCRIPT = """
import jax, jax.numpy as jnp, sinsjax
from sinsjax.platform import compile_cache
compile_cache._MIN_COMPILE_S = 0
sinsjax.configure(devices=1)
hits = []
jax.monitoring.register_event_listener(lambda name, **_: hits.append(name))
x = jax.jit(lambda x: jax.lax.scan(lambda c, t: (jnp.sin(c) + t, c), x, jnp.arange(9.0))[0])(0.3)
print(float(x).hex(), "/jax/compilation_cache/cache_hits" in hits)
"""


def start(folder: Path) -> subprocess.Popen:
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("XLA_", "JAX_", "SINSJAX_"))}
    environment = kept | {
        compile_cache.VARIABLE: str(folder),
        "PYTHONPATH": str(Path(sinsjax.__file__).parents[1]),
    }
    command, pipe = [sys.executable, "-c", SCRIPT], subprocess.PIPE
    return subprocess.Popen(command, env=environment, stdout=pipe, stderr=pipe, text=True)


def result(process: subprocess.Popen) -> tuple[str, bool, str]:
    """The bits of its result, whether it found the program, and its standard error."""
    out, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    bits, found = out.split()
    return bits, found == "True", errors


@pytest.fixture(scope="module")
def first_process(tmp_path_factory):
    """A cache that a process has filled, a copy of it, and the bits of its result."""
    folder = tmp_path_factory.mktemp("first")
    bits, found, errors = result(start(folder / "cache"))
    assert not found and not errors
    shutil.copytree(folder / "cache", folder / "copy")
    return folder, bits


@pytest.fixture
def filled_cache(first_process):
    """The unchanged cache in its first place, since JAX rejects a moved one; with the bits."""
    folder, bits = first_process
    shutil.rmtree(folder / "cache")
    shutil.copytree(folder / "copy", folder / "cache")
    (inner,) = (folder / "cache").glob("jaxlib-*")
    return folder / "cache", inner, bits


@pytest.mark.nightly
def test_second_process_reuses_compiled_programs_of_first(filled_cache):
    """The result is bit-equal."""
    folder, _, bits = filled_cache
    assert result(start(folder)) == (bits, True, "")


@pytest.mark.nightly
@pytest.mark.parametrize("length", [100, 0])
def test_truncated_cache_entry_is_recompiled_with_warning(filled_cache, length):
    folder, inner, bits = filled_cache
    for entry in inner.glob("*-cache"):
        entry.write_bytes(entry.read_bytes()[:length])
    *found, errors = result(start(folder))
    assert found == [bits, False]
    assert "UserWarning: Error reading persistent compilation cache entry" in errors


def test_entries_of_interrupted_writes_alone_are_removed_at_start(restored_settings):
    """JAX writes the file of the access time last, and stops writing where it is missing."""
    restored_settings.setenv(compile_cache.VARIABLE, "1")
    here = compile_cache.enable_cache()
    complete = [here / "jit_a-0-cache", here / "jit_a-0-atime"]
    for path in (*complete, here / "jit_b-1-cache", here / "notes.txt"):
        path.write_bytes(b"x")
    assert compile_cache.enable_cache() == here
    assert sorted(here.iterdir()) == sorted([*complete, here / "notes.txt"])


@pytest.mark.nightly
def test_simultaneous_first_starts_give_same_result(tmp_path, first_process):
    processes = [start(tmp_path / "new") for _ in range(3)]
    assert [result(process)[0] for process in processes] == 3 * [first_process[1]]
    assert result(start(tmp_path / "new")) == (first_process[1], True, "")

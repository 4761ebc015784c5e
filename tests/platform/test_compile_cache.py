"""JAX's compilation cache: when it is on, in which private folder, and after interruptions."""

import os
import stat
from importlib.metadata import version

import jax
import pytest
from support.commands import run_python

from sinsjax.errors import InputError
from sinsjax.platform import machine, runtime


@pytest.fixture
def settings(monkeypatch, tmp_path):
    """Undo the settings of a test, and use a separate cache folder with any jaxlib."""
    before = {key: value for key, value in jax.config.values.items() if "_cache_" in key}
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.setattr(machine, "user_cache_folder", lambda: tmp_path / "sinsjax")
    monkeypatch.setattr(runtime, "CACHE_SAFE_JAXLIB", {version("jaxlib")})
    for variable in (runtime.CACHE_VARIABLE, runtime._CACHE_SIZE):
        monkeypatch.delenv(variable, raising=False)
    yield monkeypatch
    for key, value in before.items():
        jax.config.update(key, value)


def test_cache_is_on_by_default_with_tested_jaxlib_or_on_request(settings, tmp_path):
    settings.setenv(runtime.CACHE_VARIABLE, "0")
    assert runtime.enable_cache() is None and not list(tmp_path.iterdir())
    settings.setenv(runtime.CACHE_VARIABLE, " ")
    here = runtime.enable_cache()
    assert here.parent == tmp_path / "sinsjax" / "compiled"
    assert jax.config.values["jax_compilation_cache_max_size"] == runtime.MAX_CACHE_BYTES
    jax.config.update("jax_compilation_cache_dir", None)
    settings.setattr(runtime, "CACHE_SAFE_JAXLIB", frozenset())
    assert runtime.enable_cache() is None
    settings.setenv(runtime.CACHE_VARIABLE, "1")
    assert runtime.enable_cache() == here


def test_cache_has_a_folder_per_jaxlib_and_cpu(settings):
    settings.setenv(runtime.CACHE_VARIABLE, "1")
    folders = [runtime.enable_cache()]
    for flags in ("avx2", "avx512f"):
        cpu = {"model name": "another", "flags": flags}
        settings.setattr(machine, "cpu_info", lambda cpu=cpu: cpu)
        folders.append(runtime.enable_cache())
    settings.setattr(runtime.importlib.metadata, "version", lambda _: "99.0")
    folders.append(runtime.enable_cache())
    assert len({*folders}) == 4 and len({folder.parent for folder in folders}) == 1


@pytest.mark.parametrize("mode", [0o755, 0o775, 0o777])
def test_folder_is_private_or_not_used(settings, mode):
    is_ours = mode != 0o755
    reason = "other users can write there, .*" if is_ours else "owned by another user"
    folder = runtime.enable_cache()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    folder.chmod(mode)
    settings.setattr(os, "geteuid", lambda: folder.stat().st_uid + (not is_ours))
    jax.config.update("jax_compilation_cache_dir", None)
    assert runtime.enable_cache() is None
    settings.setenv(runtime.CACHE_VARIABLE, "1")
    with pytest.raises(InputError, match=f"^SINSJAX_COMPILE_CACHE: .*: {reason}$"):
        runtime.enable_cache()
    assert jax.config.values["jax_compilation_cache_dir"] is None


def test_entries_of_interrupted_writes_alone_are_removed_at_start(settings):
    here = runtime.enable_cache()
    complete = [here / "jit_a-0-atime", here / "jit_a-0-cache", here / "notes.txt"]
    for path in (*complete, here / "jit_b-1-cache"):
        path.write_bytes(b"x")
    settings.setenv(runtime.CACHE_VARIABLE, "1")
    assert runtime.enable_cache() == here
    assert sorted(here.iterdir()) == complete


SCRIPT = """
import jax, jax.numpy as jnp, sinsjax
from sinsjax.platform import runtime
runtime._MIN_COMPILE_S = 0
sinsjax.configure(devices=1)
hits = []
jax.monitoring.register_event_listener(lambda name, **_: hits.append(name))
x = jax.jit(lambda x: jax.lax.scan(lambda c, t: (jnp.sin(c) + t, c), x, jnp.arange(9.0))[0])(0.3)
print(float(x).hex(), "/jax/compilation_cache/cache_hits" in hits)
"""


@pytest.mark.nightly
def test_second_process_reuses_programs(tmp_path):
    variables = {runtime.CACHE_VARIABLE: str(tmp_path / "cache")}
    (bits, is_found), again = (run_python(SCRIPT, **variables).stdout.split() for _ in range(2))
    assert is_found == "False" and again == [bits, "True"]

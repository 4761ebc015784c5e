import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

import sinsjax
from sinsjax import compile_cache, machine
from sinsjax.types import InputError

KEYS = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"


@pytest.fixture
def unchanged(monkeypatch, tmp_path):
    """What a test sets is undone; the user's cache folder is its own."""
    before = {key: jax.config.values[key] for key in KEYS}
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.setattr(machine, "cache_folder", lambda: tmp_path / "sinsjax")
    monkeypatch.delenv(compile_cache.VARIABLE, raising=False)
    yield monkeypatch
    for key, value in before.items():
        jax.config.update(key, value)


@pytest.mark.parametrize("asked", ["", "0", " "])
def test_nothing_is_kept_unless_asked_for(unchanged, tmp_path, asked):
    unchanged.setenv(compile_cache.VARIABLE, asked)
    assert compile_cache.enable() is None
    assert jax.config.values["jax_compilation_cache_dir"] is None
    assert not list(tmp_path.iterdir())


def test_the_folder_is_this_users_alone_and_has_one_for_each_jaxlib_and_cpu(unchanged, tmp_path):
    unchanged.setenv(compile_cache.VARIABLE, "1")
    here = compile_cache.enable()
    assert str(here) == jax.config.values["jax_compilation_cache_dir"]
    assert here.parent == tmp_path / "sinsjax" / "compiled"
    assert all(place.stat().st_mode & 0o077 == 0 for place in (here, here.parent))
    unchanged.setattr(machine, "cpu", lambda: {"model name": "another", "flags": "avx2"})
    other_cpu = compile_cache.enable()
    unchanged.setattr(compile_cache.importlib.metadata, "version", lambda _: "99.0")
    other_jaxlib = compile_cache.enable()
    assert len({here, other_cpu, other_jaxlib}) == 3
    assert here.parent == other_cpu.parent == other_jaxlib.parent


def test_a_folder_that_others_can_write_to_is_refused(unchanged, tmp_path):
    unchanged.setenv(compile_cache.VARIABLE, str(tmp_path / "mine"))
    folder = compile_cache.enable()
    folder.chmod(0o707)
    with pytest.raises(InputError, match="others can write there"):
        compile_cache.enable()


def test_a_folder_above_that_others_can_write_to_is_refused(unchanged, tmp_path):
    """They rename the leaf as soon as it is there, and put their own in its place."""
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs").chmod(0o777)
    unchanged.setenv(compile_cache.VARIABLE, str(tmp_path / "theirs" / "leaf"))
    told = "^SINSJAX_COMPILE_CACHE: .*/theirs: others can write there, and what the cache holds is"
    with pytest.raises(InputError, match=told):
        compile_cache.enable()
    assert not list((tmp_path / "theirs").iterdir())
    assert jax.config.values["jax_compilation_cache_dir"] is None


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ("{}/file", ".*/file/jaxlib.*: Not a directory"),
        ("{}/loop/x", ".*/loop.*: .*[Ss]ymbolic link"),
        ("{}/" + 300 * "x", ".*: File name too long"),
        ("~nosuchuser/x", "~nosuchuser/x: there is no such user"),
    ],
)
def test_a_folder_that_cannot_be_made_is_named(unchanged, tmp_path, asked, told):
    (tmp_path / "file").write_text("")
    (tmp_path / "loop").symlink_to("loop")
    unchanged.setenv(compile_cache.VARIABLE, asked.format(tmp_path))
    with pytest.raises(InputError, match=f"^SINSJAX_COMPILE_CACHE: {told}"):
        compile_cache.enable()


def test_a_second_process_finds_what_the_first_compiled(tmp_path):
    """And gives the same bits."""
    script = """
import jax, jax.numpy as jnp, sinsjax
sinsjax.configure(devices=1)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
hits = []
jax.monitoring.register_event_listener(lambda name, **_: hits.append(name))
x = jax.jit(lambda x: jax.lax.scan(lambda c, t: (jnp.sin(c) + t, c), x, jnp.arange(9.0))[0])(0.3)
print(float(x).hex(), "/jax/compilation_cache/cache_hits" in hits)
"""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("XLA_", "JAX_", "SINSJAX_"))}
    environment = kept | {
        compile_cache.VARIABLE: str(tmp_path),
        "PYTHONPATH": str(Path(sinsjax.__file__).parents[1]),
    }

    def told() -> list[str]:
        command = [sys.executable, "-c", script]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        return done.stdout.split()

    (first, missed), (second, found) = told(), told()
    assert first == second
    assert (missed, found) == ("False", "True")

"""XLA's options: set in full after a trial, or not at all, and seen in what is compiled."""

import importlib.metadata
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from sinsjax.platform import machine
from sinsjax.platform.machine import ConfigurationWarning, merge_xla_options, parse_xla_flags

OPTIONS = machine._PLAIN | machine._EXTRA
EXTRA = "--xla_backend_extra_options"


@pytest.fixture
def unset_flags(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[pytest.MonkeyPatch]:
    """No options set, an untested jaxlib, and an instruction set without its own options."""
    for name in ("XLA_FLAGS", machine.OPT_OUT):
        monkeypatch.setenv(name, "")  # so that what a test sets is undone
        monkeypatch.delenv(name)
    monkeypatch.setattr(machine, "user_cache_folder", lambda: tmp_path)
    monkeypatch.setattr(machine, "instruction_set", lambda: "NEON")
    monkeypatch.setattr(machine, "TESTED_JAXLIB", frozenset())
    machine.xla_options_work.cache_clear()
    yield monkeypatch
    machine.xla_options_work.cache_clear()


@pytest.mark.parametrize(
    "given",
    [
        "",
        "--xla_a=1 --xla_cpu_prefer_vector_width=256",
        f"{EXTRA}=xla_c=2,--vectorize-memory-check-threshold=7 --xla_b=3",
        f'{EXTRA}="--llvm-d=4" {EXTRA}=xla_cpu_use_multi_output_fusion=false',
    ],
)
def test_options_of_the_user_are_kept_and_the_others_added_once(
    unset_flags: pytest.MonkeyPatch, given: str
) -> None:
    unset_flags.setattr(machine, "_can_compile", lambda flags: True)
    unset_flags.setenv("XLA_FLAGS", given)
    for _ in range(2):
        machine.apply_xla_options()
        flags = os.environ["XLA_FLAGS"]
        assert flags.startswith(given) and parse_xla_flags(flags) == OPTIONS | parse_xla_flags(
            given
        )
    names = re.findall(r"([\w-]+)=(?!-|xla)", flags)
    assert len(names) == len(set(names)) and not machine.missing_xla_options()


def test_tested_jaxlib_is_not_tried_nor_one_that_opts_out(unset_flags: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("started a process")

    unset_flags.setattr(subprocess, "run", refuse)
    unset_flags.setenv(machine.OPT_OUT, "0")
    machine.apply_xla_options()
    assert "XLA_FLAGS" not in os.environ
    unset_flags.delenv(machine.OPT_OUT)
    unset_flags.setattr(machine, "TESTED_JAXLIB", {importlib.metadata.version("jaxlib")})
    machine.apply_xla_options()
    assert os.environ["XLA_FLAGS"] == merge_xla_options("", OPTIONS)


def test_flag_file_is_left_alone_with_warning(unset_flags: pytest.MonkeyPatch) -> None:
    unset_flags.setenv("XLA_FLAGS", "/flags")
    with pytest.warns(ConfigurationWarning, match="names the file /flags; add --xla"):
        machine.apply_xla_options()
    assert os.environ["XLA_FLAGS"] == "/flags"


@pytest.mark.nightly
@pytest.mark.parametrize("unknown", ["xla_no_such_flag", "--no-such-option"])
def test_jaxlib_that_refuses_an_option_gets_none(
    unset_flags: pytest.MonkeyPatch, unknown: str
) -> None:
    """XLA reports an unknown option when it starts, LLVM when it compiles."""
    kind = "_EXTRA" if unknown.startswith("--") else "_PLAIN"
    unset_flags.setattr(machine, kind, {unknown: "1"})
    with pytest.warns(ConfigurationWarning, match=r"jaxlib \S+ refuses them"):
        machine.apply_xla_options()
    assert not os.environ.get("XLA_FLAGS")


def test_successful_trial_is_remembered_and_a_failed_one_sets_nothing(
    unset_flags: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    unset_flags.setattr(sys, "executable", str(tmp_path / "missing"))
    with pytest.warns(ConfigurationWarning, match="refuses them"):
        machine.apply_xla_options()
    assert not os.environ.get("XLA_FLAGS")
    tried: list[str] = []
    unset_flags.setattr(machine, "_can_compile", lambda flags: not tried.append(flags))
    for extra in (machine._EXTRA, machine._EXTRA, {}):
        unset_flags.setattr(machine, "_EXTRA", extra)
        machine.xla_options_work.cache_clear()
        assert machine.xla_options_work()
    assert tried == [merge_xla_options("", OPTIONS), merge_xla_options("", machine._PLAIN)]


@pytest.mark.parametrize(("instructions", "width"), [("AVX512", "8"), ("AVX2", "4"), ("SVE", None)])
def test_loop_vector_width_follows_instruction_set(
    unset_flags: pytest.MonkeyPatch, instructions: str, width: str | None
) -> None:
    unset_flags.setattr(machine, "instruction_set", lambda: instructions)
    options = machine.required_xla_options()
    assert options.items() >= OPTIONS.items()
    assert options.get("--force-vector-width") == width
    assert options.get("--force-vector-interleave") == (width and "1")


@pytest.mark.skipif(
    os.environ.get(machine.OPT_OUT) == "0", reason="the XLA options are opted out of"
)
def test_loop_is_compiled_to_one_function_with_fusions_of_several_outputs() -> None:
    """Extra options are ignored if unknown, so the compiled program must show their effect."""

    def step(carry: tuple[jax.Array, jax.Array], t: jax.Array) -> tuple:
        a, b = carry
        product = jnp.sin(a) * b
        return (product + t, product * 0.5 + b), None

    x = jax.ShapeDtypeStruct((32768,), jnp.float64)  # beyond XLA's default limit of a small loop
    loop = jax.jit(lambda x: jax.lax.scan(step, (x, x), jnp.arange(7.0))[0])
    text = loop.lower(x).compile().as_text()
    assert 'xla_cpu_small_call="true"' in text
    assert re.search(r"= \(.*\) fusion\(", text)

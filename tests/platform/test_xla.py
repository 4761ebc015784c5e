import os
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sinsjax.platform import xla
from sinsjax.platform.xla import ConfigurationWarning, merge_options, parse_flags

OPTIONS = xla._PLAIN | xla._EXTRA


@pytest.fixture
def unset_flags(monkeypatch, tmp_path):
    """No options set, an empty cache folder, an instruction set without its own options."""
    for name in ("XLA_FLAGS", xla.OPT_OUT):
        monkeypatch.setenv(name, "")  # so that what a test sets is undone
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(xla, "instruction_set", lambda: "NEON")
    xla.options_work.cache_clear()
    yield monkeypatch
    xla.options_work.cache_clear()


@pytest.fixture
def no_process(monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("started a process")

    monkeypatch.setattr(subprocess, "run", refuse)


PLAIN_NAMES = st.sampled_from([*xla._PLAIN] + ["xla_a", "xla_b"])
EXTRA_NAMES = st.sampled_from([*xla._EXTRA] + ["xla_c", "--llvm-d"])


def items(names):
    return st.lists(st.tuples(names, st.integers(0, 9)), max_size=4)


@st.composite
def user_flags(draw):
    plain = [f"--{name}={value}" for name, value in draw(items(PLAIN_NAMES))]
    for some in draw(st.lists(items(EXTRA_NAMES), max_size=2)):
        quote = draw(st.sampled_from(["", '"', "'"]))
        value = ",".join(f"{name}={value}" for name, value in some)
        plain.append(f"--xla_backend_extra_options={quote}{value}{quote}")
    return " ".join(draw(st.permutations(plain)))


@given(user_flags())
def test_merge_options_keeps_user_values_and_adds_rest_once(flags):
    merged = merge_options(flags, OPTIONS)
    assert parse_flags(merged) == OPTIONS | parse_flags(flags)
    assert merge_options(merged, OPTIONS) == merged


def test_apply_options_sets_flags_without_starting_process(unset_flags, no_process):
    unset_flags.setattr(xla, "_jaxlib_version", lambda: "0.10.2")
    xla.apply_options()
    assert os.environ["XLA_FLAGS"] == merge_options("", OPTIONS)
    assert not xla.missing_options()


def test_apply_options_respects_opt_out(unset_flags, no_process):
    unset_flags.setattr(xla, "_jaxlib_version", lambda: "99.0")
    unset_flags.setenv(xla.OPT_OUT, "0")
    xla.apply_options()
    assert "XLA_FLAGS" not in os.environ


def test_flag_file_is_left_alone_with_warning(unset_flags, tmp_path):
    unset_flags.setenv("XLA_FLAGS", str(tmp_path / "flags"))
    told = f"names the file {tmp_path / 'flags'}; add {merge_options('', OPTIONS)} ("
    with pytest.warns(ConfigurationWarning, match=re.escape(told)):
        xla.apply_options()
    assert os.environ["XLA_FLAGS"] == str(tmp_path / "flags")


@pytest.mark.nightly
@pytest.mark.parametrize("unknown", ["xla_no_such_flag", "--no-such-option"])
def test_jaxlib_that_refuses_an_option_gets_none_after_one_trial(unset_flags, unknown):
    """XLA reports an unknown option when it starts, LLVM when it compiles."""
    kind = "_EXTRA" if unknown.startswith("--") else "_PLAIN"
    unset_flags.setattr(xla, kind, {unknown: "1"})
    unset_flags.setattr(xla, "_jaxlib_version", lambda: "99.0")
    with pytest.warns(ConfigurationWarning, match="jaxlib 99.0 refuses them"):
        xla.apply_options()
    assert not os.environ.get("XLA_FLAGS")


@pytest.mark.parametrize("works", [True, False])
def test_answer_of_trial_is_stored_for_these_options(unset_flags, works):
    tried = []

    def compiles(flags: str) -> bool:
        tried.append(flags)
        return works or not flags

    unset_flags.setattr(xla, "_can_compile", compiles)
    for extra in (xla._EXTRA, xla._EXTRA, {}):
        unset_flags.setattr(xla, "_EXTRA", extra)
        xla.options_work.cache_clear()
        assert xla.options_work("99.0") == works
    assert tried == ["", merge_options("", OPTIONS), "", merge_options("", xla._PLAIN)]


def test_failed_trial_refuses_all_options_and_is_not_stored(unset_flags, tmp_path):
    unset_flags.setattr(sys, "executable", str(tmp_path / "missing"))
    unset_flags.setattr(xla, "_jaxlib_version", lambda: "99.0")
    assert not xla.missing_options() and not xla.options_work("99.0")
    assert not list(tmp_path.rglob("*.json"))


@pytest.mark.parametrize(
    ("instructions", "width"),
    [("AVX512", "8"), ("AVX2", "4"), ("AVX", "4"), ("SSE4_2", "4"), ("SVE", None), ("s390x", None)],
)
def test_loop_vector_width_follows_instruction_set(unset_flags, instructions, width):
    unset_flags.setattr(xla, "instruction_set", lambda: instructions)
    set_ = xla.required_options()
    assert set_.items() >= OPTIONS.items()
    assert set_.get("--force-vector-width") == width
    assert set_.get("--force-vector-interleave") == (width and "1")


@pytest.mark.skipif(xla.is_opted_out(), reason="the XLA options are opted out of")
def test_loop_is_compiled_to_one_function_with_fusions_of_several_outputs():
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

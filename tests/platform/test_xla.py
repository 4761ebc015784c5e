import json
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
from sinsjax.platform.xla import ConfigurationWarning, XlaOption, merge_options, parse_flags

OPTIONS = xla._OPTIONS
ALL = {option.name: option.value for option in OPTIONS}


@pytest.fixture
def unset_flags(monkeypatch, tmp_path):
    """No options set, an empty cache folder, an instruction set without its own options."""
    for name in ("XLA_FLAGS", xla.OPT_OUT):
        monkeypatch.setenv(name, "")  # so that what a test sets is undone
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(xla, "instruction_set", lambda: "NEON")
    xla.refused_options.cache_clear()
    yield monkeypatch
    xla.refused_options.cache_clear()


@pytest.fixture
def no_process(monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("started a process")

    monkeypatch.setattr(subprocess, "run", refuse)


PLAIN_NAMES = st.sampled_from([o.name for o in OPTIONS if not o.extra] + ["xla_a", "xla_b"])
EXTRA_NAMES = st.sampled_from([o.name for o in OPTIONS if o.extra] + ["xla_c", "--llvm-d"])


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
    assert parse_flags(merged) == ALL | parse_flags(flags)
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


def test_apply_warns_and_leaves_flag_file_unchanged(unset_flags, tmp_path):
    file = tmp_path / "flags"
    file.write_text(merge_options("", OPTIONS[1:]))
    unset_flags.setenv("XLA_FLAGS", str(file))
    told = f"names the file {file}; add {merge_options('', OPTIONS[:1])} to it"
    with pytest.warns(ConfigurationWarning, match=re.escape(told)):
        xla.apply_options()
    assert os.environ["XLA_FLAGS"] == xla.extended_flags() == str(file)
    file.write_text(merge_options("", OPTIONS))
    xla.apply_options()


@pytest.mark.nightly
def test_unknown_jaxlib_is_tried_once_and_cached(unset_flags):
    """XLA reports an unknown option when it starts, LLVM when it compiles."""
    unknown = XlaOption("xla_no_such_flag", "1", extra=False), XlaOption("--no-such-option", "1")
    unset_flags.setattr(xla, "_OPTIONS", (*unknown, *OPTIONS))
    unset_flags.setattr(xla, "_jaxlib_version", lambda: "99.0")
    told = "99.0 does not know --xla_no_such_flag, --no-such-option"
    with pytest.warns(ConfigurationWarning, match=told):
        xla.apply_options()
    assert parse_flags(os.environ["XLA_FLAGS"]) == ALL
    xla.refused_options.cache_clear()
    unset_flags.setattr(xla, "can_compile", lambda flags: pytest.fail("tried again"))
    assert xla.refused_options("99.0") == {"xla_no_such_flag", "--no-such-option"}


def test_only_options_that_fail_alone_are_refused(unset_flags, tmp_path):
    """The answer holds for these options only: other options are tried again."""
    tried = []

    def compiles(flags: str) -> bool:
        tried.append(flags)
        return "region_analysis" not in flags

    unset_flags.setattr(xla, "can_compile", compiles)
    refused = "xla_cpu_copy_insertion_use_region_analysis"
    for options in (OPTIONS, OPTIONS, OPTIONS[1:]):
        unset_flags.setattr(xla, "_OPTIONS", options)
        xla.refused_options.cache_clear()
        assert xla.refused_options("99.0") == {refused}
    assert len(tried) == (2 + len(OPTIONS)) + (2 + len(OPTIONS) - 1)
    assert len(json.loads((tmp_path / "sinsjax" / "xla_options.json").read_text())) == 2


def test_failed_trial_refuses_all_options_and_is_not_cached(unset_flags, tmp_path):
    unset_flags.setattr(sys, "executable", str(tmp_path / "missing"))
    unset_flags.setattr(xla, "_jaxlib_version", lambda: "99.0")
    assert xla.refused_options("99.0") == ALL.keys()
    assert xla.extended_flags() == ""
    assert not list(tmp_path.rglob("*.json"))


def test_flags_are_read_from_flag_file(unset_flags, tmp_path):
    file = tmp_path / "flags"
    file.write_text("--xla_cpu_max_isa=AVX2\n--xla_backend_extra_options=--force-vector-width=4\n")
    unset_flags.setenv("XLA_FLAGS", str(file))
    assert xla.current_options() == {"xla_cpu_max_isa": "AVX2", "--force-vector-width": "4"}
    unset_flags.setenv("XLA_FLAGS", str(tmp_path / "missing"))
    assert xla.current_options() == {}


@pytest.mark.parametrize(
    ("instructions", "width"),
    [("AVX512", "8"), ("AVX2", "4"), ("AVX", "4"), ("SSE4_2", "4"), ("SVE", None), ("s390x", None)],
)
def test_loop_vector_width_follows_instruction_set(unset_flags, instructions, width):
    unset_flags.setattr(xla, "instruction_set", lambda: instructions)
    set_ = {option.name: option.value for option in xla.required_options()}
    assert set_.items() >= ALL.items()
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

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
PLAIN = "--xla_cpu_prefer_vector_width=512 --xla_cpu_copy_insertion_use_region_analysis=true"
EXTRA = (
    "xla_cpu_small_while_loop_byte_threshold=1000000000,xla_cpu_use_multi_output_fusion=true,"
    "--vectorize-memory-check-threshold=100000"
)


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


@pytest.mark.parametrize(
    ("flags", "merged"),
    [
        ("", f"{PLAIN} --xla_backend_extra_options={EXTRA}"),
        ("--xla_dump_to=/x", f"--xla_dump_to=/x {PLAIN} --xla_backend_extra_options={EXTRA}"),
        ("--xla_backend_extra_options=a=1", f"--xla_backend_extra_options=a=1,{EXTRA} {PLAIN}"),
        ("--xla_backend_extra_options=", f"--xla_backend_extra_options={EXTRA} {PLAIN}"),
        (
            '--xla_backend_extra_options="a=1" --xla_dump_to=/x',
            f'--xla_backend_extra_options="a=1,{EXTRA}" --xla_dump_to=/x {PLAIN}',
        ),
        (
            "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion=false"
            " --xla_backend_extra_options=b=2 --xla_cpu_prefer_vector_width=256",
            "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion=false"
            " --xla_backend_extra_options=b=2,"
            "xla_cpu_small_while_loop_byte_threshold=1000000000,"
            "--vectorize-memory-check-threshold=100000"
            " --xla_cpu_prefer_vector_width=256 --xla_cpu_copy_insertion_use_region_analysis=true",
        ),
        # Hyphens inside a value begin no flag.
        (
            "--xla_backend_extra_options=--vectorize-memory-check-threshold=7 --xla_dump_to=a--b=1",
            "--xla_backend_extra_options=--vectorize-memory-check-threshold=7,"
            "xla_cpu_small_while_loop_byte_threshold=1000000000,xla_cpu_use_multi_output_fusion=true"
            f" --xla_dump_to=a--b=1 {PLAIN}",
        ),
    ],
)
def test_merge_options_extends_user_flags(flags, merged):
    assert merge_options(flags, OPTIONS) == merged


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


@pytest.mark.slow
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


def test_damaged_answers_are_rewritten(unset_flags, tmp_path):
    unset_flags.setattr(xla, "can_compile", lambda flags: True)
    answers = tmp_path / "sinsjax" / "xla_options.json"
    answers.parent.mkdir()
    for damaged in ("{", "[1]", '{"99.0": 3}'):
        answers.write_text(damaged)
        xla.refused_options.cache_clear()
        assert xla.refused_options("99.0") == frozenset()
        assert json.loads(answers.read_text()) == {f"jaxlib 99.0 {merge_options('', OPTIONS)}": []}


def test_failed_trial_refuses_all_options_and_is_not_cached(unset_flags, tmp_path):
    unset_flags.setattr(sys, "executable", str(tmp_path / "missing"))
    unset_flags.setattr(xla, "_jaxlib_version", lambda: "99.0")
    assert xla.refused_options("99.0") == ALL.keys()
    assert xla.extended_flags() == ""
    assert not list(tmp_path.rglob("*.json"))


def test_unwritable_cache_folder_is_ignored(unset_flags, tmp_path):
    unset_flags.setattr(xla, "can_compile", lambda flags: True)
    (tmp_path / "sinsjax").write_text("a file where the folder should be")
    assert xla.refused_options("99.0") == frozenset()


def test_invalid_flag_value_does_not_compile():
    assert not xla.can_compile("--xla_cpu_prefer_vector_width=wide")


def test_instruction_set_in_use_follows_xla_flags(monkeypatch, tmp_path):
    monkeypatch.setattr(xla.machine, "instruction_set", lambda limit: limit)
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    assert xla.instruction_set() == ""
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_max_isa=AVX --xla_cpu_max_isa=AVX2")
    assert xla.instruction_set() == "AVX2"
    (tmp_path / "flags").write_text("--xla_cpu_max_isa=AVX\n")
    monkeypatch.setenv("XLA_FLAGS", str(tmp_path / "flags"))
    assert xla.instruction_set() == "AVX"


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

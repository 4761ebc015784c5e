import json
import os
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sinsjax.platform import xla, xla_trial
from sinsjax.platform.xla import OPTIONS, Option, OptionsWarning, flag_values, merge_options
from sinsjax.platform.xla_trial import Trial, attempt, vectorised_share

ALL = {option.name: option.value for option in OPTIONS}
PLAIN = "--xla_cpu_prefer_vector_width=512 --xla_cpu_copy_insertion_use_region_analysis=true"
EXTRA = (
    "xla_cpu_small_while_loop_byte_threshold=1000000000,xla_cpu_use_multi_output_fusion=true,"
    "--vectorize-memory-check-threshold=100000"
)


@pytest.fixture
def unset(monkeypatch, tmp_path):
    """No options yet, no backend, an empty cache folder."""
    for name in ("XLA_FLAGS", xla.OPT_OUT):
        monkeypatch.setenv(name, "")  # so that what a test sets is undone
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(xla, "backend_started", lambda: False)
    return monkeypatch


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
    assert merge_options(flags) == merged


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
    merged = merge_options(flags)
    assert flag_values(merged) == ALL | flag_values(flags)
    assert merge_options(merged) == merged


def test_merge_leaves_out_refused_flags():
    assert merge_options("", frozenset({"xla_backend_extra_options"})) == PLAIN
    assert "vector_width" not in merge_options("", frozenset({"xla_cpu_prefer_vector_width"}))
    without = merge_options("", frozenset({"--vectorize-memory-check-threshold"}))
    assert flag_values(without).items() == ALL.items() - {
        ("--vectorize-memory-check-threshold", "100000")
    }


def test_apply_options_sets_flags_without_starting_process(unset, no_process):
    unset.setattr(xla, "_jaxlib", lambda: "0.10.2")
    xla.apply_options()
    assert os.environ["XLA_FLAGS"] == merge_options("")


def test_apply_options_respects_opt_out(unset):
    unset.setenv(xla.OPT_OUT, "0")
    xla.apply_options()
    assert "XLA_FLAGS" not in os.environ


def test_apply_warns_when_jax_has_started(unset):
    unset.setattr(xla, "backend_started", lambda: True)
    with pytest.warns(OptionsWarning, match="JAX has started already"):
        xla.apply_options()
    assert "XLA_FLAGS" not in os.environ
    unset.setenv("XLA_FLAGS", merge_options(""))
    xla.apply_options()


def test_apply_warns_and_leaves_flag_file_unchanged(unset):
    unset.setenv("XLA_FLAGS", "flags.txt")
    with pytest.warns(OptionsWarning, match="names the file flags.txt"):
        xla.apply_options()
    assert os.environ["XLA_FLAGS"] == "flags.txt"


@pytest.mark.slow
def test_unknown_jaxlib_is_tried_once_and_cached(unset):
    """XLA says so when it starts, LLVM when it compiles."""
    unknown = Option("xla_no_such_flag", "1", extra=False), Option("--no-such-option", "1")
    unset.setattr(xla, "OPTIONS", (*unknown, *OPTIONS))
    unset.setattr(xla, "_jaxlib", lambda: "99.0")
    with pytest.warns(
        OptionsWarning, match="99.0 does not know --no-such-option, --xla_no_such_flag"
    ):
        xla.apply_options()
    refused = frozenset({"xla_no_such_flag", "--no-such-option"})
    assert flag_values(os.environ["XLA_FLAGS"]) == ALL
    unset.setattr(xla_trial, "attempt", lambda flags: pytest.fail("tried again"))
    assert xla.refused_flags("99.0") == refused


def test_damaged_options_cache_is_rewritten(unset, tmp_path):
    unset.setattr(xla_trial, "attempt", lambda flags: Trial(frozenset(), None))
    cache = tmp_path / "sinsjax" / "xla_options.json"
    cache.parent.mkdir()
    for damaged in ("{", "[1]", '{"99.0": 3}'):
        cache.write_text(damaged)
        assert xla.refused_flags("99.0") == frozenset()
        flags = dict.fromkeys((option.flag for option in xla.wanted()), True)
        assert json.loads(cache.read_text()) == {"99.0": flags}


def test_failed_trial_refuses_all_options_and_is_not_cached(unset, tmp_path):
    unset.setattr(sys, "executable", str(tmp_path / "missing"))
    refused = xla.refused_flags("99.0")
    assert refused == {option.flag for option in xla.wanted()}
    assert merge_options("", refused) == ""
    assert not list(tmp_path.rglob("*.json"))


def test_unwritable_options_cache_is_ignored(unset, tmp_path):
    unset.setattr(xla_trial, "attempt", lambda flags: Trial(frozenset(), None))
    (tmp_path / "sinsjax").write_text("a file where the folder should be")
    assert xla.refused_flags("99.0") == frozenset()


def test_instruction_set_in_use_follows_xla_flags(unset, tmp_path):
    unset.setattr(xla.machine, "instructions", lambda limit: limit)
    assert xla.instructions() == ""
    unset.setenv("XLA_FLAGS", "--xla_cpu_max_isa=AVX --xla_cpu_max_isa=AVX2")
    assert xla.instructions() == "AVX2"
    (tmp_path / "flags").write_text("--xla_cpu_max_isa=AVX\n")
    unset.setenv("XLA_FLAGS", str(tmp_path / "flags"))
    assert xla.instructions() == "AVX"


def test_flags_are_read_from_flag_file(unset, tmp_path):
    file = tmp_path / "flags"
    file.write_text("--xla_cpu_max_isa=AVX2\n--xla_backend_extra_options=--force-vector-width=4\n")
    unset.setenv("XLA_FLAGS", str(file))
    assert xla.given() == {"xla_cpu_max_isa": "AVX2", "--force-vector-width": "4"}
    unset.setenv("XLA_FLAGS", str(tmp_path / "missing"))
    assert xla.given() == {}


@pytest.mark.parametrize(
    ("instructions", "width"),
    [("AVX512", "8"), ("AVX2", "4"), ("AVX", "4"), ("SSE4_2", "4"), ("SVE", None), ("s390x", None)],
)
def test_loop_vector_width_follows_instruction_set(unset, instructions, width):
    unset.setattr(xla, "instructions", lambda: instructions)
    set_ = {option.name: option.value for option in xla.loop_options()}
    assert set_.get("--force-vector-width") == width
    assert set_.get("--force-vector-interleave") == (width and "1")


def test_loop_options_are_added_only_before_jax_starts(unset):
    unset.setattr(xla, "_jaxlib", lambda: "0.10.2")
    xla.apply_options()
    unset.setattr(xla, "instructions", lambda: "AVX2")
    unset.setattr(xla, "backend_started", lambda: True)
    xla.apply_loop_options()
    assert flag_values(os.environ["XLA_FLAGS"]) == ALL
    unset.setattr(xla, "backend_started", lambda: False)
    xla.apply_loop_options()
    loops = {"--force-vector-width": "4", "--force-vector-interleave": "1"}
    assert flag_values(os.environ["XLA_FLAGS"]) == ALL | loops


LLVM = """
loop_a: ; preds = %entry, %loop_a
  %1 = fmul reassoc double %x, %y
  %2 = fadd double %1, %y
  br i1 %done, label %exit_a, label %loop_a
vector.body: ; preds = %entry, %vector.body
  %3 = fmul <8 x double> %x, %y
  %4 = fadd <8 x double> %3, %y
  br i1 %over, label %exit_a, label %vector.body
exit_a: ; preds = %vector.body, %loop_a
  %5 = fadd double %once, %more
loop_b: ; preds = %exit_a, %loop_b
  %6 = fsub double %x, %y
  br i1 %end, label %exit_b, label %loop_b
exit_b: ; preds = %loop_b
  ret void
"""


def test_loop_with_vectorised_twin_counts_as_vectorised():
    assert vectorised_share(LLVM) == pytest.approx(2 / 3)
    assert vectorised_share(LLVM.replace("fsub double", "fsub <4 x double>")) == 1.0
    assert vectorised_share(LLVM.replace("<8 x double>", "<8 x float>")) == 0.0
    assert vectorised_share("define void @f() {\n  ret void\n}") is None


@pytest.mark.slow
@pytest.mark.skipif(not xla.loop_options(), reason="no loop options for this instruction set")
def test_options_vectorise_every_loop_of_step():
    assert attempt(merge_options("", options=xla.wanted())) == Trial(frozenset(), 1.0)
    plain = tuple(option for option in OPTIONS if not option.name.startswith("--"))
    without = attempt(merge_options("", options=plain))
    assert without.vectorised < 0.9


def test_trial_with_invalid_flag_value_returns_none():
    assert attempt("--xla_cpu_prefer_vector_width=wide") is None

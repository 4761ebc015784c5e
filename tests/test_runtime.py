import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sinsjax
from sinsjax import runtime
from sinsjax.runtime import OPTIONS, Option, OptionsWarning, flag_values, merge_options

ALL = {option.name: option.value for option in OPTIONS}
PLAIN = "--xla_cpu_prefer_vector_width=512"
EXTRA = "xla_cpu_small_while_loop_byte_threshold=1000000000,xla_cpu_use_multi_output_fusion=true"


def python(script: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a script in a fresh interpreter, free of this one's settings."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("XLA_", "JAX_", "SINSJAX_"))}
    kept["PYTHONPATH"] = str(Path(sinsjax.__file__).parents[1])
    return subprocess.run(
        [sys.executable, "-W", "always", "-c", script],
        env=kept | environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    )


@pytest.fixture
def unset(monkeypatch, tmp_path):
    """No options yet, no backend, an empty cache folder."""
    for name in ("XLA_FLAGS", runtime.OPT_OUT):
        monkeypatch.setenv(name, "")  # so that what a test sets is undone
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(runtime, "backend_started", lambda: False)
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
            "xla_cpu_small_while_loop_byte_threshold=1000000000"
            " --xla_cpu_prefer_vector_width=256",
        ),
    ],
)
def test_merge_extends_what_the_user_has_set(flags, merged):
    assert merge_options(flags) == merged


NAMES = st.sampled_from([*ALL, "xla_a", "xla_b"])
ITEMS = st.lists(st.tuples(NAMES, st.integers(0, 9)), max_size=4)


@st.composite
def user_flags(draw):
    plain = [f"--{name}={value}" for name, value in draw(ITEMS)]
    for items in draw(st.lists(ITEMS, max_size=2)):
        quote = draw(st.sampled_from(["", '"', "'"]))
        value = ",".join(f"{name}={value}" for name, value in items)
        plain.append(f"--xla_backend_extra_options={quote}{value}{quote}")
    return " ".join(draw(st.permutations(plain)))


@given(user_flags())
def test_merge_keeps_every_value_of_the_user_and_adds_the_rest_once(flags):
    merged = merge_options(flags)
    assert flag_values(merged) == ALL | flag_values(flags)
    assert merge_options(merged) == merged


def test_merge_leaves_out_refused_flags():
    assert merge_options("", frozenset({"xla_backend_extra_options"})) == PLAIN
    assert "vector_width" not in merge_options("", frozenset({"xla_cpu_prefer_vector_width"}))


def test_apply_sets_the_options_without_starting_a_process(unset, no_process):
    unset.setattr(runtime, "_version", lambda package: "0.10.2")
    runtime.apply_options()
    assert os.environ["XLA_FLAGS"] == merge_options("")


def test_apply_respects_the_opt_out(unset):
    unset.setenv(runtime.OPT_OUT, "0")
    runtime.apply_options()
    assert "XLA_FLAGS" not in os.environ


def test_apply_warns_when_jax_has_started(unset):
    unset.setattr(runtime, "backend_started", lambda: True)
    with pytest.warns(OptionsWarning, match="JAX has started already"):
        runtime.apply_options()
    assert "XLA_FLAGS" not in os.environ
    unset.setenv("XLA_FLAGS", merge_options(""))
    runtime.apply_options()


def test_apply_leaves_a_flag_file_alone(unset):
    unset.setenv("XLA_FLAGS", "flags.txt")
    with pytest.warns(OptionsWarning, match="names the file flags.txt"):
        runtime.apply_options()
    assert os.environ["XLA_FLAGS"] == "flags.txt"


def test_an_unknown_jaxlib_is_tried_once_and_remembered(unset):
    unknown = Option("xla_no_such_flag", "1", extra=False)
    unset.setattr(runtime, "OPTIONS", (unknown, *OPTIONS))
    unset.setattr(runtime, "_version", lambda package: "99.0")
    with pytest.warns(OptionsWarning, match="jaxlib 99.0 does not take --xla_no_such_flag"):
        runtime.apply_options()
    assert flag_values(os.environ["XLA_FLAGS"]) == ALL
    unset.setattr(runtime, "_probe", lambda: pytest.fail("tried again"))
    assert runtime.refused_flags("99.0") == {"xla_no_such_flag"}


def test_a_damaged_cache_is_written_anew(unset, tmp_path):
    unset.setattr(runtime, "_probe", frozenset)
    cache = tmp_path / "sinsjax" / "xla_options.json"
    cache.parent.mkdir()
    for damaged in ("{", "[1]", '{"99.0": 3}'):
        cache.write_text(damaged)
        assert runtime.refused_flags("99.0") == frozenset()
        assert json.loads(cache.read_text()) == {
            "99.0": {"xla_backend_extra_options": True, "xla_cpu_prefer_vector_width": True}
        }


def test_a_trial_without_an_answer_refuses_all_and_is_not_remembered(unset, tmp_path):
    unset.setattr(sys, "executable", str(tmp_path / "missing"))
    refused = runtime.refused_flags("99.0")
    assert refused == {"xla_backend_extra_options", "xla_cpu_prefer_vector_width"}
    assert not list(tmp_path.rglob("*.json"))


def test_a_cache_that_cannot_be_written_does_no_harm(unset, tmp_path):
    unset.setattr(runtime, "_probe", frozenset)
    (tmp_path / "sinsjax").write_text("a file where the folder should be")
    assert runtime.refused_flags("99.0") == frozenset()


def test_configure_when_jax_has_started():
    assert len(jax.devices()) == 2
    runtime.configure(devices=2)
    runtime.configure()
    with pytest.raises(RuntimeError, match=r"started with 2 CPU device\(s\).*ask for 3"):
        runtime.configure(devices=3)
    with pytest.raises(ValueError, match="at least 1, not 0"):
        runtime.configure(devices=0)


def test_import_changes_nothing_but_the_options_and_configure_does_the_rest():
    told = python(
        """
import json, os
before = dict(os.environ)
import sinsjax
changed = {k: v for k, v in os.environ.items() if before.get(k) != v}
import jax
precision, count = (jax.config.values[k] for k in ("jax_enable_x64", "jax_num_cpu_devices"))
sinsjax.runtime.configure(devices=3)
print(json.dumps([changed, precision, count, sinsjax.runtime.info()]))
""",
        XLA_FLAGS="--xla_force_host_platform_device_count=4",
    )
    changed, x64, count, info = json.loads(told.stdout)
    assert changed == {"XLA_FLAGS": f"--xla_force_host_platform_device_count=4 {merge_options('')}"}
    assert (x64, count) == (False, -1)
    assert (info["x64"], len(info["devices"])) == (True, 3)
    assert info["options"] == ALL
    assert (info["fused_loop"], info["multi_output_fusion"]) == (True, True)
    assert told.stderr == ""


def test_without_the_options_the_loop_is_not_fused_and_the_default_is_the_users_device_count():
    told = python(
        """
import json, sinsjax
sinsjax.runtime.configure(x64=False)
print(json.dumps(sinsjax.runtime.info()))
""",
        SINSJAX_XLA_OPTIONS="0",
        XLA_FLAGS="--xla_force_host_platform_device_count=4",
    )
    info = json.loads(told.stdout)
    assert info["opted_out"]
    assert set(info["options"].values()) == {None}
    assert not (info["fused_loop"] and info["multi_output_fusion"])
    assert (info["x64"], len(info["devices"])) == (False, 4)


def test_a_late_import_warns_and_says_what_to_do():
    told = python("import jax; jax.devices(); import sinsjax")
    assert "OptionsWarning: sinsjax's XLA options are not in force" in told.stderr
    assert f"set XLA_FLAGS={merge_options('')}" in told.stderr


def test_info_names_what_is_installed():
    info = runtime.info()
    assert info["python"] == ".".join(map(str, sys.version_info[:3]))
    assert info["jax"] == jax.__version__
    assert 1 <= info["cores"] <= os.cpu_count()
    assert info["avx512"] in (info["instructions"] == "AVX512", None)
    assert runtime.versions().items() <= info.items()
    json.dumps(info)


def test_the_instruction_set_in_force_is_what_the_flags_leave(unset, tmp_path):
    unset.setattr(runtime.machine, "instructions", lambda limit: limit)
    assert runtime.instructions() == ""
    unset.setenv("XLA_FLAGS", "--xla_cpu_max_isa=AVX --xla_cpu_max_isa=AVX2")
    assert runtime.instructions() == "AVX2"
    (tmp_path / "flags").write_text("--xla_cpu_max_isa=AVX\n")
    unset.setenv("XLA_FLAGS", str(tmp_path / "flags"))
    assert runtime.instructions() == "AVX"

"""Configuration of a process: devices, precision, options and instruction set."""

import json
import os
from collections.abc import Callable
from typing import Any

import jax
import pytest
from support.commands import run_python
from support.studies import small_study

import sinsjax
from sinsjax.errors import InputError
from sinsjax.platform import machine, runtime
from sinsjax.study.study import Study


def test_configure_after_jax_start_warns_of_other_device_count(
    recwarn: pytest.WarningsRecorder,
) -> None:
    assert len(jax.devices()) == 2
    runtime.configure(devices=2)
    runtime.configure()
    assert not recwarn.list
    line = r"with 2 CPU device\(s\) instead of 3: .*\.configure\(devices=3\) before"
    with pytest.warns(machine.ConfigurationWarning, match=line):
        runtime.configure(devices=3)
    with pytest.raises(InputError, match="^devices: must be at least 1, not 0"):
        runtime.configure(devices=0)


def test_import_changes_nothing_and_loads_nothing_heavy() -> None:
    done = run_python(
        """
import os, sys, warnings
state = lambda: [dict(os.environ), list(warnings.filters), os.sched_getaffinity(0)]
before = state()
import sinsjax
assert state() == before
heavy = {"jax", "jaxlib", "matplotlib", "numpy", "optax", "pyarrow", "pydantic", "scipy"}
assert not heavy & set(sys.modules)
import sinsjax.records, sinsjax.columns, sinsjax.value_types
assert not {"jax", "jaxlib", "optax"} & set(sys.modules)
"""
    )
    assert done.stderr == ""


@pytest.mark.nightly  # modules that the tests import would tell: two devices, no warning
def test_no_module_starts_jax_at_import() -> None:
    """Otherwise the compiler options would be set too late."""
    run_python("""
import importlib, pkgutil, sinsjax
from sinsjax.platform import xla
names = [module.name for module in pkgutil.walk_packages(sinsjax.__path__, "sinsjax.")]
for name in names:
    if not name.endswith("__main__"):
        importlib.import_module(name)
        assert not machine.has_backend_started(), name
assert len(names) > 100
""")


def test_configure_sets_options_devices_and_precision_before_jax_starts() -> None:
    done = run_python(
        """
import json, os
import jax, sinsjax  # JAX is imported, but has not started
sinsjax.configure(devices=3)
print(json.dumps([os.environ["XLA_FLAGS"], sinsjax.info()]))
""",
        XLA_FLAGS="--xla_cpu_prefer_vector_width=256",
    )
    flags, info = json.loads(done.stdout)
    options = machine.required_xla_options() | {"xla_cpu_prefer_vector_width": "256"}
    assert machine.parse_xla_flags(flags) == options and info["xla_flags"] == flags
    assert (info["x64"], len(info["devices"])) == (True, 3)
    assert done.stderr == ""


@pytest.mark.nightly
def test_run_after_jax_start_warns_once_and_computes_in_double_precision() -> None:
    """A notebook that has used JAX already; the user's own options do not silence the warning."""
    done = run_python(
        """
import jax.numpy as jnp
assert jnp.ones(3).dtype == "float32"
import sinsjax
for _ in range(2):
    sinsjax.simulated_record("paper1_resets")
assert jnp.ones(3).dtype == "float64"
""",
        XLA_FLAGS="--xla_cpu_max_isa=AVX2",
        JAX_NUM_CPU_DEVICES=str(runtime.usable_cores()),
    )
    assert done.stderr.count("Warning") == 1
    line = "ConfigurationWarning: JAX has started already, without sinsjax's compiler options (runs"
    assert line in done.stderr


@pytest.mark.parametrize(
    "call", [sinsjax.run, sinsjax.one_run, sinsjax.simulated_record, sinsjax.information_bound]
)
def test_public_function_configures_before_it_computes(
    call: Callable[[Study], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Configured(Exception):
        pass

    def configure() -> None:
        raise Configured

    assert jax.devices()  # JAX has started already
    monkeypatch.setattr(runtime, "_configured", False)
    monkeypatch.setattr(runtime, "configure", configure)
    with pytest.raises(Configured):
        call(small_study())


def test_double_precision_that_was_turned_off_is_turned_on_again() -> None:
    jax.config.update("jax_enable_x64", False)
    sinsjax.one_run(small_study())
    assert jax.config.jax_enable_x64


def test_usable_cores_are_those_of_the_affinity(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {1, 4, 5}, raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    assert runtime.usable_cores() == 3


X86 = "fpu sse4_2 avx f16c"


@pytest.mark.parametrize(
    ("cpu", "limit", "expected"),
    [
        ({"flags": X86}, "", "AVX"),
        ({"flags": f"{X86} avx2 avx512f"}, "avx2", "AVX2"),
        ({"flags": X86}, "AVX2", "AVX"),
        ({"Features": "fp asimd sve2 sve"}, "", "SVE"),
        ({"Features": "fp asimd"}, "", "NEON"),
        ({}, "AVX2", "x86_64 to AVX2"),
    ],
)
def test_instruction_set_follows_cpu_flags_and_xla_limit(
    monkeypatch: pytest.MonkeyPatch, cpu: dict[str, str], limit: str, expected: str
) -> None:
    monkeypatch.setattr(machine, "cpu_info", lambda: cpu)
    monkeypatch.setattr(machine.platform, "machine", lambda: "x86_64")
    assert machine.instruction_set(limit) == expected

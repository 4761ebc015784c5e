"""Configuration of a process: devices, precision, options and instruction set."""

import json
import os

import jax
import pytest
from support.commands import run_python
from support.studies import small_study

import sinsjax
from sinsjax.errors import InputError
from sinsjax.platform import machine, runtime


def test_configure_after_jax_start_warns_of_other_device_count(recwarn):
    assert len(jax.devices()) == 2
    runtime.configure(devices=2)
    assert not recwarn.list
    line = r"with 2 CPU device\(s\) instead of 3: .*\.configure\(devices=3\) before"
    with pytest.warns(machine.ConfigurationWarning, match=line):
        runtime.configure(devices=3)
    with pytest.raises(InputError, match="^devices: must be at least 1, not 0"):
        runtime.configure(devices=0)


def test_import_changes_nothing_and_configure_sets_options_before_jax_starts():
    done = run_python(
        """
import json, os, sys, warnings
state = lambda: [dict(os.environ), list(warnings.filters), os.sched_getaffinity(0)]
before = state()
import sinsjax
assert state() == before
heavy = {"jax", "jaxlib", "matplotlib", "numpy", "optax", "pyarrow", "pydantic", "scipy"}
assert not heavy & set(sys.modules)
import sinsjax.records, sinsjax.columns, sinsjax.value_types
assert not {"jax", "jaxlib", "optax"} & set(sys.modules)
import jax
sinsjax.configure(devices=3)
print(json.dumps([os.environ["XLA_FLAGS"], sinsjax.info()]))
""",
        XLA_FLAGS="--xla_cpu_prefer_vector_width=256",
    )
    flags, info = json.loads(done.stdout)
    options = machine.required_xla_options() | {"xla_cpu_prefer_vector_width": "256"}
    assert machine.parse_xla_flags(flags) == options and info["xla_flags"] == flags
    assert (info["x64"], len(info["devices"]), done.stderr) == (True, 3, "")


@pytest.mark.nightly
def test_run_after_jax_start_warns_once_and_computes_in_double_precision():
    """A notebook that has used JAX already; the user's own options do not silence the warning."""
    script = """
import jax.numpy as jnp
assert jnp.ones(3).dtype == "float32"
import sinsjax
for _ in range(2):
    sinsjax.simulated_record("paper1_resets")
assert jnp.ones(3).dtype == "float64"
"""
    devices = {"JAX_NUM_CPU_DEVICES": str(runtime.usable_cores())}
    errors = run_python(script, XLA_FLAGS="--xla_cpu_max_isa=AVX2", **devices).stderr
    assert errors.count("Warning") == 1
    assert "Warning: JAX has started already, without sinsjax's compiler options" in errors


@pytest.mark.parametrize(
    "call", [sinsjax.run, sinsjax.one_run, sinsjax.simulated_record, sinsjax.information_bound]
)
def test_public_function_configures_before_it_computes(call, monkeypatch):
    def configure():
        raise ZeroDivisionError

    assert jax.devices()  # JAX has started already
    monkeypatch.setattr(runtime, "_configured", False)
    monkeypatch.setattr(runtime, "configure", configure)
    with pytest.raises(ZeroDivisionError):
        call(small_study())


def test_usable_cores_are_those_of_the_affinity(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {1, 4, 5}, raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    assert runtime.usable_cores() == 3


@pytest.mark.parametrize(
    ("cpu", "limit", "expected"),
    [
        ({"flags": "fpu sse4_2 avx f16c"}, "AVX2", "AVX"),
        ({"flags": "fpu sse4_2 avx f16c avx2 avx512f"}, "avx2", "AVX2"),
        ({"Features": "fp asimd sve2 sve"}, "", "SVE"),
        ({}, "AVX2", "x86_64 to AVX2"),
    ],
)
def test_instruction_set_follows_cpu_flags_and_xla_limit(monkeypatch, cpu, limit, expected):
    monkeypatch.setattr(machine, "cpu_info", lambda: cpu)
    monkeypatch.setattr(machine.platform, "machine", lambda: "x86_64")
    assert machine.instruction_set(limit) == expected

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

import sinsjax
from sinsjax.platform import runtime, xla
from sinsjax.platform.xla import merge_options

MERGED = merge_options("")


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


def test_configure_after_jax_start_refuses_other_device_count():
    assert len(jax.devices()) == 2
    runtime.configure(devices=2)
    runtime.configure()
    with pytest.raises(RuntimeError, match=r"started with 2 CPU device\(s\), not 3"):
        runtime.configure(devices=3)
    with pytest.raises(ValueError, match="at least 1, not 0"):
        runtime.configure(devices=0)


def test_import_sets_only_xla_flags_and_configure_sets_precision():
    told = python(
        """
import json, os
before = dict(os.environ)
import sinsjax
changed = {k: v for k, v in os.environ.items() if before.get(k) != v}
import jax
precision, count = (jax.config.values[k] for k in ("jax_enable_x64", "jax_num_cpu_devices"))
sinsjax.platform.runtime.configure(devices=3)
print(json.dumps([changed, precision, count, sinsjax.platform.runtime.info()]))
""",
        XLA_FLAGS="--xla_force_host_platform_device_count=4",
    )
    changed, x64, count, info = json.loads(told.stdout)
    assert changed == {"XLA_FLAGS": f"--xla_force_host_platform_device_count=4 {merge_options('')}"}
    assert (x64, count) == (False, -1)
    assert (info["x64"], len(info["devices"])) == (True, 3)
    assert info["options"] == {option.name: option.value for option in xla.wanted()}
    assert info["forgone"] is None
    assert info["vectorised"] in (1.0, None)
    assert (info["fused_loop"], info["multi_output_fusion"]) == (True, True)
    assert told.stderr == ""


def test_opt_out_disables_loop_fusion_and_keeps_user_device_count():
    told = python(
        """
import json, sinsjax
sinsjax.platform.runtime.configure(x64=False)
print(json.dumps(sinsjax.platform.runtime.info()))
""",
        SINSJAX_XLA_OPTIONS="0",
        XLA_FLAGS="--xla_force_host_platform_device_count=4",
    )
    info = json.loads(told.stdout)
    assert info["opted_out"]
    assert set(info["options"].values()) == {None}
    assert not (info["fused_loop"] and info["multi_output_fusion"])
    assert (info["x64"], len(info["devices"])) == (False, 4)


def test_import_after_jax_start_warns_with_remedy():
    told = python("import jax; jax.devices(); import sinsjax")
    assert "OptionsWarning: sinsjax's XLA options are not in force" in told.stderr
    assert f"set XLA_FLAGS={merge_options('')}" in told.stderr


def test_info_reports_versions_and_hardware():
    info = runtime.info()
    assert info["python"] == ".".join(map(str, sys.version_info[:3]))
    assert info["jax"] == jax.__version__
    assert 1 <= info["cores"] <= os.cpu_count()
    assert info["avx512"] in (info["instructions"] == "AVX512", None)
    assert runtime.versions().items() <= info.items()
    json.dumps(info)


def test_package_import_loads_no_heavy_modules() -> None:
    """Not even JAX, whose options it sets; each name is imported when it is first used."""
    code = "import sys, sinsjax; print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    heavy = {"jax", "jaxlib", "matplotlib", "numpy", "optax", "pyarrow", "pydantic", "scipy"}
    assert "sinsjax" in done.stdout.split() and not heavy & set(done.stdout.split())


def test_usable_cores_are_those_of_the_affinity(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {1, 4, 5}, raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    assert runtime.usable_cores() == 3

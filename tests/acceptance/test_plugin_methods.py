"""A plug-in method: a package with a method, found by its entry point."""

import importlib
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

import sinsjax
from sinsjax.methods.method import Options
from sinsjax.methods.registry import check_plugin

EXAMPLE = Path(__file__).parents[1] / "example_method"
DOCS = EXAMPLE.parents[1] / "docs"
PAGE = (DOCS / "own_method.md").read_text("utf-8")
STUDY = re.findall(r"^```toml\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)[-1]
METHOD = "averaged_alignment/method.py"
WHOSE = "method 'averaged' of averaged-alignment 1.0: "


def test_example_plugin_keeps_its_promises(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLE)
    method = importlib.import_module("averaged_alignment.method").AVERAGED.build(Options(0.01))
    check_plugin("it", method, np.array([0.5]), 1, None)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder in which the example package is installed."""
    build = pytest.importorskip("hatchling.build")
    folder = tmp_path_factory.mktemp("site")
    source = shutil.copytree(EXAMPLE, tmp_path_factory.mktemp("source") / "example")
    here = os.getcwd()
    try:
        os.chdir(source)
        wheel = build.build_wheel(str(folder))
    finally:
        os.chdir(here)
    with zipfile.ZipFile(folder / wheel) as archive:
        archive.extractall(folder)
    return folder


def run_commands(site: Path, cwd: Path, *commands: str) -> list[subprocess.CompletedProcess]:
    """Run command lines in processes that find the package."""
    paths = f"{site}{os.pathsep}{EXAMPLE.parents[1]}"
    return [
        subprocess.run(
            [sys.executable, "-m", "sinsjax", *command.split()],
            env=os.environ | {"PYTHONPATH": paths},
            cwd=cwd,
            capture_output=True,
            text=True,
        )
        for command in commands
    ]


@pytest.mark.nightly
@pytest.mark.optimised(False)
def test_plugin_method_is_explained_and_swept_beside_built_in_methods(
    site: Path, tmp_path: Path
) -> None:
    (tmp_path / "averages.toml").write_text(STUDY)
    commands = "keys averaged", "info", "sweep averages.toml -o out"
    keys, info, sweep = run_commands(site, tmp_path, *commands)
    assert (keys.returncode, keys.stderr) == (0, "")
    assert "averaging_time_s" in keys.stdout and "time constant of the averages" in keys.stdout
    assert "package: averaged-alignment 1.0" in keys.stdout
    assert "plug-in methods  averaged (averaged-alignment 1.0)" in info.stdout
    assert sweep.returncode == 0, sweep.stderr
    assert sinsjax.read_manifest(tmp_path / "out")["versions"]["averaged-alignment"] == "1.0"
    runs = sinsjax.read_summary(tmp_path / "out").to_pylist()
    errors = {row["method"]: row["phi_u_arcmin"] - row["floor_arcmin"] for row in runs}
    assert set(errors) == {"averaged", "inertial"} and max(map(abs, errors.values())) < 0.5


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        (
            ", force, turn)",
            ", force, n)",
            "step, normalise or close returns _State(",
        ),
        ("return 1 - 1", "return 0.5 #", "params must return one value per variant"),
    ],
)
def test_wrong_plugin_method_is_reported_in_one_line_and_affects_only_its_studies(
    site: Path, tmp_path: Path, old: str, new: str, line: str
) -> None:
    (tmp_path / "averages.toml").write_text(STUDY)
    changed = Path(shutil.copytree(site, tmp_path / "site"))
    text = (changed / METHOD).read_text()
    assert old in text
    (changed / METHOD).write_text(text.replace(old, new))
    commands = "validate averages.toml", "sweep averages.toml -o out", "validate reset_sweep"
    *wrong, other = run_commands(changed, tmp_path, *commands)
    assert (other.returncode, other.stderr) == (0, "")
    for ended in wrong:
        assert ended.returncode == 2 and ended.stderr.count("\n") == 1
        assert ended.stderr.startswith(f"error: {WHOSE}{line}")
    assert not (tmp_path / "out").exists()

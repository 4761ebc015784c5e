"""A plug-in method: a package with a method, found by its entry point."""

import contextlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import sinsjax

EXAMPLE = Path(__file__).parents[1] / "example_method"
PAGE = (EXAMPLE.parents[1] / "docs" / "own_method.md").read_text("utf-8")
STUDY = re.findall(r"^```toml\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)[-1]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Folder in which the example package is installed."""
    build = pytest.importorskip("hatchling.build")
    folder = tmp_path_factory.mktemp("site")
    source = shutil.copytree(EXAMPLE, tmp_path_factory.mktemp("source") / "example")
    with contextlib.chdir(source):
        wheel = build.build_wheel(str(folder))
    shutil.unpack_archive(folder / wheel, folder, "zip")
    return folder


def sinsjax_with(site, cwd, command):
    """Run a command line in a process that finds the package; exit code, output, errors."""
    (cwd / "averages.toml").write_text(STUDY)
    paths = f"{site}{os.pathsep}{EXAMPLE.parents[1]}"
    words = [sys.executable, "-m", "sinsjax", *command.split()]
    environment = os.environ | {"PYTHONPATH": paths}
    done = subprocess.run(words, env=environment, cwd=cwd, capture_output=True, text=True)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.nightly
@pytest.mark.optimised(False)
def test_plugin_method_is_explained_and_swept_beside_built_in_methods(site, tmp_path):
    code, told, error = sinsjax_with(site, tmp_path, "keys averaged")
    assert (code, error) == (0, "") and "package: averaged-alignment 1.0" in told
    assert "averaging_time_s" in told and "time constant of the averages" in told
    assert "averaged (averaged-alignment 1.0)" in sinsjax_with(site, tmp_path, "info")[1]
    code, _, error = sinsjax_with(site, tmp_path, "sweep averages.toml -o out")
    assert code == 0, error
    assert sinsjax.read_manifest(tmp_path / "out")["versions"]["averaged-alignment"] == "1.0"
    runs = sinsjax.read_summary(tmp_path / "out").to_pylist()
    errors = {row["method"]: row["phi_u_arcmin"] - row["floor_arcmin"] for row in runs}
    assert set(errors) == {"averaged", "inertial"} and max(map(abs, errors.values())) < 0.5


@pytest.mark.nightly
def test_wrong_plugin_method_is_reported_in_one_line_and_affects_only_its_studies(site, tmp_path):
    changed = Path(shutil.copytree(site, tmp_path / "site"))
    method = changed / "averaged_alignment" / "method.py"
    text = method.read_text()
    method.write_text(text.replace(", force, turn)", ", force, n)"))
    assert method.read_text() != text
    code, _, error = sinsjax_with(changed, tmp_path, "validate reset_sweep")
    assert (code, error) == (0, "")
    for command in ("validate averages.toml", "sweep averages.toml -o out"):
        code, _, error = sinsjax_with(changed, tmp_path, command)
        assert (code, error.count("\n")) == (2, 1)
        whose = "error: method 'averaged' of averaged-alignment 1.0: "
        assert error.startswith(f"{whose}step, normalise or close returns _State(")
    assert not (tmp_path / "out").exists()

"""The recipe for a new method in CONTRIBUTING, followed to the letter in a copy of the package."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import sinsjax

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
RECIPE = TEXT.partition("\n## Adding a method\n")[2].partition("\n## ")[0]
STEPS = [
    re.match(r"`(.+?)`.*?\n```python\n(.*?)^```$", step, re.S | re.M)
    for step in re.split(r"^\*\*\d+\.\*\* ", RECIPE, flags=re.M)
]
FILES = dict(found.groups() for found in STEPS if found)
CONFIG, METHOD = (f"sinsjax/methods/averaged/{name}.py" for name in ("config", "method"))
REGISTRY, TEST = "sinsjax/methods/registry.py", "tests/methods/test_averaged.py"


def test_toy_method_is_small_and_the_same_as_the_example_package() -> None:
    assert list(FILES) == [CONFIG, METHOD, REGISTRY, TEST]
    assert sum(FILES[name].count("\n") for name in (CONFIG, METHOD)) <= 80
    example = ROOT / "tests" / "example_method"
    for name in (CONFIG, METHOD):
        shown = FILES[name].replace("sinsjax.methods.averaged", "averaged_alignment")
        assert shown == (example / "averaged_alignment" / Path(name).name).read_text("utf-8")
    lines = [
        path.read_text("utf-8").count("\n")
        for path in example.rglob("*.*")
        if path.suffix != ".pyc"
    ]
    assert sum(lines) <= 80


@pytest.mark.slow
def test_toy_method_of_recipe_works_and_passes_its_own_test(tmp_path: Path) -> None:
    source = Path(sinsjax.__file__).parent
    shutil.copytree(source, tmp_path / "sinsjax", ignore=shutil.ignore_patterns("__pycache__"))
    for name in (CONFIG, METHOD, TEST):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(FILES[name])
    (tmp_path / CONFIG).with_name("__init__.py").write_text('"""Running averages."""\n')
    imported, listed = FILES[REGISTRY].splitlines()
    registry = (tmp_path / REGISTRY).read_text()
    registry = registry.replace("\nfrom sinsjax", f"\n{imported}\nfrom sinsjax", 1)
    (tmp_path / REGISTRY).write_text(
        registry.replace("        COMPASS,", f"        COMPASS,\n{listed}")
    )
    paths = os.pathsep.join([str(tmp_path), str(ROOT / "tests")])
    for command in (["pytest", "-q", "-c", os.devnull, TEST], ["sinsjax", "keys", "averaged"]):
        ended = subprocess.run(
            [sys.executable, "-m", *command],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": paths, "JAX_ENABLE_X64": "1"},
            capture_output=True,
            text=True,
        )
        assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "averaging_time_s" in ended.stdout

"""Checks what was built: what the wheel and the sdist hold and leave out, and the description.

The folder that holds them is the one argument.
"""

import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
BESIDE = {".py", ".j2", ".typed"}
"""Suffixes of what the package's folders hold."""

NEEDED = (
    "pyproject.toml README.md LICENSE CHANGELOG.md CONTRIBUTING.md CITATION.cff mkdocs.yml .ci/run"
    " benchmarks/limit_kernel.c benchmarks/gate.py docs/start.md docs/studies/paper1.py"
    " docs/figures/concept_why_p_lies.png notebooks/tuning.ipynb tests/conftest.py"
).split()
"""Of the sdist, beside the package and the studies: what it takes to test and to document it."""


def package_files() -> set[str]:
    """The package's modules, templates and marker, as paths below the root."""
    paths = (ROOT / "sinsjax").rglob("*")
    return {str(path.relative_to(ROOT)) for path in paths if path.suffix in BESIDE}


def studies() -> set[str]:
    """The shipped studies, as paths below the root."""
    return {str(path.relative_to(ROOT)) for path in (ROOT / "configs").rglob("*") if path.is_file()}


def wrong_with_wheel(path: Path) -> list[str]:
    """What is missing from it, and what does not belong there."""
    names = set(zipfile.ZipFile(path).namelist())
    assets = {f"sinsjax/assets/{name}" for name in studies()}
    expected = package_files() | assets
    data = {name for name in names if ".dist-info/" in name}
    wrong = [f"{path.name}: lacks {name}" for name in sorted(expected - names)]
    wrong += [f"{path.name}: should not have {name}" for name in sorted(names - expected - data)]
    if not any(name.endswith("licenses/LICENSE") for name in data):
        wrong.append(f"{path.name}: lacks its licence")
    return wrong


def wrong_with_sdist(path: Path) -> list[str]:
    """What is missing from it."""
    with tarfile.open(path) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    expected = package_files() | studies() | set(NEEDED)
    return [f"{path.name}: lacks {name}" for name in sorted(expected - names)]


def main(folder: Path) -> int:
    """Print what is wrong; 1 if something is."""
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    wrong = wrong_with_wheel(wheel) + wrong_with_sdist(sdist)
    print("\n".join(wrong) or f"{wheel.name} and {sdist.name} hold what they should")
    described = subprocess.run([sys.executable, "-m", "twine", "check", "--strict", wheel, sdist])
    return int(bool(wrong or described.returncode))


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))

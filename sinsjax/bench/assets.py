"""Repository files used by the benchmarks."""

from importlib.resources import files
from pathlib import Path


def asset(name: str) -> Path:
    """Path of a file, in a source tree or as installed."""
    installed = Path(str(files("sinsjax"))) / "assets" / name
    return installed if installed.exists() else Path(__file__).parents[2] / name

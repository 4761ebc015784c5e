"""Files of the repository that go with the package: the studies in configs/, a benchmark's kernel.

A wheel has them under ``sinsjax/assets``; a source tree, where an editable install finds them, at
its top.
"""

from importlib.resources import files
from pathlib import Path


def asset_path(name: str) -> Path:
    """Path of a file or folder, in a source tree or as installed.

    Args:
        name: path from the top of the repository, such as ``configs/reset_sweep.toml``.
    """
    installed = Path(str(files("sinsjax"))) / "assets" / name
    return installed if installed.exists() else Path(__file__).parents[2] / name

"""Files of the repository that the package needs: the studies of configs/.

A wheel has them in ``sinsjax/assets``; a source tree (also of an editable install) has them at
its top.
"""

from importlib.resources import files
from pathlib import Path


def asset_path(name: str) -> Path:
    """Return the path of a file or folder, in a source tree or as installed.

    Args:
        name: path from the top of the repository, such as ``configs/reset_sweep.toml``.
    """
    installed = Path(str(files("sinsjax"))) / "assets" / name
    return installed if installed.exists() else Path(__file__).parents[2] / name

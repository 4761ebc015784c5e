"""The study that a results directory keeps."""

from pathlib import Path

from sinsjax.errors import InputError
from sinsjax.execution.parts import read_manifest
from sinsjax.platform import runtime
from sinsjax.study.load import load_study
from sinsjax.study.study import Study


def kept_study(directory: Path) -> Study:
    """The study of a results directory.

    Raises:
        InputError: it cannot be read; names packages that brought methods when it was computed and
            are not installed here.
    """
    try:
        return load_study(directory / "study.toml")
    except InputError as error:
        gone = " and ".join(f"{name} {version}" for name, version in _absent(directory))
        if not gone:
            raise
        raise InputError(
            f"{directory}: was computed with {gone}, not installed here, which may be why: {error}"
        ) from error


def _absent(directory: Path) -> list[tuple[str, str]]:
    """Packages in the manifest that are not installed, and their versions."""
    versions = read_manifest(directory).get("versions")
    told = versions if isinstance(versions, dict) else {}
    others = (name for name in told if name not in ("python", *runtime.DECISIVE))
    return [(name, told[name]) for name in others if runtime.version_or_none(str(name)) is None]

"""The faults: one changed line each, read from the TOML files in this folder."""

import tomllib
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Fault:
    """One line of the package changed for the worse.

    Attributes:
        name: Says what is broken.
        file: The file to change, relative to the repository.
        old: Text that occurs once in the file.
        new: What replaces it.
        breaks: The consequence for a user, in a sentence.
        tests: Test files that are likely to notice it; they run first.
    """

    name: str
    file: str
    old: str
    new: str
    breaks: str
    tests: tuple[str, ...]

    @property
    def folder(self) -> str:
        """The folder of the package, or the module if it stands at the top level."""
        return Path(self.file).parts[1]

    @property
    def folder_tests(self) -> tuple[str, ...]:
        """The folders of tests that mirror the folder of the package, and those of `tests`."""
        own = HERE.parent / self.folder  # there is none of the command line
        mirrored = {f"tests/{self.folder}"} if own.is_dir() else set()
        return tuple(sorted(mirrored | {str(Path(test).parent) for test in self.tests}))

    def patched(self, source: str) -> str:
        """Return a file's text with the fault in it.

        Raises:
            ValueError: the text to replace does not occur exactly once.
        """
        if (count := source.count(self.old)) != 1:
            raise ValueError(f"{self.name}: {self.file} has {count} times: {self.old}")
        return source.replace(self.old, self.new)


def load() -> list[Fault]:
    """Return all faults, by file and in the order in which they are listed."""
    found = []
    for path in sorted(HERE.glob("*.toml")):
        for table in tomllib.loads(path.read_text())["fault"]:
            found.append(Fault(**(table | {"tests": tuple(table["tests"])})))
    return found

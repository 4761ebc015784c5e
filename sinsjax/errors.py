"""Exceptions that end a study early: a user's mistake, or an interruption."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sinsjax.messages import to_one_line


class InputError(ValueError):
    r"""A user's mistakes, one visible line each: the file, the key or row, and what is wrong.

    A study is checked in full before anything runs, in stages: names, values, rules between keys.
    The error of one has a line for each mistake that the first stage with any finds.

    Attributes:
        lines: the mistakes; most errors have one.

    Examples:
        >>> try:
        ...     sinsjax.load_study("reset_sweep", {"study.draws": 0, "earth.latitude_deg": 95.0})
        ... except sinsjax.InputError as error:
        ...     print(*error.lines, sep="\n")
        reset_sweep: [study] draws: must be greater than or equal to 1, not 0
        reset_sweep: [earth] latitude_deg: must be less than 90, not 95.0
    """

    def __init__(self, *messages: str) -> None:
        """Keep each message as one line, whatever text from a file is in it."""
        self.lines = tuple(map(to_one_line, messages))
        super().__init__("\n".join(self.lines))

    def __reduce__(self) -> tuple[Any, ...]:
        """Keep the lines apart in other processes."""
        return type(self), self.lines

    def with_source(self, source: str) -> "InputError":
        """Return the same error with a source before each line."""
        return InputError(*(f"{source}: {line}" for line in self.lines))


class ErrorCollector:
    """Collector of input errors, so that all of them are reported at once.

    Attributes:
        lines: lines of the errors so far, without repetition.
    """

    def __init__(self) -> None:
        """Begin without errors."""
        self.lines: dict[str, None] = {}

    @contextmanager
    def collect(self) -> Iterator[None]:
        """Keep an input error that a block raises, and continue after the block."""
        try:
            yield
        except InputError as error:
            self.lines |= dict.fromkeys(error.lines)

    def add(self, line: str) -> None:
        """Keep a line, as if `InputError` had been raised with it."""
        self.lines |= dict.fromkeys(InputError(line).lines)

    def raise_all(self) -> None:
        """Raise the errors so far as one, if there are any."""
        if self.lines:
            raise InputError(*self.lines)


class StudyWarning(UserWarning):
    """A doubt about a study or its record, which the command line prints and Python warns of.

    Examples:
        >>> import warnings
        >>> changes = {"alignment.method": "compass", "study.draws": 1, "axes": {}}
        >>> with warnings.catch_warnings(record=True) as doubts:
        ...     warnings.simplefilter("always", sinsjax.StudyWarning)
        ...     results = sinsjax.run(sinsjax.load_study("reset_sweep", changes))
        >>> str(doubts[0].message).endswith("have no effect with method compass.")
        True
    """


class StudyInterrupted(Exception):
    """A study was interrupted; the results so far are kept."""

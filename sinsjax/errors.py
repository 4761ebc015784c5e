"""Exceptions that end a study early: a user's mistake, or an interruption."""

from sinsjax.messages import one_line


class InputError(ValueError):
    """A user's mistake, in one visible line: the file, the key or row, and what is wrong."""

    def __init__(self, message: str) -> None:
        """Keep the message as one line, whatever text from a file is in it."""
        super().__init__(one_line(message))


class StudyWarning(UserWarning):
    """A doubt about a study or its record, which the command line prints and Python warns of."""


class StudyInterrupted(Exception):
    """A study was interrupted; the results so far are kept."""

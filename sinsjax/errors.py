"""Exceptions that end a study early: a user's mistake, or an interruption."""


class InputError(ValueError):
    """A user's mistake, in one line: the file, the key or row, and what is wrong."""


class StudyInterrupted(Exception):
    """A study was interrupted; the results so far are kept."""

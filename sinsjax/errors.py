"""What ends a study before its time: a user's mistake, or a user."""


class InputError(ValueError):
    """A user's mistake: one line that names the file and the key or row, and what is wrong."""


class StudyInterrupted(Exception):
    """A study was asked to stop before its end; what was done is kept."""

"""The words of every report, a line each."""

from rich.console import Console

from sinsjax import console as screen
from sinsjax.report.base import Chapter, Text
from sinsjax.report.names import NO_NAMES

WORDS = {
    "limit": "the heading error that a run's own constant sensor biases leave once its filter has"
    " converged, about -eps_E / (Omega cos L) + (nabla_E / g) tan L; a base at rest cannot tell"
    " it from a heading error",
    "truth": "true north, or the reference of a record; what a vehicle needs. A run that has not"
    " converged can pass it on its way to its limit",
    "settled": "the heading error stays within a band, about the limit (`settle_X_s`) or about the"
    " truth (`settle_X_truth_s`), up to the end of the run; the time is that of the last record"
    " outside",
    "ok": "the heading ends within the success band, about the truth or the limit as the study's"
    " `judged_from` says, has been there for `dwell_s`, and the level ends within its own band",
    "NEES": "phi' P^-1 phi at the end, phi from the truth; 3 on average where the filter's belief"
    " is true, larger where it believes too much or a bias it does not know is at work",
}
"""What is said under every report."""


def section() -> Chapter:
    """The words as the last section of a page."""
    lines = "\n".join(f"- *{word}*: {meaning}." for word, meaning in WORDS.items())
    return Chapter("What the words mean", [Text(lines)])


def print_words(console: Console) -> None:
    """Prints the words below the tables."""
    console.print()
    for word, meaning in WORDS.items():
        screen.say(console, NO_NAMES.plain(f"{word}: {meaning}."), wrap=True)

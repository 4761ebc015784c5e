"""Texts for people: parts of messages, errors of keys and values in a user's terms, and printing.

What is printed is plain text, without rich's markup.
"""

import difflib
import re
import sys
from collections.abc import Iterable, Mapping

from pydantic_core import ErrorDetails
from rich.console import Console
from rich.text import Text

_IN_PLAIN_WORDS = {
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "bool_type": "must be true or false",
    "string_type": "must be text",
    "tuple_type": "must be a list",
    "model_type": "must be a table",
    "finite_number": "must be finite",
    "string_too_short": "must not be empty",
    "too_short": "must not be empty",
}

CONTROL = re.compile(
    r"[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)
"""A control code, a line break, a change of writing direction, or half of a surrogate pair.

Python decodes a byte of a file name that is not UTF-8 to half of a surrogate pair.
"""


def escape_controls(text: str) -> str:
    r"""Return the text with `CONTROL` characters as escapes such as ``\x1b`` and ``\u202e``.

    All output to a terminal, a page or a figure is escaped by this function, since it may contain
    text from a file.
    """
    return CONTROL.sub(lambda found: repr(found[0])[1:-1], text)


def shorten(text: str, max_length: int = 200) -> str:
    """The text, truncated to ``max_length`` characters."""
    return text if len(text) <= max_length else f"{text[: max_length - 3]}..."


def format_facts(title: str, facts: Mapping[str, str]) -> str:
    """Return a title and facts, short texts by name: the display of an object, a line each."""
    width = max(map(len, facts))
    lines = (title, *(f"  {name:<{width}}  {fact}" for name, fact in facts.items()))
    return "\n".join(shorten(escape_controls(line), 80) for line in lines)


def format_count(number: int, noun: str) -> str:
    """A number of things: ``1 draw``, ``2,000 draws``."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def format_seconds(time_s: float) -> str:
    """A time to a hundredth of a second, however large: that of a clock may count from 1970."""
    text = f"{time_s:.2f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def to_one_line(text: str, max_length: int = 1000) -> str:
    """A message in one visible line: control characters escaped, a long middle left out."""
    line = escape_controls(" ".join(text.splitlines()))
    return line if len(line) <= max_length else f"{line[: max_length - 300]} ... {line[-295:]}"


def first_error_line(error: BaseException) -> str:
    """The first line of another library's message, which may be long and quote its input."""
    return to_one_line(str(error).strip().partition("\n")[0], 400)


def suggest_closest(word: str, known_words: Iterable[str], template: str = "{}") -> str:
    """A hint at the known word closest to an unknown one; empty if none is close."""
    found = difflib.get_close_matches(str(word), list(known_words), n=1)
    return f" (did you mean {template.format(found[0])}?)" if found else ""


def describe_broken_rule(error: ErrorDetails) -> str:
    """The rule that a value breaks."""
    kind = error["type"]
    if kind == "invalid":
        return error["msg"]
    if kind == "missing":
        return "required"
    if kind == "too_long":
        return f"must have {error['ctx']['max_length']} values, not {error['ctx']['actual_length']}"
    return _IN_PLAIN_WORDS.get(kind, error["msg"].replace("Input should be", "must be"))


def explain_error(error: ErrorDetails, key: str = "") -> str:
    """The rule that a value of ``section.key`` breaks, and the value unless the rule shows it."""
    given = error["input"]
    if isinstance(given, str) and (key, given) in GONE_VALUES:
        return f"{given!r} {GONE_LINE.format(GONE_VALUES[key, given])}"
    if error["type"] in ("invalid", "missing", "too_long"):
        return describe_broken_rule(error)
    value = repr(list(given) if isinstance(given, tuple) else given)
    words = error["ctx"]["expected"].split("'")[1::2] if error["type"] == "literal_error" else ()
    # A unit is often written as deg/s.
    hint = suggest_closest(given.replace("/", "_per_"), words) if isinstance(given, str) else ""
    return f"{describe_broken_rule(error)}, not {shorten(value, 60)}{hint}"


GONE_MARK = "was removed after 1.0"
GONE_LINE = GONE_MARK + " ({})"

GONE_KEYS: dict[str, str] = {
    "advise.known_heading_deg": "drop it: no number depended on it",
    "study.check_linearity": "drop it, with estimate = 'covariance'",
    "study.estimate_samples": "drop it, with estimate = 'covariance'",
    **dict.fromkeys(
        ("compass.level_adjustment_s", "compass.azimuth_adjustment_s"),
        "give the loop's sigma_per_s; `sinsjax gains` shows its period and settling time",
    ),
    **dict.fromkeys(
        ("compass.adjustment_reading", "compass.adjustment_remainder"),
        "drop it; `sinsjax gains` shows period and settling time of a sigma",
    ),
    "compass.allow_unstable": "drop it: runs of unstable loops have the status 'diverged'",
    "compass.level_passes": "use level_time_s",
    "compass.sigma_passes": "use sigma_times_s",
    "passes.direction": "drop it: every second pass is backward",
    "filter.turning": "drop it; on turned bases use method = 'gravity_fit'",
    "filter.turning_rate_deg_per_s": "drop it; on turned bases use method = 'gravity_fit'",
}
"""Keys of version 1.0 that are gone, by ``section.key``, with what to use instead."""

_TRIGGERS = ("nis", "whiteness", "tilt_drift", "levelled", "strong_tracking", "fading")
_TRIGGER = "use 'linearisation', or the textbook's test 'innovation'"

GONE_VALUES: dict[tuple[str, str], str] = {
    ("study.estimate", "covariance"): "drop it to run draws; a lower bound of the heading error"
    " is `sinsjax.information_bound`",
    **dict.fromkeys((("resets.reset_trigger", name) for name in _TRIGGERS), _TRIGGER),
    ("coarse.coarse_method", "analytic"): "use 'inertial', which needs no rigid mount",
    **dict.fromkeys(
        (("passes.turn", name) for name in ("velocity_drop_rate", "restart")), "use 'reflect'"
    ),
    ("tune.searches", "random"): "use 'sobol'",
    ("tune.searches", "covariance"): "use 'gradient' or 'sobol'",
}
"""Values of keys likewise, by ``section.key`` and value."""


def plain_console() -> Console:
    """A console on the standard output that prints ``[bold]`` and ``:smile:`` literally."""
    return Console(markup=False, emoji=False, highlight=False)


def literal_text(text: str, style: str = "") -> Text:
    """Return text for rich that shows every character, control characters as escapes."""
    return Text(escape_controls(text), style=style)


def print_warning(line: str) -> None:
    """Print a warning on the standard error."""
    print(f"Warning: {escape_controls(line)}", file=sys.stderr, flush=True)


def print_line(console: Console, text: str, *, style: str = "", wrap: bool = False) -> None:
    """Print a line literally, on a console with or without markup.

    A terminal wraps it at its width if asked to; files and pipes never do.
    """
    soft = not (wrap and console.is_terminal)
    console.print(literal_text(text, style), highlight=False, soft_wrap=soft)

"""What is wrong with a key or a value, in the words of a user."""

import difflib
import unicodedata
from collections.abc import Iterable

from pydantic_core import ErrorDetails

_IN_PLAIN_WORDS = {
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "bool_type": "must be true or false",
    "string_type": "must be text",
    "tuple_type": "must be a list",
    "finite_number": "must be finite",
    "string_too_short": "must not be empty",
    "too_short": "must not be empty",
}

_TURNS = "\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"


def is_control(letter: str) -> bool:
    """Whether a letter is obeyed rather than shown: control codes, new lines, turns of writing."""
    return unicodedata.category(letter) in ("Cc", "Cs", "Zl", "Zp") or letter in _TURNS


def shortened(text: str, most: int = 200) -> str:
    """The beginning of a text that is too long to be echoed whole."""
    return text if len(text) <= most else f"{text[: most - 3]}..."


def one_line(text: str, most: int = 1000) -> str:
    """A message in one line that can be seen: controls as escapes, the middle left out if long."""
    line = " ".join(text.splitlines())
    if any(map(is_control, line)):
        line = "".join(repr(c)[1:-1] if is_control(c) else c for c in line)
    return line if len(line) <= most else f"{line[: most - 300]} ... {line[-295:]}"


def first_line(error: BaseException) -> str:
    """What another library says of an error, which may go on and on and quote what it read."""
    return one_line(str(error).strip().partition("\n")[0], 400)


def near(word: str, words: Iterable[str], form: str = "{}") -> str:
    """A hint at the known word that an unknown one resembles; empty where there is none."""
    found = difflib.get_close_matches(str(word), list(words), n=1)
    return f" (did you mean {form.format(found[0])}?)" if found else ""


def index(error: ErrorDetails) -> str:
    """Where in a list an error is, ``[3]`` or ``[3][0]``; empty where the value is no list."""
    return "".join(f"[{part}]" for part in error["loc"] if isinstance(part, int))


def rule(error: ErrorDetails) -> str:
    """The rule that a value breaks."""
    kind = error["type"]
    if kind == "invalid":
        return error["msg"]
    if kind == "missing":
        return "required"
    if kind == "too_long":
        return f"must have {error['ctx']['max_length']} values, not {error['ctx']['actual_length']}"
    return _IN_PLAIN_WORDS.get(kind, error["msg"].replace("Input should be", "must be"))


def explained(error: ErrorDetails) -> str:
    """The rule that a value breaks, and the value where the rule does not show it."""
    if error["type"] in ("invalid", "missing", "too_long"):
        return rule(error)
    given = error["input"]
    value = repr(list(given) if isinstance(given, tuple) else given)
    return f"{rule(error)}, not {shortened(value, 60)}"

"""Reading of TOML, with a bound on the depth of its dotted keys."""

import re
import tomllib
from typing import Any

_MAX_DOTS = 100
"""Most dots of one key. The parser's time grows with their square."""

# An unclosed string ends at its line, or at the end of the text: each character is read once.
_STRING_OR_COMMENT = re.compile(
    r'"""(?:[^"\\]|\\.|"(?!""))*+"{0,5}'
    r"|'''(?:[^']|'(?!''))*+'{0,5}"
    r'|"(?:[^"\\\n]|\\[^\n])*+"?'
    r"|'[^'\n]*+'?"
    r"|#[^\n]*+",
    re.DOTALL,
)
_ENDS_KEY = re.compile(r"[=,{}\[\]\n]")


def parse_toml(text: str) -> dict[str, Any]:
    """Return the tables of a text.

    Raises:
        ValueError: the text is not TOML.
        RecursionError: it is nested more deeply than the parser takes, or than it takes quickly.
    """
    if text.count(".") > _MAX_DOTS:
        bare = _STRING_OR_COMMENT.sub("", text)
        if any(part.count(".") > _MAX_DOTS for part in _ENDS_KEY.split(bare)):
            raise RecursionError("a key has too many dots")
    return tomllib.loads(text)

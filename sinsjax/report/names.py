"""Names from a study, which are printed literally in Markdown and on a console.

Text of a report is Markdown, into which names are put unescaped. They are escaped only when the
text is written to a medium; the study identifies which parts are names.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from sinsjax.study.study import Study

_MARKUP = re.compile(r"[\\`*\[\]~$#]|(?<![^\W_])_|_(?![^\W_])|^[-+>]")
"""What Markdown or GitHub interprets in a name; ``_`` only at the edge of a word."""

_TAG = re.compile("<(?=[A-Za-z/!?])")


class StudyNames(NamedTuple):
    """The names that may occur in a report.

    Attributes:
        texts: the names, in any order.
    """

    texts: frozenset[str] = frozenset()

    @classmethod
    def from_study(cls, study: Study, *other_texts: str) -> "StudyNames":
        """All text in a study, and other text that is not the report's own."""
        return cls(
            frozenset(filter(_has_markdown, [*_iterate_texts(study.model_dump()), *other_texts]))
        )

    def to_markdown(self, text: str) -> str:
        """Return text of a report as Markdown, with markup in names escaped."""
        return self._map_pieces(text, escape_markdown, lambda other: _TAG.sub("&lt;", other))

    def to_plain_text(self, text: str) -> str:
        """Return text of a report without its markup; markup in names stays."""
        return self._map_pieces(text, str, lambda other: other.replace("*", "").replace("`", ""))

    def _map_pieces(
        self, text: str, map_name: Callable[[str], str], map_other: Callable[[str], str]
    ) -> str:
        if not self.texts:
            return map_other(text)
        longest_first = sorted(self.texts, key=len, reverse=True)
        pieces = re.split(f"({'|'.join(map(re.escape, longest_first))})", text)
        return "".join(
            (map_other, map_name)[place % 2](piece) for place, piece in enumerate(pieces)
        )


NO_NAMES = StudyNames()
"""Names of a report that has only the package's own words."""


def escape_markdown(name: str) -> str:
    """Return a name as Markdown that shows it literally."""
    return _MARKUP.sub(r"\\\g<0>", name.replace("&", "&amp;")).replace("<", "&lt;")


def _has_markdown(text: str) -> bool:
    return escape_markdown(text) != text


def _iterate_texts(content: Any) -> Iterator[str]:
    if isinstance(content, str):
        yield content
    elif isinstance(content, Mapping | list | tuple):
        for entry in content:
            yield from _iterate_texts(entry)
            if isinstance(content, Mapping):
                yield from _iterate_texts(content[entry])

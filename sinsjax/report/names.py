"""Names out of a study are text, whatever a page's Markdown or a console would read in them.

What a layout says is Markdown of its own, into which it puts names as they are. Only here, where it
leaves for a medium, are they told from it: by the study, which has them all.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from sinsjax.study.study import Study

_MARKUP = re.compile(r"[\\`*\[\]~$#]|(?<![^\W_])_|_(?![^\W_])|^[-+>]")
"""What Markdown, or what GitHub adds to it, reads in a name; ``_`` is one only at a word's rim."""

_TAG = re.compile("<(?=[A-Za-z/!?])")


class StudyNames(NamedTuple):
    """The names that a report may hold.

    Attributes:
        texts: all of them, in any order.
    """

    texts: frozenset[str] = frozenset()

    @classmethod
    def from_study(cls, study: Study, *other_texts: str) -> "StudyNames":
        """All text in a study, and other text that is not the report's own."""
        return cls(
            frozenset(filter(_has_markdown, [*_iterate_texts(study.model_dump()), *other_texts]))
        )

    def to_markdown(self, text: str) -> str:
        """What a report says as a page's Markdown: markup in a name is escaped."""
        return self._map_pieces(text, escape_markdown, lambda other: _TAG.sub("&lt;", other))

    def to_plain_text(self, text: str) -> str:
        """What a report says without its markup: that in a name stays."""
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
"""Of a report that is all the package's own words."""


def escape_markdown(name: str) -> str:
    """A name as Markdown that shows it letter by letter; in a table ``|`` is escaped besides."""
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

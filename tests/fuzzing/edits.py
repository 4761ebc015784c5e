"""Edits of nested tables and of bytes, one after another."""

import copy
from typing import Any, NamedTuple

from hypothesis import strategies as st

from fuzzing.values import TEXTS, misfit_values


class HiddenValue(NamedTuple):
    """Wrapper of a large value that hides it in printed output."""

    value: Any

    def __repr__(self) -> str:
        """Return dots instead of the value."""
        return "..."


def places_of_entries(value: Any) -> list[tuple[Any, Any]]:
    """Return container and key or index of every entry of nested tables and lists."""
    places: list[tuple[Any, Any]] = []
    for key, entry in value.items() if isinstance(value, dict) else enumerate(value):
        places.append((value, key))
        places += places_of_entries(entry) if isinstance(entry, dict | list) else []
    return places


@st.composite
def edit_tables(draw: st.DrawFn, original: HiddenValue) -> Any:
    """Draw nested tables with some entries replaced, removed, doubled, renamed or wrapped."""
    data = copy.deepcopy(original.value)
    for _ in range(draw(st.integers(1, 3))):
        places = places_of_entries(data)
        if not places:
            return data
        container, key = places[draw(st.integers(0, len(places) - 1))]
        entry = container[key]
        kind = draw(st.sampled_from(["replace", "replace", "remove", "rename", "double", "wrap"]))
        if kind == "remove":
            del container[key]
        elif kind == "replace":
            container[key] = draw(misfit_values())
        elif kind == "wrap":
            container[key] = draw(st.sampled_from([[entry], {"a": entry}, str(entry)[:99]]))
        elif isinstance(container, list):
            container.insert(key, copy.deepcopy(entry))
        else:
            name = draw(st.sampled_from([*TEXTS, f"{key}s", str(key)[:-1], str(key).upper()]))
            container[name] = copy.deepcopy(entry) if kind == "double" else container.pop(key)
    return data


PIECES = [
    *(b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", b"\xc3", b"\r", b"\n", b"\n\n", b" ", b"\t"),
    *(b",", b";", b"=", b"[", b"]", b"{", b"}", b"[[", b"]]", b"'", b'"', b'"""', b"#", b"-"),
    *(b"nan", b"inf", b"1e999", b"-1", b"0", b"1_000", b"0x", b"2026-01-01T00:00:00Z"),
    *(b"[" * 5000, b"{a=" * 5000, b"9" * 5000, b"x" * 20_000, b"a.b.c.d=1\n"),
    *(b"\\u0000", b"\\", b"null", b"true"),
]


@st.composite
def mangle_bytes(draw: st.DrawFn, original: HiddenValue) -> bytes:
    """Draw bytes with some removed, inserted, flipped or doubled."""
    content: bytes = original.value
    for _ in range(draw(st.integers(1, 3))):
        position = draw(st.integers(0, len(content)))
        length = draw(st.sampled_from([0, 1, 1, 2, 8, 64, 1000]))
        head, tail = content[:position], content[position + length :]
        middle = content[position : position + length]
        flipped = bytes(byte ^ (1 << draw(st.integers(0, 7))) for byte in middle[:1])
        content = draw(
            st.sampled_from(
                [
                    head + tail,
                    head,
                    head + middle + middle + tail,
                    head + flipped + middle[1:] + tail,
                ]
            )
            | st.sampled_from(PIECES).map(lambda piece, h=head, t=middle + tail: h + piece + t)
        )
    return content

"""Edits of nested tables and of bytes, one after another."""

import copy
from typing import Any, NamedTuple

from hypothesis import strategies as st

from fuzzing.values import TEXTS, misfits

Path_ = tuple[Any, ...]


class Quiet(NamedTuple):
    """Something large that is not to be printed with all that it goes into."""

    value: Any

    def __repr__(self) -> str:
        """Says nothing of it."""
        return "..."


def places(value: Any, at: Path_ = (), most: int = 400) -> list[Path_]:
    """Where the entries of nested tables and lists are."""
    found: list[Path_] = []
    entries = value.items() if isinstance(value, dict) else enumerate(value)
    for key, entry in entries:
        found.append((*at, key))
        if isinstance(entry, dict | list) and len(found) < most:
            found += places(entry, (*at, key), most - len(found))
    return found


@st.composite
def edited(draw: st.DrawFn, given: Quiet, most: int = 3) -> Any:
    """Nested tables with some entries replaced, removed, doubled, renamed or moved."""
    data = copy.deepcopy(given.value)
    for _ in range(draw(st.integers(1, most))):
        there = places(data)
        if not there:
            return data
        *path, key = draw(st.sampled_from(there))
        home = data
        for step in path:
            home = home[step]
        kind = draw(st.sampled_from(["replace", "replace", "remove", "rename", "double", "wrap"]))
        if kind == "remove":
            del home[key]
        elif kind == "replace":
            home[key] = draw(misfits())
        elif kind == "wrap":
            home[key] = draw(st.sampled_from([[home[key]], {"a": home[key]}, str(home[key])[:99]]))
        elif kind == "double" and isinstance(home, list):
            home.insert(key, copy.deepcopy(home[key]))
        elif isinstance(home, dict):
            name = draw(st.sampled_from([*TEXTS, f"{key}s", str(key)[:-1], str(key).upper()]))
            home[name] = home[key] if kind == "double" else home.pop(key)
    return data


PIECES = [
    *(
        b"\x00",
        b"\xff\xfe",
        b"\xef\xbb\xbf",
        b"\xc3",
        b"\r",
        b"\n",
        b"\n\n",
        b" ",
        b",",
        b";",
        b"\t",
    ),
    *(b"=", b"[", b"]", b"{", b"}", b"[[", b"]]", b"'", b'"', b'"""', b"#", b"-", b"nan", b"inf"),
    *(b"1e999", b"-1", b"0", b"1_000", b"0x", b"2026-01-01T00:00:00Z", b"[" * 5000, b"{a=" * 5000),
    *(b"9" * 5000, b"x" * 20_000, b"a.b.c.d=1\n", b"\\u0000", b"\\", b"null", b"true"),
]


@st.composite
def mangled(draw: st.DrawFn, given: Quiet, most: int = 3) -> bytes:
    """Bytes with some cut out, put in, turned or doubled."""
    content: bytes = given.value
    for _ in range(draw(st.integers(1, most))):
        at = draw(st.integers(0, len(content)))
        length = draw(st.sampled_from([0, 1, 1, 2, 8, 64, 1000]))
        kind = draw(st.sampled_from(["cut", "insert", "flip", "double", "truncate"]))
        head, middle, tail = content[:at], content[at : at + length], content[at + length :]
        if kind == "cut":
            content = head + tail
        elif kind == "insert":
            content = head + draw(st.sampled_from(PIECES)) + middle + tail
        elif kind == "flip":
            content = (
                head
                + bytes(b ^ (1 << draw(st.integers(0, 7))) for b in middle[:1])
                + middle[1:]
                + tail
            )
        elif kind == "double":
            content = head + middle + middle + tail
        else:
            content = head
    return content

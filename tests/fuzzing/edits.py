"""Edits of nested tables and of bytes, one after another."""

import copy
from typing import Any, NamedTuple

from hypothesis import strategies as st

from fuzzing.values import TEXTS, misfit_values

Path_ = tuple[Any, ...]


class HiddenValue(NamedTuple):
    """Wrapper of a large value that hides it in printed output."""

    value: Any

    def __repr__(self) -> str:
        """Return dots instead of the value."""
        return "..."


def entry_paths(value: Any, path: Path_ = (), max_paths: int = 400) -> list[Path_]:
    """Return the paths of the entries of nested tables and lists."""
    paths: list[Path_] = []
    entries = value.items() if isinstance(value, dict) else enumerate(value)
    for key, entry in entries:
        paths.append((*path, key))
        if isinstance(entry, dict | list) and len(paths) < max_paths:
            paths += entry_paths(entry, (*path, key), max_paths - len(paths))
    return paths


@st.composite
def edit_tables(draw: st.DrawFn, original: HiddenValue, max_edits: int = 3) -> Any:
    """Draw nested tables with some entries replaced, removed, doubled, renamed or wrapped."""
    data = copy.deepcopy(original.value)
    for _ in range(draw(st.integers(1, max_edits))):
        paths = entry_paths(data)
        if not paths:
            return data
        *path, key = draw(st.sampled_from(paths))
        container = data
        for step in path:
            container = container[step]
        kind = draw(st.sampled_from(["replace", "replace", "remove", "rename", "double", "wrap"]))
        if kind == "remove":
            del container[key]
        elif kind == "replace":
            container[key] = draw(misfit_values())
        elif kind == "wrap":
            entry = container[key]
            container[key] = draw(st.sampled_from([[entry], {"a": entry}, str(entry)[:99]]))
        elif kind == "double" and isinstance(container, list):
            container.insert(key, copy.deepcopy(container[key]))
        elif isinstance(container, dict):
            name = draw(st.sampled_from([*TEXTS, f"{key}s", str(key)[:-1], str(key).upper()]))
            container[name] = container[key] if kind == "double" else container.pop(key)
    return data


PIECES = [
    *(b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", b"\xc3", b"\r", b"\n", b"\n\n", b" ", b"\t"),
    *(b",", b";", b"=", b"[", b"]", b"{", b"}", b"[[", b"]]", b"'", b'"', b'"""', b"#", b"-"),
    *(b"nan", b"inf", b"1e999", b"-1", b"0", b"1_000", b"0x", b"2026-01-01T00:00:00Z"),
    *(b"[" * 5000, b"{a=" * 5000, b"9" * 5000, b"x" * 20_000, b"a.b.c.d=1\n"),
    *(b"\\u0000", b"\\", b"null", b"true"),
]


@st.composite
def mangle_bytes(draw: st.DrawFn, original: HiddenValue, max_edits: int = 3) -> bytes:
    """Draw bytes with some removed, inserted, flipped or doubled."""
    content: bytes = original.value
    for _ in range(draw(st.integers(1, max_edits))):
        position = draw(st.integers(0, len(content)))
        length = draw(st.sampled_from([0, 1, 1, 2, 8, 64, 1000]))
        kind = draw(st.sampled_from(["cut", "insert", "flip", "double", "truncate"]))
        head, tail = content[:position], content[position + length :]
        middle = content[position : position + length]
        if kind == "cut":
            content = head + tail
        elif kind == "insert":
            content = head + draw(st.sampled_from(PIECES)) + middle + tail
        elif kind == "flip":
            flipped = bytes(byte ^ (1 << draw(st.integers(0, 7))) for byte in middle[:1])
            content = head + flipped + middle[1:] + tail
        elif kind == "double":
            content = head + middle + middle + tail
        else:
            content = head
    return content

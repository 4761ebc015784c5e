"""TOML with a bound on the depth of its keys: what people write is read as Python reads it."""

import time
import tomllib

import hypothesis.strategies as st
import pytest
from hypothesis import given

from sinsjax.toml_text import parse_toml

DOTS = "." * 300
HARMLESS = (
    f'"{DOTS}"',
    f"'{DOTS}'",
    f'"\\"{DOTS}"',
    f"'\\' # {DOTS}",
    f'"""\n{DOTS}\n= "" {DOTS}\\""""',
    f"'''\n{DOTS}\n'' {DOTS}'''",
    f'"""{DOTS}"""""',
    f"'''{DOTS}'''''",
    '""',
    '""""""',
    f"0.5 # it's {DOTS} \"",
    "[" + "0.5, " * 200 + "]",
    "[" + "[0.5], " * 200 + "[{a.b.c = 0.5}]]",
    "{" + ", ".join(f"k{i}.a.b = 1.5" for i in range(100)) + "}",
    "1979-05-27T07:32:00.999999",
    f'{{ "{DOTS}".a."b.c" = 1 }}',
)
"""Values, comments among them, whose many dots are those of no key."""

DEEP = ("{key} = 1", "[{key}]", "[[{key}]]", "x = {{a = '', {key} = 1}}", "x = [{{{key} = 1}}]")


def write_lines(values: list[str]) -> str:
    """A value a line, each of a key of its own."""
    return "".join(f"{'k.' * (i % 5)}k{i} = {value}\n" for i, value in enumerate(values))


@given(st.lists(st.sampled_from(HARMLESS), min_size=1, max_size=8))
def test_dots_outside_keys_are_read_as_python_reads_them(values: list[str]) -> None:
    text = write_lines(values)
    assert parse_toml(text) == tomllib.loads(text)


@given(
    st.lists(st.sampled_from(HARMLESS), max_size=8),
    st.sampled_from(DEEP),
    st.sampled_from(["x", '"a.b"', "'#'", '"\\""', "x "]),
)
def test_key_with_too_many_dots_is_refused_wherever_it_stands(
    values: list[str], how: str, part: str
) -> None:
    text = write_lines(values) + how.format(key=".".join([part] * 150)) + "\n"
    with pytest.raises(RecursionError):
        parse_toml(text)


LONG = {
    "key": "x." * 100_000 + "x = 1",
    "header": "[" + "x . " * 100_000 + "x]",
    "open texts": '""".\\' * 100_000,
    "open literals": "'''.'\n" * 100_000,
    "open strings": '"."\\' * 100_000,
    "quotes": "'.'\n" * 100_000,
    "comment": ".#" * 100_000,
}


@pytest.mark.parametrize("text", LONG.values(), ids=LONG)
def test_time_to_refuse_grows_with_the_text_alone(text: str) -> None:
    start = time.process_time()
    with pytest.raises((RecursionError, ValueError)):
        parse_toml(text)
    assert time.process_time() - start < 2  # the parser alone takes minutes over the first two

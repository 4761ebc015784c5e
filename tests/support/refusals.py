"""Tables of refusals: what is wrong in a study, and what the line about it must name.

    axes.phi_u0_deg = [0, 200]                         -> [axes] phi_u0_deg[1]: 180 200
    resets.reset_count = 2 & axes.reset_cycle_s = [50, 451]
        -> [axes] reset_cycle_s: 451 902

Before the arrow are lines of TOML, with `&` between them; after it the beginning of the line, up to
its colon, and the values, keys and words that stand somewhere in the rest. Its sentence is free.
"""

import re
import tomllib
from typing import Any, NamedTuple

import pytest

from sinsjax.errors import InputError


class Refusal(NamedTuple):
    """A row of such a table.

    Attributes:
        text: the row.
        tables: the sections of a study with the mistake.
        place: section and key that the line begins with.
        named: what the rest of the line names.
    """

    text: str
    tables: dict[str, Any]
    place: str
    named: tuple[str, ...]

    def check(self, line):
        """Fail unless a line names the place and all the rest."""
        assert_named(line, self.place, *self.named)


def assert_named(line, place, *named):
    """Fail unless a line begins with a place and a colon, and names all of the words after it."""
    assert "\n" not in line
    assert line.startswith(f"{place}:"), line
    rest = line.removeprefix(f"{place}:")
    missing = [word for word in named if not re.search(rf"(?<![\w.]){re.escape(word)}(?!\w)", rest)]
    assert not missing, f"{missing} not in {rest!r}"


def assert_refusal(line, told):
    """Fail unless a line is as told: a place, a colon, and words that stand somewhere after it."""
    place, _, named = told.rpartition(": ")
    assert_named(line, place, *named.split())


def refusal_lines(call, *given, **more):
    """Return the lines of the InputError of a call, less the word that a study without file has."""
    with pytest.raises(InputError) as caught:
        call(*given, **more)
    return [line.removeprefix("study: ") for line in caught.value.lines]


def refusal_line(call, *given, **more):
    """Return the only line of `refusal_lines`."""
    (line,) = refusal_lines(call, *given, **more)
    assert line.isprintable() and len(line) < 400
    return line


def refused(table):
    """Run a test for each `refusal` of a table; lines that begin with # are comments."""
    rows, before = [], ""
    for line in table.strip().splitlines():
        if line.lstrip().startswith("#"):
            continue
        change, arrow, told = line.partition("->")
        before = f"{before} {change.strip()}".strip()
        if arrow:
            place, _, named = told.strip().partition(": ")
            tables = tomllib.loads(before.replace(" & ", "\n"))
            rows.append(Refusal(before, tables, place, tuple(named.split())))
            before = ""
    assert rows and not before, f"no arrow after {before}"
    return pytest.mark.parametrize("refusal", rows, ids=lambda row: row.text)

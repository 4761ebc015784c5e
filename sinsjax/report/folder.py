"""A page of a study: prose in ``page.md.j2``, its numbers, tables and figures from ``page.py``.

``page.py`` has a function ``page(sources)`` that computes a `Page`. The prose takes from it by
name: ``{{ best_two.settle }}`` a value, ``{{ tables.what_to_set }}`` a table, ``{{ figures.map }}``
a figure. ``{{ claim("two settle sooner than one") }}`` prints nothing: it ties a sentence to what
makes it true.
"""

import importlib
import sys
from collections import ChainMap
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.machinery import ModuleSpec
from importlib.util import module_from_spec
from pathlib import Path
from types import MappingProxyType, ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from jinja2 import TemplateError

from sinsjax import plots
from sinsjax.errors import InputError
from sinsjax.execution.source import Source
from sinsjax.report.base import Picture, Table
from sinsjax.report.markup import environment, template
from sinsjax.report.output import FIGURES, markdown, save_figures, write_text

SCRIPT, PROSE = "page.py", "page.md.j2"
"""The files of a page's folder."""

_PACKAGE = "sinsjax_pages"


class Page(NamedTuple):
    """What the prose of a page may name; all of it has to be named.

    Attributes:
        values: text and numbers by name, or by name within a name.
        tables: by name.
        figures: by name.
        claims: whether what the prose says is so, by what it says.
    """

    values: Mapping[str, Any]
    tables: Mapping[str, Table] = MappingProxyType({})
    figures: Mapping[str, Picture] = MappingProxyType({})
    claims: Mapping[str, bool | np.bool_] = MappingProxyType({})

    @classmethod
    def joined(cls, *parts: "Page") -> "Page":
        """A page of several parts, each with names of its own."""
        return cls(*(dict(ChainMap(*map(dict, kind))) for kind in zip(*parts, strict=True)))


class Sources(dict[str, Source]):
    """Results by the name of their study."""

    def __missing__(self, name: str) -> Source:
        """Tells that results are not among those that were given."""
        given = ", ".join(self) or "none"
        raise InputError(f"the page needs results of {name}: add their directory ({given})")


class _Noted:
    """A value that notes when the prose prints it."""

    def __init__(self, value: Any, note: Callable[[], None]) -> None:
        self._value, self._note = value, note

    def __str__(self) -> str:
        self._note()
        return str(self._value)


def _noted(values: Mapping[str, Any], unused: set[str], of: str = "") -> dict[str, Any]:
    """Values by name, whose names within names are attributes; each leaves ``unused`` in print."""
    made: dict[str, Any] = {}
    for name, value in values.items():
        whole = f"{of}{name}"
        if isinstance(value, Mapping):
            made[name] = SimpleNamespace(**_noted(value, unused, f"{whole}."))
        else:
            unused.add(whole)
            made[name] = _Noted(value, partial(unused.discard, whole))
    return made


def script(folder: Path) -> ModuleType:
    """Executes a page's script.

    It may import its neighbours (``from .x``), and those of folders beside its own (``from ..y``).

    Raises:
        InputError: the folder lacks the script or the prose.
    """
    if missing := [name for name in (SCRIPT, PROSE) if not (folder / name).is_file()]:
        told = f"holds no {missing[0]}, so that it is no folder of a page"
        raise InputError(f"{folder}: {told} (--page takes one, or a file)")
    beside = str(folder.resolve().parent)
    known = sys.modules.get(_PACKAGE)
    if known is None or list(known.__path__) != [beside]:
        for name in [name for name in sys.modules if name.partition(".")[0] == _PACKAGE]:
            del sys.modules[name]  # of folders elsewhere
        spec = ModuleSpec(_PACKAGE, None, is_package=True)
        spec.submodule_search_locations = [beside]
        sys.modules[_PACKAGE] = module_from_spec(spec)
    return importlib.import_module(f"{_PACKAGE}.{folder.resolve().name}.page")


def compute(folder: Path, sources: Sequence[Source]) -> Page:
    """What a page's script makes of results, given in any order.

    Raises:
        InputError: the folder is no page's, or results are missing.
    """
    page: Page = script(folder).page(Sources({one.study.name: one for one in sources}))
    return page


def render(folder: Path, page: Page, *, enforced: bool = True) -> str:
    """The prose of a page with its numbers, in Markdown.

    Raises:
        InputError: the prose names what is not there, something is not named, or, where that is
            ``enforced``, a claim does not hold.
    """
    unused = {f"claim {text!r}" for text in page.claims}

    def claim(text: str) -> str:
        if text not in page.claims:
            raise InputError(f"{folder / PROSE}: {SCRIPT} does not say whether {text!r} is so")
        unused.discard(f"claim {text!r}")
        return ""

    prefix = f"{folder.name}_"
    content = {
        "tables": {name: markdown(table) for name, table in page.tables.items()},
        "figures": {name: markdown(one, prefix) for name, one in page.figures.items()},
    }
    names = _noted({**page.values, **content}, unused)
    prose = (folder / PROSE).read_text(encoding="utf-8")
    try:
        text = environment().from_string(prose).render(names, claim=claim)
    except TemplateError as error:
        raise InputError(f"{folder / PROSE}: {error}") from error
    if unused:
        raise InputError(f"{folder / PROSE}: no sentence names {', '.join(sorted(unused))}")
    wrong = [text for text, holds in page.claims.items() if not holds]
    if enforced and wrong:
        raise InputError(f"{folder / PROSE}: not so in these results: {'; '.join(wrong)}")
    return text


def write(folder: Path, sources: Sequence[Source]) -> tuple[Path, int]:
    """Writes the page of ``docs/studies/NAME``, ``docs/NAME.md``, and its figures.

    Returns the file, and how many figures it has.

    Raises:
        InputError: see `compute` and `render`; or the page cannot be written.
    """
    folder = folder.resolve()
    page = compute(folder, sources)
    body = render(folder, page)
    path = folder.parents[1] / f"{folder.name}.md"
    footer = "; ".join(source.sample_size_text for source in sources)
    images = {
        f"{folder.name}_{one.name}": plots.png(one.figure, one.rests_on or footer)
        for one in page.figures.values()
    }
    save_figures(images, path.parent / FIGURES)
    made_of = sorted(sources, key=lambda source: source.config)
    text = template("folder.md.j2").render(name=folder.name, body=body, of=made_of)
    write_text(path, text)
    return path, len(images)

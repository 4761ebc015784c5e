"""A page of a study: prose in ``page.md.j2``, its numbers, tables and figures from ``page.py``.

``page.py`` has a function ``page(sources)`` that computes a `Page`. The prose takes from it by
name: ``{{ best_two.settle }}`` a value, ``{{ tables.what_to_set }}`` a table, ``{{ figures.map }}``
a figure. ``{{ claim("two settle sooner than one") }}`` prints nothing: it ties a sentence to what
makes it true.
"""

import importlib
import sys
from collections import ChainMap
from collections.abc import Iterator, Mapping, Sequence
from importlib.machinery import ModuleSpec
from importlib.util import module_from_spec
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any, NamedTuple

from jinja2 import TemplateError
from jinja2.meta import find_undeclared_variables

from sinsjax import plots
from sinsjax.errors import InputError
from sinsjax.execution.source import Source
from sinsjax.platform.files import replacing
from sinsjax.report.base import Picture, Table
from sinsjax.report.markup import environment, template
from sinsjax.report.output import FIGURES, counted, markdown, save_figures

SCRIPT, PROSE = "page.py", "page.md.j2"
"""The files of a page's folder."""

_PACKAGE = "sinsjax_pages"


class Page(NamedTuple):
    """What the prose of a page may name; all of it has to be named.

    Attributes:
        values: text by name, or by name within a name.
        tables: by name.
        figures: by name.
        claims: whether what the prose says is so, by what it says.
    """

    values: Mapping[str, Any]
    tables: Mapping[str, Table] = MappingProxyType({})
    figures: Mapping[str, Picture] = MappingProxyType({})
    claims: Mapping[str, bool] = MappingProxyType({})

    @classmethod
    def joined(cls, *parts: "Page") -> "Page":
        """A page of several parts, each with names of its own."""
        return cls(*(dict(ChainMap(*map(dict, kind))) for kind in zip(*parts, strict=True)))


class Sources(Mapping[str, Source]):
    """Results by the name of their study."""

    def __init__(self, sources: Sequence[Source]) -> None:
        self._sources = {source.study.name: source for source in sources}

    def __getitem__(self, name: str) -> Source:
        """The results of a study.

        Raises:
            InputError: they are not among those that were given.
        """
        if name not in self._sources:
            given = ", ".join(self._sources) or "none"
            raise InputError(f"the page needs results of {name}: add their directory ({given})")
        return self._sources[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._sources)

    def __len__(self) -> int:
        return len(self._sources)


class _Names:
    """What the prose can name, by name; notes in ``used`` what it did."""

    def __init__(self, values: Mapping[str, Any], used: set[str], of: str = "") -> None:
        self._values, self._used, self._of = values, used, of

    def __getattr__(self, name: str) -> Any:
        if name not in self._values:
            raise AttributeError(f"no attribute {name!r}")
        value = self._values[name]
        if isinstance(value, Mapping):
            return _Names(value, self._used, f"{self._of}{name}.")
        self._used.add(f"{self._of}{name}")
        return str(value)


def script(folder: Path) -> ModuleType:
    """Executes a page's script.

    It may import its neighbours (``from .x``), and those of folders beside its own (``from ..y``).

    Raises:
        InputError: the folder lacks the script or the prose.
    """
    if missing := [name for name in (SCRIPT, PROSE) if not (folder / name).is_file()]:
        raise InputError(f"{folder}: holds no {missing[0]}, so that it is no folder of a page")
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
    page: Page = script(folder).page(Sources(sources))
    return page


def render(folder: Path, page: Page, *, enforced: bool = True) -> str:
    """The prose with its numbers, in Markdown.

    Args:
        folder: of the page.
        page: what its script computed.
        enforced: whether a claim that does not hold is an error.

    Raises:
        InputError: the prose names what is not there, something is not named, or a claim does not
            hold.
    """
    used: set[str] = set()

    def claim(text: str) -> str:
        if text not in page.claims:
            raise InputError(f"{folder / PROSE}: {SCRIPT} does not say whether {text!r} is so")
        used.add(f"claim {text!r}")
        return ""

    prefix = f"{folder.name}_"
    content = {
        "tables": {name: markdown(table) for name, table in page.tables.items()},
        "figures": {name: markdown(one, prefix) for name, one in page.figures.items()},
    }
    values = {**page.values, **content}
    names = {
        n: _Names(v, used, f"{n}.") if isinstance(v, Mapping) else v for n, v in values.items()
    }
    jinja, prose = environment(), (folder / PROSE).read_text(encoding="utf-8")
    try:
        used |= find_undeclared_variables(jinja.parse(prose))
        text = jinja.from_string(prose).render(names, claim=claim)
    except TemplateError as error:
        raise InputError(f"{folder / PROSE}: {error}") from error
    offered = {*_flat(values), *(f"claim {text!r}" for text in page.claims)}
    if unused := sorted(offered - used):
        raise InputError(f"{folder / PROSE}: no sentence names {', '.join(unused)}")
    wrong = [text for text, holds in page.claims.items() if not holds]
    if enforced and wrong:
        raise InputError(f"{folder / PROSE}: not so in these results: {'; '.join(wrong)}")
    return text


def write(folder: Path, sources: Sequence[Source]) -> tuple[Path, int]:
    """Writes a page and its figures.

    Args:
        folder: of the page, ``docs/studies/NAME``; it becomes ``docs/NAME.md``.
        sources: results.

    Returns:
        The file, and how many figures it has.

    Raises:
        InputError: see `compute` and `render`; or the page cannot be written.
    """
    folder = folder.resolve()
    page = compute(folder, sources)
    body = render(folder, page)
    path = folder.parents[1] / f"{folder.name}.md"
    footer = "; ".join(map(counted, sources))
    images = {
        f"{folder.name}_{one.name}": plots.png(one.figure, one.rests_on or footer)
        for one in page.figures.values()
    }
    save_figures(images, path.parent / FIGURES)
    made_of = sorted(sources, key=lambda source: source.config)
    text = template("folder.md.j2").render(name=folder.name, body=body, of=made_of)
    with replacing(path) as file:
        file.write(text.encode())
    return path, len(images)


def _flat(values: Mapping[str, Any], of: str = "") -> Iterator[str]:
    """Every name, those within names too."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{of}{name}.")
        else:
            yield f"{of}{name}"

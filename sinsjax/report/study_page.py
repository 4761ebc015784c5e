"""A page of a study: prose in ``page.md.j2``, its numbers, tables and figures from ``page.py``.

``page.py`` has a function ``page(sources)`` that computes a `Page`. The prose refers to its parts
name: ``{{ best_two.settle }}`` a value, ``{{ tables.settings }}`` a table, ``{{ figures.map }}``
a figure. ``{{ claim("two settle sooner than one") }}`` prints nothing: it ties a sentence to the
makes it true.
"""

import csv
import importlib
import sys
from collections import ChainMap
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.machinery import ModuleSpec
from importlib.util import module_from_spec
from io import StringIO
from pathlib import Path
from types import MappingProxyType, ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from jinja2 import TemplateError

from sinsjax import plots
from sinsjax.errors import InputError
from sinsjax.execution.source import Source
from sinsjax.platform.files import atomic_write, make_folder
from sinsjax.report.base import Picture, Table
from sinsjax.report.markup import load_template, template_environment
from sinsjax.report.names import NO_NAMES
from sinsjax.report.output import (
    FIGURES_FOLDER,
    block_to_markdown,
    save_figures,
    write_escaped_text,
)

SCRIPT_FILE, PROSE_FILE = "page.py", "page.md.j2"
"""The files of a page's folder."""

TABLES_FOLDER = "tables"
"""Next to the page: its folded tables, one CSV file each."""

_PACKAGE = "sinsjax_pages"


class Page(NamedTuple):
    """The values, tables and figures that the prose of a page may name; all must be named.

    Attributes:
        values: text and numbers by name, or by name within a name.
        tables: by name.
        figures: by name.
        claims: whether each claim of the prose is true, by its text.
    """

    values: Mapping[str, Any]
    tables: Mapping[str, Table] = MappingProxyType({})
    figures: Mapping[str, Picture] = MappingProxyType({})
    claims: Mapping[str, bool | np.bool_] = MappingProxyType({})

    @classmethod
    def merge(cls, *parts: "Page") -> "Page":
        """Return a page of several parts, whose names differ."""
        return cls(*(dict(ChainMap(*map(dict, kind))) for kind in zip(*parts, strict=True)))


class Sources(dict[str, Source]):
    """Results by the name of their study."""

    def __missing__(self, name: str) -> Source:
        """Report that the results of a study were not given."""
        given = ", ".join(self) or "none"
        raise InputError(f"the page needs results of {name}: add their directory (given: {given})")


class _TrackedValue:
    """A value that notes when the prose prints it."""

    def __init__(self, value: Any, on_print: Callable[[], None]) -> None:
        self._value, self._on_print = value, on_print

    def __str__(self) -> str:
        self._on_print()
        return str(self._value)


def _track_values(values: Mapping[str, Any], unused: set[str], prefix: str = "") -> dict[str, Any]:
    """Return values that leave ``unused`` when printed; nested names become attributes."""
    tracked: dict[str, Any] = {}
    for name, value in values.items():
        full_name = f"{prefix}{name}"
        if isinstance(value, Mapping):
            tracked[name] = SimpleNamespace(**_track_values(value, unused, f"{full_name}."))
        else:
            unused.add(full_name)
            tracked[name] = _TrackedValue(value, partial(unused.discard, full_name))
    return tracked


def load_script(folder: Path) -> ModuleType:
    """Execute a page's script.

    It may import modules of its folder (``from .x``) and of neighbouring ones (``from ..y``).

    Raises:
        InputError: the folder lacks the script or the prose.
    """
    if missing := [name for name in (SCRIPT_FILE, PROSE_FILE) if not (folder / name).is_file()]:
        problem = f"has no {missing[0]}, so it is not the folder of a page"
        raise InputError(f"{folder}: {problem} (give --page such a folder, or a file)")
    parent = str(folder.resolve().parent)
    loaded_package = sys.modules.get(_PACKAGE)
    if loaded_package is None or list(loaded_package.__path__) != [parent]:
        for name in [name for name in sys.modules if name.partition(".")[0] == _PACKAGE]:
            del sys.modules[name]  # of other page folders
        spec = ModuleSpec(_PACKAGE, None, is_package=True)
        spec.submodule_search_locations = [parent]
        sys.modules[_PACKAGE] = module_from_spec(spec)
    return importlib.import_module(f"{_PACKAGE}.{folder.resolve().name}.page")


def compute_page(folder: Path, sources: Sequence[Source]) -> Page:
    """Return the page that its script computes from results, given in any order.

    Raises:
        InputError: the folder is no page's, or results are missing.
    """
    page: Page = load_script(folder).page(
        Sources({source.study.name: source for source in sources})
    )
    return page


def render_prose(folder: Path, page: Page, *, enforce_claims: bool = True) -> str:
    """The prose of a page with its numbers, in Markdown.

    Raises:
        InputError: the prose names an unknown value, a value is not named, or a claim is false and
            ``enforce_claims`` is set.
    """
    unused = {f"claim {text!r}" for text in page.claims}

    def claim(text: str) -> str:
        if text not in page.claims:
            raise InputError(f"{folder / PROSE_FILE}: {SCRIPT_FILE} has no claim {text!r}")
        unused.discard(f"claim {text!r}")
        return ""

    prefix = f"{folder.name}_"
    content = {
        "tables": {
            name: _render_table(table, f"{prefix}{name}") for name, table in page.tables.items()
        },
        "figures": {
            name: block_to_markdown(picture, prefix) for name, picture in page.figures.items()
        },
    }
    names = _track_values({**page.values, **content}, unused)
    prose = (folder / PROSE_FILE).read_text(encoding="utf-8")
    try:
        text = template_environment().from_string(prose).render(names, claim=claim)
    except TemplateError as error:
        raise InputError(f"{folder / PROSE_FILE}: {error}") from error
    if unused:
        raise InputError(
            f"{folder / PROSE_FILE}: the prose does not use {', '.join(sorted(unused))}"
        )
    wrong = [text for text, holds in page.claims.items() if not holds]
    if enforce_claims and wrong:
        raise InputError(f"{folder / PROSE_FILE}: false in these results: {'; '.join(wrong)}")
    return text


def write_study_page(folder: Path, sources: Sequence[Source]) -> tuple[Path, int]:
    """Write the page of ``docs/studies/NAME``, ``docs/NAME.md``, its figures and folded tables.

    Returns the file, and its number of figures.

    Raises:
        InputError: see `compute_page` and `render_prose`; or the page cannot be written.
    """
    folder = folder.resolve()
    page = compute_page(folder, sources)
    body = render_prose(folder, page)
    path = folder.parents[1] / f"{folder.name}.md"
    footer = "; ".join(source.sample_size_text for source in sources)
    images = {
        f"{folder.name}_{picture.name}": plots.render_png(
            picture.figure, picture.data_footer or footer
        )
        for picture in page.figures.values()
    }
    save_figures(images, path.parent / FIGURES_FOLDER)
    for name, table in page.tables.items():
        if table.folded:
            write_table(table, path.parent / TABLES_FOLDER / f"{folder.name}_{name}.csv")
    ordered = sorted(sources, key=lambda source: source.config)
    text = load_template("study_page.md.j2").render(name=folder.name, body=body, sources=ordered)
    write_escaped_text(path, text)
    return path, len(images)


def write_table(table: Table, path: Path) -> None:
    """Write a table as a CSV file, its cells as text.

    Raises:
        InputError: the file cannot be written.
    """
    text = StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows([table.header, *table.rows])
    make_folder(path.parent)
    with atomic_write(path) as file:
        file.write(text.getvalue().encode())


def _render_table(table: Table, stem: str) -> str:
    """Return a table in Markdown; of a folded one, a link to its CSV file, and its note."""
    if not table.folded:
        return block_to_markdown(table)
    link = f"[{NO_NAMES.to_markdown(table.title)}]({TABLES_FOLDER}/{stem}.csv)"
    return f"- Table: {link}. {NO_NAMES.to_markdown(table.note)}".rstrip()

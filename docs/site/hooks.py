"""Hooks of mkdocs: the site also shows what pages link to outside ``docs/``.

Links are written for the repository, where files stand as they are. On the site a file of
``docs/`` has its path within ``docs/``, any other its path in the repository: Markdown and
notebooks as pages, anything else, and scripts of ``docs/``, as a page that shows its text.
"""

import html
import posixpath
import re
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from nbconvert import MarkdownExporter

ROOT = Path(__file__).parents[2]

PAGES = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "benchmarks/README.md")
"""Pages outside ``docs/`` that need no link to be on the site."""

LANGUAGES = {".c": "c", ".cff": "yaml", ".json": "json", ".py": "python", ".toml": "toml"}

_LINK = re.compile(r"\]\((?P<target>[^\s():#]+)(?P<anchor>#[^\s()]*)?\)")
_FIGURE = re.compile(r'(?<!">)<img [^>]*?src="(?P<source>[^":]+)"[^>]*>')
_FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\[(\[](?P<text>.*?)\\[)\]]</(?P=tag)>', re.DOTALL
)
_PANDAS = re.compile(
    r"<style scoped>.*?</style>\s*|(?<=<table) border=\"1\" class=\"dataframe\"", re.DOTALL
)
_COMMENT = re.compile(r"\A<!--.*?-->\s*", re.DOTALL)


def on_config(config: MkDocsConfig) -> None:
    """Stamp every page with the version and, in a checkout, the commit."""
    command = ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"]
    commit = ""
    with suppress(OSError, subprocess.CalledProcessError):
        commit = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
    config.copyright = f"sinsjax {version('sinsjax')}" + (f", commit {commit}" if commit else "")


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the pages outside ``docs/``, the notebooks, and what any of them links to."""
    waiting = [*PAGES, *(f"notebooks/{path.name}" for path in (ROOT / "notebooks").glob("*.ipynb"))]
    for page in list(files.documentation_pages()):
        waiting.extend(_pointed(f"docs/{page.src_uri}", page.content_string))
    while waiting:
        name = waiting.pop()
        if _is_in_docs(name) or files.get_file_from_path(site_path(name)) is not None:
            continue
        for added in _files(name, config):
            files.append(added)
            if added.is_documentation_page():
                waiting.extend(_pointed(name, added.content_string))


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead links to where the site has what they point to."""
    own = page.file.src_uri
    name = f"docs/{own}" if (ROOT / "docs" / own).is_file() else own

    def led(link: re.Match[str]) -> str:
        if (pointed := _resolved(name, link["target"])) is None:
            return link[0]
        target = posixpath.relpath(site_path(pointed), posixpath.dirname(own) or ".")
        return f"]({target}{link['anchor'] or ''})"

    # A comment before the heading would hide the page's title. GitHub reads the Markdown within
    # <details> by itself.
    markdown = _COMMENT.sub("", markdown).replace("<details>", '<details markdown="1">')
    return _LINK.sub(led, markdown)


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Write formulas as MathML, which needs no script and no network, and lead from figures.

    A figure leads to itself alone: on a phone one with many panels is too small to read.
    """
    content = _FORMULA.sub(_to_mathml, content)
    return _FIGURE.sub(r'<a href="\g<source>">\g<0></a>', content)


def site_path(name: str) -> str:
    """The path on the site, before rendering, of a file of the repository."""
    if _is_in_docs(name):
        return name.removeprefix("docs/")
    if name == "README.md":  # the site's own first page is docs/index.md
        return "overview.md"
    stem, ending = posixpath.splitext(name)
    if ending == ".ipynb":
        return f"{stem}.md"
    return name if ending in (".md", ".png") else f"{name}.md"


def _is_in_docs(name: str) -> bool:
    """Whether mkdocs itself puts a file on the site; not scripts, see ``exclude_docs``."""
    return name.startswith("docs/") and not name.endswith(".py")


def _resolved(name: str, target: str) -> str | None:
    """The file of the repository that a link in one of its files points to, if there is one."""
    path = posixpath.normpath(posixpath.join(posixpath.dirname(name), target))
    return path if (ROOT / path).is_file() else None


def _pointed(name: str, text: str) -> Iterator[str]:
    """The files of the repository that a text links to."""
    for link in _LINK.finditer(text):
        if path := _resolved(name, link["target"]):
            yield path


def _files(name: str, config: MkDocsConfig) -> Iterator[File]:
    """What stands on the site for a file outside ``docs/``; a notebook has its figures too."""
    own, path = site_path(name), ROOT / name
    if name.endswith(".ipynb"):
        figures = {"unique_key": f"{path.stem}_files", "output_files_dir": f"{path.stem}_files"}
        text, made = MarkdownExporter().from_filename(path, resources=figures)
        # The theme styles and scrolls only tables without a class.
        yield File.generated(config, own, content=_PANDAS.sub("", text))
        for figure, content in made["outputs"].items():
            uri = posixpath.join(posixpath.dirname(name), figure)
            yield File.generated(config, uri, content=content)
    elif name.endswith(".md"):
        yield File.generated(config, own, content=path.read_text(encoding="utf-8"))
    elif own == name:
        yield File(own, str(ROOT), config.site_dir, config.use_directory_urls)
    else:
        text = path.read_text(encoding="utf-8")
        fence = f"``````{LANGUAGES.get(path.suffix, '')}"
        yield File.generated(config, own, content=f"# {name}\n\n{fence}\n{text}\n``````\n")


def _to_mathml(formula: re.Match[str]) -> str:
    """Return a formula of pymdownx.arithmatex as MathML."""
    display = "block" if formula["tag"] == "div" else "inline"
    return convert(html.unescape(formula["text"]), display=display)

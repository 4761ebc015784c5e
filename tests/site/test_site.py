"""The documentation site: links and anchors, no foreign files, what a reader would search for."""

import ast
import json
import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote, urlsplit

import pytest

import sinsjax

ROOT = Path(__file__).parents[2]
BUILT = "SINSJAX_SITE"


class Shown(NamedTuple):
    """Anchors of a page, and the targets of its links and files."""

    anchors: set[str]
    links: set[str]
    files: set[str]


class _Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.shown = Shown(set(), set(), set())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id" and value:
                self.shown.anchors.add(value)
            elif name == "href" and value and tag == "a":
                self.shown.links.add(value)
            elif name in ("href", "src") and value:
                self.shown.files.add(value)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the site: what CI has built, else built here."""
    if built := os.environ.get(BUILT):
        return Path(built)
    if not all(map(find_spec, ("material", "mkdocs", "mkdocstrings", "nbconvert"))):
        pytest.skip(f'no site: set {BUILT} to its folder, or pip install ".[docs]"')
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--site-dir", str(folder)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Shown]:
    """Every page by its path."""
    read = {}
    for path in site.rglob("*.html"):
        reader = _Reader()
        reader.feed(path.read_text(encoding="utf-8"))
        read[path.resolve()] = reader.shown
    return read


@pytest.fixture(scope="module")
def index(site: Path) -> dict[str, Any]:
    return json.loads((site / "search" / "search_index.json").read_text(encoding="utf-8"))


def cut(text: str, index: dict[str, Any]) -> list[str]:
    """The words of a text, as the index cuts them."""
    return [word for word in re.split(index["config"]["separator"], text) if word]


def entries(index: dict[str, Any]) -> Iterator[tuple[str, list[str]]]:
    """The page of each heading, and the words under it."""
    for entry in index["docs"]:
        text = re.sub(r"<[^>]+>", " ", f"{entry['title']} {entry['text']}")
        yield entry["location"].partition("#")[0], cut(text, index)


@pytest.mark.slow
def test_site_links_lead_to_existing_pages_and_anchors(
    site: Path, pages: dict[Path, Shown]
) -> None:
    followed = 0
    for path, page in pages.items():
        for link in page.links | page.files:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            base = site if parts.path.startswith("/") else path.parent
            target = (base / unquote(parts.path).lstrip("/")).resolve() if parts.path else path
            if target.is_dir():
                target /= "index.html"
            assert target.is_file(), f"{path.relative_to(site)}: {link}"
            if parts.fragment and target in pages:
                anchors = pages[target].anchors
                assert unquote(parts.fragment) in anchors, f"{path.relative_to(site)}: {link}"
            followed += 1
    assert len(pages) > 25 and followed > 1000


@pytest.mark.slow
def test_figures_link_to_full_size_image(site: Path, pages: dict[Path, Shown]) -> None:
    figures = [
        (path, file)
        for path, page in pages.items()
        for file in page.files
        if file.endswith(".png") and "assets/" not in file
    ]
    assert len(figures) > 25
    for path, file in figures:
        assert file in pages[path].links, f"{path.relative_to(site)}: {file}"


@pytest.mark.slow
def test_pages_and_styles_load_no_external_files(site: Path, pages: dict[Path, Shown]) -> None:
    for path, page in pages.items():
        assert not [file for file in page.files if urlsplit(file).netloc], path
    for style in site.rglob("*.css"):
        assert not re.search(r"url\(['\"]?(https?:)?//", style.read_text(encoding="utf-8")), style


@pytest.mark.slow
def test_formulas_are_mathml_without_dollar_signs(site: Path) -> None:
    formulas = 0
    for path in site.rglob("*.html"):
        text = path.read_text(encoding="utf-8")
        formulas += text.count("<math ")
        shown = re.sub(r"<(script|style|code|pre|annotation)\b.*?</\1>", "", text, flags=re.DOTALL)
        assert not re.search(r"\$[^$\n]*\\[a-z]", re.sub(r"<[^>]+>", "", shown)), path
    assert formulas > 30


@pytest.mark.slow
def test_pages_are_stamped_with_the_version(site: Path, pages: dict[Path, Shown]) -> None:
    stamp = f"sinsjax {sinsjax.__version__}"
    for path in pages:
        assert path.name == "404.html" or stamp in path.read_text(encoding="utf-8"), path


@pytest.mark.slow
def test_landing_page_leads_to_sweep_advice_and_record(
    site: Path, pages: dict[Path, Shown]
) -> None:
    landing = pages[(site / "index.html").resolve()]
    assert {"start.html", "advise.html", "own_record.html", "overview.html"} <= {
        link.partition("#")[0] for link in landing.links
    }


@pytest.mark.slow
def test_site_contains_no_study_sources(site: Path) -> None:
    assert not {path.suffix for path in site.rglob("*")} & {".j2", ".py", ".pyc"}


@pytest.mark.slow
def test_python_pages_describe_each_public_name_once(site: Path, pages: dict[Path, Shown]) -> None:
    of_python = [*(site / "python").glob("*.html"), site / "python.html", site / "plotting.html"]
    described = [
        anchor.removeprefix("sinsjax.")
        for path in of_python
        for anchor in pages[path.resolve()].anchors
        if re.match(r"sinsjax\.\w+$", anchor)
    ]
    assert sorted(described) == sorted(sinsjax.__all__)


def test_python_page_links_to_all_pages_of_its_folder() -> None:
    index = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    folder = (ROOT / "docs" / "python").glob("*.md")
    assert {*re.findall(r"\]\(python/(\w+)\.md\)", index)} == {path.stem for path in folder}


@pytest.mark.slow
def test_interface_page_describes_names_imported_by_example(
    site: Path, pages: dict[Path, Shown]
) -> None:
    anchors = pages[(site / "python" / "method_interface.html").resolve()].anchors
    imported = set()
    for path in (ROOT / "tests" / "example_method").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("sinsjax"):
                imported |= {f"{node.module}.{alias.name}" for alias in node.names}
    described = {name for name in imported for a in anchors if f"{a}.".startswith(f"{name}.")}
    assert imported == described > {"sinsjax.methods.base.Method", "sinsjax.maths.rotations.log"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "page"),
    [
        ("covariance reset", "reset_law.html"),
        ("R", "keys.html"),
        ("heading_deg", "own_record.html"),
        ("averaging_time_s", "own_method.html"),
        ("heading", "keys.html"),
        ("PSINS", "own_record.html"),
        ("misalignment", "overview.html"),
        ("NEES", "consistency.html"),
        ("one_run", "python/running.html"),
        ("AttitudeCovariance", "python/method_interface.html"),
        ("duckdb", "results.html"),
        ("resume", "results.html"),
        ("scheduler", "cluster.html"),
        ("gyro bias", "which_alignment.html"),
    ],
)
def test_search_finds_expected_page(words: str, page: str, index: dict[str, Any]) -> None:
    """A page is found that has all the words, as the index cuts them, under one heading."""
    wanted = {word.lower() for word in cut(words, index)}
    found = {at for at, known in entries(index) if wanted <= {word.lower() for word in known}}
    assert page in found, sorted(found)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "page"),
    [
        ("averaging_time_s", "own_method.html"),
        ("p0_yaw_deg", "methods.html"),
        ("read_history", "python/tuning.html"),
    ],
)
def test_search_index_keeps_code_names_as_one_word(
    name: str, page: str, index: dict[str, Any]
) -> None:
    """Cut at its underscores it would find all pages with averages, times and seconds."""
    found = Counter[str]()
    for page_of, words in entries(index):
        if count := words.count(name):
            found[page_of] += count
    assert 0 < len(found) < 10 and found[page] == max(found.values()), found

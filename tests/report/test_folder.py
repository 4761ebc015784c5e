"""Study pages: prose with named numbers, none missing, none unused, no false claim."""

from pathlib import Path

import pytest
from support.stored_results import report_text, store_results
from support.studies import small_study
from support.synthetic_tables import synthetic_summary

from sinsjax.errors import InputError

pytestmark = pytest.mark.usefixtures("drawn_on_request")

SCRIPT = """
from matplotlib.figure import Figure
from sinsjax.report.base import Picture, Table
from sinsjax.report.study_page import Page
from .neighbour import HALF

def page(sources):
    runs = sources["swing"].runs
    figure = Figure()
    figure.suptitle("A map")
    return Page(
        {"runs": runs, "best": {"settle": "195 [181, 219] s", "items": HALF}},
        {"all": Table("All | of it", ["a|b"], [["1"]], "Note.", folded=True)},
        {"map": Picture("by_axis", "What is seen.", figure)},
        {"there are runs": runs > 0},
    )
"""
PROSE = """# A page

In {{ runs }} runs it takes {{ best.settle }}, {{ best.items }}{{ claim("there are runs") }}.

{{ figures.map }}

{{ tables.all }}
"""


@pytest.fixture
def write_page_folder(tmp_path):
    """A folder of a page with prose to choose."""

    def made(prose: str = PROSE, script: str = SCRIPT) -> Path:
        at = tmp_path / "docs" / "studies" / "two_words"
        at.mkdir(parents=True)
        (at / "page.py").write_text(script)
        (at / "neighbour.py").write_text("HALF = 'half'\n")
        (at / "page.md.j2").write_text(prose)
        return at

    return made


@pytest.fixture
def results(tmp_path):
    study = small_study(study={"name": "swing"})
    return store_results(tmp_path / "results", study, synthetic_summary(study))


def test_page_renders_prose_with_script_values(write_page_folder, results, tmp_path):
    said = report_text(results, page=write_page_folder())
    text = (tmp_path / "docs" / "two_words.md").read_text()
    assert "two_words.md and 1 figures" in said and "ok:" not in said
    assert text.startswith("<!-- Written by: sinsjax report --page docs/studies/two_words;")
    assert "\n# A page\n\nIn 3 runs it takes 195 [181, 219] s, half.\n" in text
    assert "![A map](figures/two_words_by_axis.png)\n\n*What is seen.*" in text
    assert text.count("What is seen.") == 1
    assert "\n- Table: [All | of it](tables/two_words_all.csv). Note.\n" in text
    assert (tmp_path / "docs" / "tables" / "two_words_all.csv").read_text() == "a|b\n1\n"
    assert text.rstrip().endswith("sinsjax unknown: `swing.toml` (3 runs).*")
    assert (tmp_path / "docs" / "figures" / "two_words_by_axis.png").is_file()


@pytest.mark.parametrize(
    ("prose", "message"),
    [
        (PROSE.replace("best.settle", "best.setle"), "no attribute 'setle'"),
        (PROSE.replace("{{ runs }}", "{{ rans }}"), "'rans' is undefined"),
        (PROSE.replace("{{ best.items }}", ""), "the prose does not use best.items"),
        (PROSE.replace("{{ figures.map }}", ""), "the prose does not use figures.map"),
        (PROSE.replace("{{ tables.all }}", ""), "the prose does not use tables.all"),
        (
            PROSE.replace('{{ claim("there are runs") }}', ""),
            "the prose does not use claim 'there are",
        ),
        (PROSE.replace("there are", "there were"), "has no claim 'there were runs'"),
        (PROSE.replace("{{ runs }}", "{{ runs"), "page.md.j2"),
    ],
)
def test_unused_or_undefined_names_in_prose_are_refused(write_page_folder, results, prose, message):
    with pytest.raises(InputError, match="page.md.j2: ") as caught:
        report_text(results, page=write_page_folder(prose))
    assert message in str(caught.value)


def test_false_claim_in_page_is_reported(write_page_folder, results):
    script = SCRIPT.replace("runs > 0", "runs > 3")
    with pytest.raises(InputError, match="false in these results: there are runs"):
        report_text(results, page=write_page_folder(script=script))


def test_folder_without_page_script_is_refused(results, tmp_path):
    with pytest.raises(InputError, match=r"has no page.py, .* a page \(give --page"):
        report_text(results, page=tmp_path)

"""The pages written by hand are facts too: what they tell to type runs."""

import csv
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
from support.studies import small_study

import sinsjax
from sinsjax import columns
from sinsjax.execution import run
from sinsjax.study.keys import SECTION_OF

pytestmark = pytest.mark.optimised(False)

ROOT = Path(__file__).parents[2]
RESULTS = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("docs")
    study = small_study(study={"curves": True}, axes={"phi_u0_deg": [0.0, 10.0, 30.0]})
    run.run_into(study, folder / "out")
    variables = {"p0_yaw_deg": {"candidates": [20.0, 80.0]}}
    tune = {"searches": ["grid"], "tune_draws": 2, "evaluation_draws": 3, "variables": variables}
    sinsjax.tune(small_study(tune=tune), folder / "tuned")
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("number", range(4))
def test_results_page_python_examples_run(
    number: int, out: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Blocks run in order, as a reader types them; the third uses a name of the second."""
    examples = re.findall(r"```python\n(.*?)```", RESULTS, re.DOTALL)
    assert len(examples) == 4
    monkeypatch.chdir(out)
    names: dict[str, object] = {}
    if number == 2:
        exec("import pyarrow.dataset as ds", names)
    exec(compile(examples[number], "docs/results.md", "exec"), names)
    told = capsys.readouterr().out
    if number == 1:
        assert int(told) == 3
    if number == 2:
        assert "'settle_10_s': 's'" in told
    if number == 3:
        steps = 2 * 2 * 600  # of two candidates on two draws
        assert re.match(rf"grid \d\.\d+ {steps}\n", told)
        assert "'case': 'baseline" in told and "'n': 3" in told


@pytest.mark.slow
def test_plotting_page_example_draws_and_saves_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (ROOT / "docs" / "plotting.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(example, "docs/plotting.md", "exec"), names)
    assert names["runs"].num_rows == 48  # as the page states
    assert (tmp_path / "heat.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "lines.pdf").read_bytes().startswith(b"%PDF")
    assert names["lines"].get_suptitle() == "Resets at 10 Hz"
    assert names["lines"].axes[0].get_ylim() == (0, 600)
    assert len(names["curves"].axes) >= 6 and len(names["belief"].axes) == 2


@pytest.mark.slow
@pytest.mark.parametrize("library", ["pandas", "polars", "duckdb", "xarray"])
def test_results_load_into_each_library_in_one_line(
    library: str, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (lines,) = re.findall(r"```py\n(.*?)```", RESULTS, re.DOTALL)
    begin, *rest = lines.splitlines()
    line = next(line for line in rest if re.search(rf"{library}\.|to_{library}\(\)$", line))
    if library == "xarray":
        pytest.importorskip("pandas")
    names: dict[str, Any] = {"sinsjax": sinsjax, library: pytest.importorskip(library)}
    monkeypatch.chdir(out)
    exec(f"{begin}\n{line}", names)
    found = {
        "pandas": lambda: len(names["frame"]),
        "polars": lambda: len(names["frame"]),
        "duckdb": lambda: names["table"].aggregate("sum(runs)").fetchall()[0][0],
        "xarray": lambda: names["grid"]["phi_u_arcmin"].size,
    }
    assert found[library]() == 9  # three draws of three variants


def test_pages_document_every_column() -> None:
    """`E` is an axis, `X` a band or a report time, `T` a report time of an estimate."""
    settling = [
        column(10.0, truth=truth)
        for column in (columns.settle_column, columns.settle_data_column)
        for truth in (False, True)
    ]
    runs = (*columns.IDENTITY, columns.PREDICTED, *columns.OBSERVED, *settling, *columns.JUDGED)
    curves = columns.curve_columns(passes=True)
    estimated = (
        *columns.estimate_columns([10.0], floors_vary=True),
        *columns.settle_estimate_columns(10.0),
        *columns.FLOOR,
        columns.nonlinearity_column(),
        columns.nonlinearity_column(10.0),
        columns.FILLED,
    )
    estimates = (ROOT / "docs" / "estimates.md").read_text(encoding="utf-8")
    documented = {
        RESULTS: (*runs, *columns.report_time_columns(10.0), *curves),
        estimates: (*estimated, *columns.INFORMATION_BOUND[2:]),
    }
    for page, expected in documented.items():
        words = set(re.findall(r"`(\w+)`", page))
        for name in (column.name for column in expected):
            general = re.sub(r"(phi|sigma)_[enu](?=0?_)", r"\1_E", name)
            general = re.sub("^(roll|yaw)_(mean|std)", r"pitch_\2", general)
            spellings = {
                spelling.replace("at_10", at)
                for spelling in (name, general)
                for at in ("at_X", "at_T")
            }
            spellings = {re.sub(r"(?<=_)10(?=_)", "X", spelling) for spelling in spellings}
            assert spellings & words, name


def test_links_in_docs_pages_exist() -> None:
    for page in (ROOT / "docs").rglob("*.md"):
        for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_psins_comparison_example_loads_and_names_known_keys(tmp_path: Path) -> None:
    """The worked example is valid, and the keys in its table exist."""
    text = (ROOT / "docs" / "comparison.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    (tmp_path / "methods_compare.toml").write_text(example, encoding="utf-8")
    assert sinsjax.load_study(tmp_path / "methods_compare.toml").n_variants == 4
    assert "](tables/comparison_psins.csv)" in text
    path = ROOT / "docs" / "tables" / "comparison_psins.csv"
    with path.open(encoding="utf-8", newline="") as file:
        cells = [row["sinsjax"] for row in csv.DictReader(file)]
    keys = r"(?<![\w\"])(\w+_\w+|method|format)\b"
    named = {name for cell in cells for name in re.findall(keys, cell)}
    told = {column.name for column in columns.OBSERVED} | SECTION_OF.keys() | {"rate_hz"}
    assert len(named) > 25 and named <= told | {"duration_s", "format"}


def test_release_has_one_version_and_date_everywhere() -> None:
    """Also that of the package as installed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    version, date = re.findall(r"^(?:version|date-released): (.+)$", citation, re.M)
    assert version == project["version"] == sinsjax.__version__
    assert changes.partition("\n## ")[2].startswith(f"[{version}] - {date}\n")
    (wheel,) = re.findall(r"sinsjax-(\S+)-py3", (ROOT / "docs/start.md").read_text("utf-8"))
    assert wheel == version

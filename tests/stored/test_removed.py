"""Results of 1.0.0 with what was removed after it: one line each, and nothing is lost."""

import shutil
from pathlib import Path

import pytest
from reading import HERE, TUNED

import sinsjax
from sinsjax import messages
from sinsjax.errors import InputError
from sinsjax.execution.directory import read_sealed_parquet, to_sealed_parquet
from sinsjax.execution.results import Results
from sinsjax.study.search_space import SearchSpace
from sinsjax.tuning import history


@pytest.fixture
def tuned(tmp_path: Path) -> Path:
    return Path(shutil.copytree(HERE / TUNED, tmp_path / TUNED))


def bytes_of(directory: Path) -> dict[str, bytes]:
    files = sorted(directory.rglob("*"))
    return {str(f.relative_to(directory)): f.read_bytes() for f in files if f.is_file()}


def test_tuning_with_a_removed_search_is_not_continued_and_keeps_its_files(tuned: Path) -> None:
    study = history.load_tuned_study(tuned)
    (sobol,) = history.read_searches(tuned, SearchSpace.from_study(study))
    equal_cost = sobol._replace(search="equal cost")
    history.write_history(tuned, study, [sobol, equal_cost])
    before = bytes_of(tuned)
    with pytest.raises(InputError, match=r"'equal cost'.* removed .*report.*--overwrite"):
        sinsjax.tune(study, tuned, resume=True)
    kept = bytes_of(tuned)
    assert {name: kept[name] for name in before} == before


@pytest.mark.parametrize("search", ["random", "covariance"])
def test_tuning_by_a_removed_search_is_named_as_such(tuned: Path, search: str) -> None:
    text = (tuned / "study.toml").read_text().replace('"sobol",', f'"{search}",')
    (tuned / "study.toml").write_text(text)
    mark = {history._STUDY_MARK: text}
    rows = read_sealed_parquet(tuned / history.FILE)
    (tuned / history.FILE).write_bytes(to_sealed_parquet(rows, mark))
    assert history.is_tuning(tuned)
    with pytest.raises(InputError, match=rf"searches\[0\]: '{search}' {messages.GONE_MARK}"):
        history.load_tuned_study(tuned)
    assert len(sinsjax.read_history(tuned)) == len(rows)


def test_report_on_a_removed_trigger_is_refused_and_its_rows_are_read(tmp_path: Path) -> None:
    out = Path(shutil.copytree(HERE / "draws", tmp_path / "draws"))
    text = (out / "study.toml").read_text()
    changed = text.replace("[resets]\n", '[resets]\nreset_trigger = "nis"\n')
    (out / "study.toml").write_text(changed)
    with pytest.raises(InputError) as caught:
        Results.read(out)
    (line,) = caught.value.lines
    assert "'nis'" in line and messages.GONE_MARK in line
    assert len(sinsjax.read_summary(out))

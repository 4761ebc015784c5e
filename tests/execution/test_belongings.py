"""What in a directory of results was made here, and may go."""

from pathlib import Path

import pytest
from support.studies import small_study

import sinsjax
from sinsjax import cli
from sinsjax.errors import InputError
from sinsjax.execution.directory import list_figures, owned_files


def test_figure_list_ignores_outside_paths_and_malformed_content(tmp_path: Path) -> None:
    """Nor does one that is none."""
    out = tmp_path / "out"
    (out / "figures").mkdir(parents=True)
    (tmp_path / "mine.png").write_bytes(b"mine")
    list_figures({"../../mine.png": b"mine", "a.png": b"a"}, out)
    (out / "figures" / "a.png").write_bytes(b"a")
    listed = out / ".figures.json"
    assert owned_files(out) == [out / "figures" / "a.png", listed]
    list_figures({"b.png": b"b"}, out)
    assert owned_files(out) == [out / "figures" / "a.png", listed]
    for content in ("[]", "{", "3", "[" * 100_000):
        listed.write_text(content)
        assert owned_files(out) == [listed]


def test_empty_results_directory_name_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    config = tmp_path / "none.toml"
    for words in (
        ("run", config),
        ("sweep", config),
        ("align", "record.imu", config),
        ("tune", config),
        ("rerun", tmp_path, "--run-id", "0"),
    ):
        monkeypatch.setattr("sys.argv", ["sinsjax", *map(str, words), "-o", ""])
        with pytest.raises(SystemExit) as stop:
            cli.main()
        assert stop.value.code == 2
        line = "error: the results directory must not be empty (use '.' for the current one)\n"
        assert capsys.readouterr().err == line
    with pytest.raises(InputError, match="must not be empty"):
        sinsjax.run_into(small_study(), "")
    assert not list(tmp_path.iterdir())

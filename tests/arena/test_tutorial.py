"""The tutorial on other programs: its commands, its MATLAB and its C run as they are printed."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from support.commands import Command, command_line

import sinsjax
from sinsjax.arena.export import export_study
from sinsjax.arena.score import score_results
from sinsjax.study.study import Study

pytestmark = pytest.mark.optimised(False)

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "arena.md").read_text(encoding="utf-8")


def short_study() -> Study:
    """The study of the page, with two draws of 20 s and its first method."""
    tables = sinsjax.load_study("arena").to_dict()
    tables["study"] |= {"duration_s": 20.0, "window_s": [10.0, 20.0], "draws": 2}
    tables["study"]["report_times_s"] = [10.0]
    return sinsjax.study_from_dict(tables | {"cases": tables["cases"][:1]})


def block(language: str) -> str:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)[0]


@pytest.fixture
def draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return export_study(short_study(), tmp_path / "draws", format="psins")


@pytest.mark.slow
def test_commands_of_the_page_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command: Command = command_line(monkeypatch, capsys)
    monkeypatch.chdir(tmp_path)
    first, second = (line.split("#")[0].split() for line in block("sh").splitlines())
    assert command(*first[1:])[0] == 0
    code, told, _ = command(*second[1:], "--set", "study.duration_s=900")
    assert code == 0 and block("text").strip() in told
    assert {path.name for path in Path("draws").iterdir() if path.suffix} == {
        *("README.txt", "initial.csv", "truth.parquet", "study.toml", "export.json")
    }


@pytest.mark.skipif(shutil.which("octave-cli") is None, reason="needs Octave")
def test_matlab_loop_runs_in_octave_and_its_results_are_scored(draws: Path) -> None:
    Path("my_filter.m").write_text(
        "function att = my_filter(imu, att0, lat, g)\n att = att0;\nend\n"
    )
    Path("loop.m").write_text(block("matlab"))
    subprocess.run(["octave-cli", "--no-gui", "-q", "loop.m"], check=True, timeout=300)
    score = score_results(draws, "results.csv", name="nothing")
    rows = sinsjax.read_summary(score.directory).to_pandas()
    rows = rows[(rows["method"] == "nothing") & (rows["pitch_amplitude_deg"] == 0)]
    # It returns the attitude that it is given, so on a still base the error is that of the start.
    np.testing.assert_allclose(rows["phi_u_arcmin"] / 60, rows["phi_u0_deg"], atol=1e-6)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
def test_c_lines_read_a_record(draws: Path) -> None:
    program = f"""
#include <stdio.h>
static double sum[6], last;
static void step(const double *w, const double *v, double t) {{
    for (int i = 0; i < 3; i++) {{ sum[i] += w[i]; sum[3 + i] += v[i]; }}
    last = t;
}}
int main(void) {{
{block("c")}
    for (int i = 0; i < 6; i++) printf("%.17g ", sum[i]);
    printf("%.17g", last);
    return 0;
}}
"""
    Path("read.c").write_text(program)
    subprocess.run(["gcc", "-o", "read", "read.c"], check=True)
    told = subprocess.run(["./read"], check=True, capture_output=True, text=True).stdout
    record = sinsjax.simulated_record(short_study(), 0)
    sums = [*record.dtheta.sum(axis=0), *record.dv.sum(axis=0), 20.0]
    np.testing.assert_allclose([float(word) for word in told.split()], sums, rtol=1e-12, atol=1e-15)


@pytest.mark.slow
def test_numpy_filter_finds_north_and_is_scored(draws: Path) -> None:
    script = ROOT / "docs" / "studies" / "arena" / "numpy_filter.py"
    text = script.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 61 and "sinsjax" not in text.split('"""')[2]
    names: dict[str, object] = {"__name__": "filter"}
    exec(compile(text, str(script), "exec"), names)
    names["main"](draws, "results.csv")  # type: ignore[operator]
    score = score_results(draws, "results.csv", name="numpy filter")
    assert score.missing == [] and score.warnings == []
    rows = sinsjax.read_summary(score.directory).to_pandas()
    ours = rows[rows["method"] == "numpy filter"]["phi_u_arcmin"].to_numpy()
    own = rows[rows["case"] == "kalman5"]["phi_u_arcmin"].to_numpy()
    # The same filter and noise, but for the order of integration and feedback.
    np.testing.assert_allclose(ours, own, rtol=0.1)
    assert np.median(np.abs(ours)) < 1500  # from 30 and 80 deg, after 20 s

"""Reasons to refuse resuming: other keys, versions or instruction sets."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from support.stored_results import store_results
from support.studies import small_study
from support.sweep_directories import rewrite_manifest
from support.synthetic_tables import synthetic_summary

from sinsjax.errors import InputError
from sinsjax.execution import run, tasks
from sinsjax.execution.directory import read_manifest
from sinsjax.execution.results import Results
from sinsjax.methods import registry as methods
from sinsjax.platform import runtime, xla
from sinsjax.study.identity import describe_differences
from sinsjax.study.load import study_to_toml

pytestmark = pytest.mark.optimised(False)

ZIP = {"reset_count": [0, 1, 2], "reset_cycle_s": [1.0, 1.0, 2.0]}


@pytest.mark.parametrize(
    ("there", "here", "told"),
    [
        (
            {"axes": {"sched": ZIP}},
            {"axes": {"sched": ZIP | {"reset_cycle_s": [1.0, 1.0, 2.5]}}},
            ["[axes.sched] reset_cycle_s: [1.0, 1.0, 2.0] there, [1.0, 1.0, 2.5] here"],
        ),
        (
            {"cases": [{"p0_yaw_deg": 40.0}, {"p0_yaw_deg": 50.0}]},
            {"cases": [{"p0_yaw_deg": 40.0}, {"p0_yaw_deg": 60.0}]},
            ["[cases 1] p0_yaw_deg: 50.0 there, 60.0 here"],
        ),
        ({}, {"axes": {"p0_yaw_deg": [1.0]}}, ["[axes] p0_yaw_deg: none there, [1.0] here"]),
        (
            {"axes": {"p0_yaw_deg": [1.0], "phi_u0_deg": [2.0]}},
            {"axes": {"phi_u0_deg": [2.0], "p0_yaw_deg": [1.0]}},
            ["its keys are in another order"],
        ),
    ],
)
def test_differences_between_studies_name_changed_keys(
    there: dict[str, Any], here: dict[str, Any], told: list[str]
) -> None:
    assert describe_differences(small_study(**there), small_study(**here)) == told


@pytest.mark.parametrize("name", ["jaxlib", "scipy"])
def test_resume_with_other_package_version_is_refused(
    name: str, tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study, here = small_study(), runtime.relevant_versions()
    out = store_results(tmp_path / "out", study, synthetic_summary(study), versions=here)
    before = (out / "manifest.json").read_bytes()
    other = here | {name: "0.0"}
    monkeypatch.setattr(runtime, "relevant_versions", lambda: other)
    with pytest.raises(InputError, match=f"out: was computed with {name} .*, but here is 0.0"):
        run.run_into(study, out, resume=True)
    assert (out / "manifest.json").read_bytes() == before


def test_resume_with_other_version_of_method_package_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only where the study has that method; one that is not there is named where they are read."""
    study, out = small_study(), tmp_path / "out"
    here = runtime.relevant_versions()
    monkeypatch.setattr(runtime, "relevant_versions", lambda: here | {"bringing": "1.0"})
    run.run_into(study, out)
    run.run_into(study, out, resume=True)
    monkeypatch.setattr(runtime, "relevant_versions", lambda: here | {"bringing": "1.1"})
    monkeypatch.setitem(methods.PACKAGES, "kalman5", ("bringing", "1.1"))
    with pytest.raises(InputError, match=r"computed with bringing 1\.0, but here is 1\.1 \("):
        run.run_into(study, out, resume=True)
    assert Results.read(out).study == study
    text = (out / "study.toml").read_text()
    (out / "study.toml").write_text(text.replace("kalman5", "brought"))
    with pytest.raises(InputError) as caught:
        Results.read(out)
    line = f"{out}: was computed with bringing 1.0, not installed here, which may be why: "
    assert str(caught.value).startswith(line) and "not 'brought'" in str(caught.value)


@pytest.mark.nightly
def test_resume_with_other_instruction_set_is_refused(tmp_path: Path) -> None:
    """Made by another process, which XLA holds to a smaller set than this one has."""
    reachable = {"settle_bands_arcmin": [1200.0], "success_band_arcmin": 1200.0}
    study, out = small_study(study=reachable), tmp_path / "out"
    (tmp_path / "study.toml").write_text(study_to_toml(study))
    command = [sys.executable, "-m", "sinsjax", "sweep", tmp_path / "study.toml", "-o", out]

    def sweep(*words: str, **flags: str) -> tuple[int, str]:
        done = subprocess.run(
            [*command, *words], env=os.environ | flags, capture_output=True, text=True
        )
        return done.returncode, done.stderr

    smaller = {"XLA_FLAGS": "--xla_cpu_max_isa=SSE4_2"}
    assert sweep(**smaller) == (0, "")
    assert read_manifest(out)["instructions"] == "SSE4_2"
    before = (out / "manifest.json").read_bytes()
    here = xla.instruction_set()
    told = f"out: was computed with instruction set SSE4_2, but here is {here} .use.*max_isa=SSE4_2"
    with pytest.raises(InputError, match=told):
        run.run_into(study, out, resume=True)
    # Workers are asked, not the process that hands their rows on.
    theirs = tasks.local_executor()._replace(facts={"workers": 1, "instructions": "SSE4_2"})
    assert (out / "manifest.json").read_bytes() == before
    run.run_into(study, out, resume=True, executor=theirs)
    assert read_manifest(out)["instructions"] == "SSE4_2"


def test_resume_of_manifest_without_instruction_set_is_accepted(tmp_path: Path) -> None:
    """As one that names no version: it is older."""
    study, out = small_study(), tmp_path / "out"
    run.run_into(study, out)
    rewrite_manifest(out, instructions=None)
    run.run_into(study, out, resume=True)
    assert read_manifest(out)["instructions"] == xla.instruction_set()

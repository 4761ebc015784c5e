"""Resuming results: what is refused, and the extension by more draws."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.stored_results import store_results
from support.studies import small_study
from support.sweep_directories import (
    make_study,
    modification_times,
    read_files_and_times,
    rewrite_manifest,
)
from support.synthetic_tables import synthetic_summary

from sinsjax.errors import InputError
from sinsjax.execution import run, tasks
from sinsjax.execution.directory import read_manifest
from sinsjax.execution.results import read_summary
from sinsjax.methods import registry as methods
from sinsjax.platform import machine, runtime
from sinsjax.study.study import Study

pytestmark = pytest.mark.optimised(False)

SHORT = {"duration_s": 2.0, "window_s": [0, 2]}
AXES = {"p0_yaw_deg": [10.0, 40.0, 60.0]}


def study_with_draws(draws: int, **tables: Any) -> Study:
    tables = {"axes": AXES} | tables
    return small_study(**{**tables, "study": SHORT | tables.get("study", {}) | {"draws": draws}})


@pytest.mark.parametrize(
    ("there", "here", "told"),
    [
        (
            study_with_draws(80),
            study_with_draws(79),
            "[study] draws: 80 there, 79 here",
        ),
        (
            study_with_draws(80),
            study_with_draws(90, filter={"p0_level_deg": 14.0}),
            "[filter] p0_level_deg: 15.0 there, 14.0 here; [study] draws: 80 there, 90 here",
        ),
        (
            small_study(axes={"p0_yaw_deg": [10.0], "phi_u0_deg": [2.0]}),
            small_study(axes={"phi_u0_deg": [2.0], "p0_yaw_deg": [10.0]}),
            "the order of its keys",
        ),
    ],
)
def test_invalid_extension_is_refused_without_changes(
    there: Study, here: Study, told: str, tmp_path: Path
) -> None:
    out = store_results(tmp_path / "out", there, synthetic_summary(there))
    before = read_files_and_times(out)
    with pytest.raises(InputError) as caught:
        run.run_into(here, out, resume=True)
    assert told in str(caught.value) and "\n" not in str(caught.value)
    assert read_files_and_times(out) == before


def test_resume_with_other_version_or_instruction_set_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A package with methods counts only where the study has one of them."""
    study, out = small_study(), tmp_path / "out"
    here = runtime.relevant_versions() | {"bringing": "1.0"}
    monkeypatch.setattr(runtime, "relevant_versions", lambda: here)
    run.run_into(study, out)
    before = read_files_and_times(out)
    for versions, line in (
        ({"scipy": "0.0"}, r"with scipy .*, but here is 0\.0"),
        ({"bringing": "1.1"}, r"with bringing 1\.0, but here is 1\.1 \("),
    ):
        monkeypatch.setattr(runtime, "relevant_versions", lambda found=here | versions: found)
        with monkeypatch.context() as patch, pytest.raises(InputError, match=line):
            patch.setitem(methods.PACKAGES, "kalman5", ("bringing", "1.1"))
            run.run_into(study, out, resume=True)
    # Workers are asked, not the process that hands their rows on.
    theirs = tasks.local_executor()._replace(facts={"instructions": "VAX"})
    with pytest.raises(InputError, match="instruction set .*, but here is VAX .*xla_cpu_max_isa"):
        run.run_into(study, out, resume=True, executor=theirs)
    assert read_files_and_times(out) == before
    rewrite_manifest(out, instructions=None)  # as of an older version
    run.run_into(study, out, resume=True)
    assert read_manifest(out)["instructions"] == machine.instruction_set()


RULE = {"statistic": "success_rate", "half_width": 0.9}
MANY = {"method": ["compass", "kalman5"], "q_accel_ug": [1.0 * i for i in range(1, 40)]}
EXTENDED: dict[str, Callable[[bool], Study]] = {
    "drawn": lambda more: make_study("drawn", 140 if more else 100),
    "duplicates": lambda more: study_with_draws(300 if more else 20, axes=MANY),
    "stopped": lambda more: study_with_draws(140 if more else 80, stop_when=RULE),
}
"""Sobol points, a list and a grid that are cycled; equal variants; a stop at 64 draws."""


@pytest.mark.nightly
@pytest.mark.parametrize("kind", EXTENDED)
def test_extension_equals_all_draws_at_once(tmp_path: Path, kind: str) -> None:
    out = tmp_path / "out"
    run.run_into(EXTENDED[kind](False), out)
    before = modification_times(out)
    run.run_into(EXTENDED[kind](True), out, resume=True)
    assert before and before.items() <= modification_times(out).items()
    assert read_manifest(out)["extended_at"] == [EXTENDED[kind](False).n_draws]
    whole = run.run(EXTENDED[kind](True)).summary
    assert read_summary(out).equals(whole.cast(read_summary(out).schema))

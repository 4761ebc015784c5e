"""Any study, manifest or record is accepted or rejected in one line.

`python benchmarks/fuzz.py --minutes N` hunts for longer, and looks at time and memory too.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fuzzing import manifests
from fuzzing.targets import Target, check_error_lines, limit_time, make_targets
from hypothesis import HealthCheck, Phase, given, settings
from support.sweep_directories import rewrite_manifest

from sinsjax.errors import InputError
from sinsjax.execution import resume
from sinsjax.execution.results import Results
from sinsjax.execution.tasks import Job

EXAMPLES = {"studies": 1000, "manifests": 500, "records": 1000}
LATE_S = 60
"""Limit for hanging cases only; a case may take two seconds on an idle machine."""


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Target]]:
    yield {target.name: target for target in make_targets(tmp_path_factory.mktemp("fuzz"))}


@pytest.mark.nightly
@pytest.mark.parametrize("name", EXAMPLES)
def test_fuzzed_input_is_accepted_or_refused_in_one_line(name: str, found: dict[str, Target]):
    target = found[name]

    @settings(
        max_examples=EXAMPLES[name],
        derandomize=True,
        deadline=None,
        database=None,
        phases=[Phase.generate, Phase.shrink],
        suppress_health_check=list(HealthCheck),
    )
    @given(target.cases)
    def check(case: object) -> None:
        with limit_time(LATE_S):
            target.check(case)

    check()


# What hunts have found


def directory_with(manifest: dict[str, Any], folder: Path) -> Path:
    """Results with some entries of the manifest replaced."""
    manifests.write_results(folder)
    rewrite_manifest(folder, **manifest)
    return folder


@pytest.mark.parametrize("warnings", [1, {"a": 1}, "text"])
def test_manifest_warnings_of_wrong_type_are_refused_in_one_line(warnings: Any, tmp_path: Path):
    out = directory_with({"warnings": warnings}, tmp_path)
    with pytest.raises(InputError, match=r"manifest.json: warnings\S*: ") as caught:
        Results.read(out)
    check_error_lines(caught.value, out)


@pytest.mark.parametrize(
    "sections",
    [
        {"study": 0, "zips": {"pair": 3}, "cases": [4]},
        {"drawn": 6, "alignment": ["a"]},
        {"alignment": {f"\x1b[31m{i}": i for i in range(500)}},
    ],
)
def test_misfit_study_in_manifest_is_refused_in_one_line(sections: Any, tmp_path: Path):
    out = directory_with({"study": sections, "fingerprint": "0"}, tmp_path)
    with pytest.raises(InputError, match="study.toml: is not the study of the results") as caught:
        Results.read(out)
    check_error_lines(caught.value, out)


@pytest.mark.parametrize("text", ["[" * 5000, "\x1b[31m", "1\n2"])
@pytest.mark.parametrize("key", ["versions", "instructions"])
def test_version_mismatch_is_reported_in_one_printable_line(key: str, text: str, tmp_path: Path):
    out = directory_with({key: {"numpy": text} if key == "versions" else text}, tmp_path)
    with pytest.raises(InputError, match="was computed with (numpy|instruction set)") as caught:
        resume.continue_job(Job(manifests.STUDY, directory=out))
        resume.check_instruction_set(out, "AVX2")
    assert len(check_error_lines(caught.value, out)) < 1000

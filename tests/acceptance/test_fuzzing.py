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
from sinsjax.execution import store
from sinsjax.execution.results import Results
from sinsjax.execution.tasks import Job
from sinsjax.platform import runtime

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


@pytest.mark.parametrize(
    ("entries", "line"),
    [
        ({"warnings": {"a": 1}}, r"manifest.json: warnings\S*: "),
        ({"study": {"study": 0, "cases": [4]}, "fingerprint": "0"}, "study.toml: is not the study"),
    ],
)
def test_misfit_entry_of_manifest_is_refused_in_one_line(
    entries: dict[str, Any], line: str, tmp_path: Path
):
    out = directory_with(entries, tmp_path)
    with pytest.raises(InputError, match=line) as caught:
        Results.read(out)
    check_error_lines(caught.value, out)


@pytest.mark.parametrize("text", ["[" * 5000, "\x1b[31m", "1\n2"])
@pytest.mark.parametrize("key", ["versions", "instructions"])
def test_version_mismatch_is_reported_in_one_printable_line(key: str, text: str, tmp_path: Path):
    out = directory_with({key: {"numpy": text} if key == "versions" else text}, tmp_path)
    job = Job(manifests.STUDY, directory=out, resume=True)
    with (
        pytest.raises(InputError, match="was computed with (numpy|instruction set)") as caught,
        store.open_store(store.continue_job(job), runtime.describe_environment()),
    ):
        pass
    assert len(check_error_lines(caught.value, out)) < 1000

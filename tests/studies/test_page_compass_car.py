"""The compass on a real record, as the page of it says."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from docs.studies.compass_map import car as compass_cases
from sinsjax.analysis import rms
from sinsjax.execution import prepare
from sinsjax.execution import run as study_run
from sinsjax.execution.source import Source
from sinsjax.study.load import study_from_dict

CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.fixture(scope="module")
def data():
    return tomllib.loads((CONFIGS / "compass_car.toml").read_text())


def study_of(data, *names, **changes):
    """The shipped study with some of its cases, and sections replaced."""
    cases = [case for case in data["cases"] if case["case"] in names] if names else data["cases"]
    return study_from_dict(data | {"cases": cases} | changes)


@pytest.mark.nightly
@pytest.mark.optimised(False)
def test_reflected_compass_matches_kalman_filter_on_real_record(data, data_dir, tmp_path):
    """On a base that sways, 7 passes over 80 s end as well as a filter does."""
    hasty, careful, flipped, kalman = (
        "80 s tape, reflected, delay 2 s",
        "80 s tape, reflected",
        "80 s tape, V flipped",
        "Kalman, 80 s",
    )
    record = data["record"] | {"start_s": [0, 40, 80, 120, 180]}
    study = study_of(data, hasty, careful, flipped, kalman, record=record)
    files = (data_dir / f"lasergyro_0_900{end}" for end in (".imu", "_reference.csv"))
    study_run.run_into(study, tmp_path, prepare.load_increments(study, *files))
    source = Source.read(tmp_path)
    cases = compass_cases.cases_of(source)
    errors = {case.name: case.errors for case in cases}
    size = {name: rms(values).value for name, values in errors.items()}
    assert size[kalman] < 5 and size[careful] < 5 and size[flipped] < 7 < size[hasty]
    assert np.corrcoef(errors[careful], errors[kalman])[0, 1] > 0.9

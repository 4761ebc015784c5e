"""The report on a recorded compass study, on results that no engine made but where it says so."""

import tomllib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from docs.studies.compass_map import car as compass_cases
from sinsjax.analysis import rms
from sinsjax.execution import prepare
from sinsjax.execution import run as study_run
from sinsjax.execution.source import Source
from sinsjax.study.load import load_study, study_from_dict

CONFIGS = Path(__file__).parents[2] / "configs"
SCHEDULE = (
    "turn_smoothing_s",
    "level_sigma_per_s",
    "level_time_s",
    "azimuth_sigma_per_s",
    "sigma_factors",
    "sigma_times_s",
)


@pytest.fixture(scope="module")
def data():
    return tomllib.loads((CONFIGS / "compass_car.toml").read_text())


def study_of(data, *names, **changes):
    """The shipped study with some of its cases, and sections replaced."""
    cases = [case for case in data["cases"] if case["case"] in names] if names else data["cases"]
    return study_from_dict(data | {"cases": cases} | changes)


SMALL = (
    "80 s, one pass",
    "80 s tape, reflected",
    "80 s tape, V flipped",
    "80 s tape, reflected, delay 2 s",
    "Kalman, 80 s",
    "Kalman, 80 s tape, 7 passes",
)


def errors_of(study, seed=1):
    """Heading errors (starts, variants), arcmin: the data's own, and a little of each variant."""
    random = np.random.default_rng(seed)
    shape = (study.n_draws, study.n_variants)
    return 3 * random.normal(size=(shape[0], 1)) + 0.1 * random.normal(size=shape)


def source_of(study, errors):
    """Results that no engine made: heading errors (starts, variants), arcmin."""
    runs = np.arange(errors.size)
    methods = [study.values("method")[variant] for variant in runs % study.n_variants]
    sigma = [None if method == "compass" else 20.0 for method in methods]
    summary = {
        "draw_id": runs // study.n_variants,
        "phi_u_arcmin": errors.ravel(),
        "sigma_u_arcmin": pa.array(sigma, pa.float64()),
    }
    return Source(Path("results"), study, "car.toml", pa.table(summary))


# --- the shipped study --------------------------------------------------------------------------


def test_stored_passes_end_forward_and_fit_within_record():
    study = load_study(CONFIGS / "compass_car.toml")
    spans = study.spans
    assert all(span.records % span.pass_records == 0 for span in spans)
    assert all(span.records // span.pass_records % 2 == 1 for span in spans)
    longest = max(span.pass_records for span in spans)
    assert max(study.record.start_s) + study.coarse.coarse_duration_s + longest == 900
    assert np.diff(study.record.start_s).tolist() == [20.0] * 12


def test_shipped_schedule_equals_tuned_best_schedule(data):
    found = load_study(CONFIGS / "compass_80s_best.toml")
    (best,) = (c for c in found.cases if c["case"].startswith("80 s tape, best"))
    loaded = load_study(CONFIGS / "compass_car.toml").cases
    stored = [c for c in loaded if c["method"] == "compass" and "paper" not in c["case"]]
    for key in SCHEDULE:
        values = {c[key] for c in stored if "delay" not in c["case"]}
        assert values == {best[key]}, key
    assert {c["turn_smoothing_s"] for c in stored} == {2.0, 5.0, 10.0, 20.0, 50.0, 100.0}


# --- cases --------------------------------------------------------------------------------------


def test_cases_are_classified_by_study_keys(data):
    study = study_of(data, *SMALL)
    errors = errors_of(study)
    cases = compass_cases.cases_of(source_of(study, errors))
    assert [case.name for case in cases] == list(SMALL)
    once, reflected, flipped, by_2, kalman, kalman_7 = cases
    assert [(c.data_s, c.passes) for c in cases] == [(80.0, n) for n in (1, 7, 7, 7, 1, 7)]
    assert [c.turn for c in cases] == ["", "reflect", "velocity", "reflect", "", ""]
    assert [c.kind for c in (once, flipped, kalman)] == [
        "compass, one pass",
        "compass, paper's turn",
        "Kalman filter",
    ]
    np.testing.assert_array_equal(reflected.errors, errors[:, 1])
    assert reflected.rms == pytest.approx(np.sqrt(np.mean(errors[:, 1] ** 2)))
    assert np.isnan(reflected.sigma).all() and (kalman_7.sigma == 20.0).all()
    assert compass_cases.partner(cases, flipped) is kalman
    assert compass_cases.partner(cases, kalman_7) is kalman
    assert compass_cases.first_of_kinds(cases) == [once, reflected, flipped, kalman, kalman_7]


# --- the real record ----------------------------------------------------------------------------


@pytest.mark.slow
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

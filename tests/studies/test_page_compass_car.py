"""The report on a recorded compass study, on results that no engine made but where it says so."""

import tomllib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from scipy.integrate import solve_ivp

from docs.studies.compass_car import cases as compass_cases
from docs.studies.compass_car import transients as reversal_transients
from docs.studies.loops.linear import loops_of
from sinsjax.alignment.compass import design as loops
from sinsjax.analysis import rms
from sinsjax.execution import run as study_run
from sinsjax.plots import Ensemble
from sinsjax.report.base import Source
from sinsjax.study.load import load_study, one_variant, study_from_dict

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


def test_stored_tapes_end_forward_and_no_run_is_longer_than_the_record():
    study = load_study(CONFIGS / "compass_car.toml")
    spans = study.spans
    assert all(span.records % span.pass_records == 0 for span in spans)
    assert all(span.records // span.pass_records % 2 == 1 for span in spans)
    longest = max(span.pass_records for span in spans)
    assert max(study.record.start_s) + study.coarse.coarse_duration_s + longest == 900
    assert np.diff(study.record.start_s).tolist() == [20.0] * 12


def test_the_best_schedule_is_the_one_that_was_found(data):
    found = load_study(CONFIGS / "compass_80s_best.toml")
    (best,) = (c for c in found.cases if c["case"].startswith("80 s tape, best"))
    loaded = load_study(CONFIGS / "compass_car.toml").cases
    stored = [c for c in loaded if c["method"] == "compass" and "paper" not in c["case"]]
    for key in SCHEDULE:
        values = {c[key] for c in stored if "delay" not in c["case"]}
        assert values == {best[key]}, key
    assert {c["turn_smoothing_s"] for c in stored} == {2.0, 5.0, 10.0, 20.0, 50.0, 100.0}


# --- cases --------------------------------------------------------------------------------------


def test_a_case_is_known_by_its_keys(data):
    study = study_of(data, *SMALL)
    errors = errors_of(study)
    cases = compass_cases.cases_of(source_of(study, errors))
    assert [case.name for case in cases] == list(SMALL)
    once, reflected, flipped, by_2, kalman, kalman_7 = cases
    assert [(c.data_s, c.passes) for c in cases] == [(80.0, n) for n in (1, 7, 7, 7, 1, 7)]
    assert [c.turn for c in cases] == ["", "reflect", "velocity", "reflect", "", ""]
    assert [c.kind for c in (once, flipped, kalman)] == [
        "compass, one pass",
        "compass, velocity flipped",
        "Kalman",
    ]
    np.testing.assert_array_equal(reflected.errors, errors[:, 1])
    assert reflected.rms == pytest.approx(np.sqrt(np.mean(errors[:, 1] ** 2)))
    assert np.isnan(reflected.sigma).all() and (kalman_7.sigma == 20.0).all()
    assert compass_cases.partner(cases, flipped) is kalman
    assert compass_cases.partner(cases, kalman_7) is kalman
    assert compass_cases.first_of_kinds(cases) == [once, reflected, flipped, kalman, kalman_7]


# --- kicks --------------------------------------------------------------------------------------


def model_of(data, **changes):
    reflected, kalman = (c for c in data["cases"] if c["case"] in (SMALL[1], SMALL[4]))
    cases = [reflected | changes, kalman]
    return loops_of(one_variant(study_from_dict(data | {"cases": cases}), 0))


def test_turns_count_once_the_azimuth_loop_is_at_work(data):
    model = model_of(data)
    assert reversal_transients.turn_times(model, 560.0).tolist() == [
        80.0,
        160.0,
        240.0,
        320.0,
        400.0,
        480.0,
    ]
    assert reversal_transients.turn_times(model, 560.5)[-1] == 560.0
    later = model_of(data, level_time_s=200.0)
    assert reversal_transients.turn_times(later, 560.0).tolist() == [240.0, 320.0, 400.0, 480.0]


def test_with_one_sigma_a_kick_grows_as_in_one_forward_pass(data):
    """Exact reflections make the passes one; the reversed ones only see the tilt's other sign."""
    model = model_of(data, sigma_factors=[1.0], sigma_times_s=[])
    matrix = loops.azimuth_matrix(model.params.azimuth, rate_n=model.rate_n, **model.earth)
    for turn, sign in ((80.0, -1), (160.0, 1), (480.0, 1)):
        values, vectors = np.linalg.eig(matrix)
        flow = (vectors * np.exp(values * (560.0 - turn))) @ np.linalg.inv(vectors)
        # Double roots: eigenvectors are known to half of the digits.
        assert reversal_transients.heading_at_end(model, turn, 560.0) == pytest.approx(
            sign * flow[2, 1].real, rel=1e-4
        )


def test_a_kick_follows_the_equations_of_the_paper(data):
    """[P2] Fig. 2 written out and integrated, with a schedule and the turns."""
    model = model_of(data, azimuth_sigma_per_s=0.025, sigma_times_s=[100.0, 150.0])
    gravity, radius = model.earth["gravity"], model.earth["radius"]

    def slope(time, state):
        v, phi_e, phi_u, w = state
        sigma = 0.025 * (4.0 if time < 100 else 2.0 if time < 150 else 1.0)
        rate = model.rate_n * (1 if time // 80 % 2 == 0 else -1)
        k1 = k4 = 2 * sigma
        stiffness = 4 * sigma**2 / gravity  # (1 + K2)/R of eq. (23)
        k3 = 4 * sigma**4 / gravity
        return [gravity * phi_e - k1 * v, -stiffness * v - rate * phi_u, w, k3 / rate * v - k4 * w]

    assert radius == pytest.approx(6.36e6, rel=1e-2)
    for turn in (80.0, 400.0):
        state = np.array([0.0, 1.0, 0.0, 0.0])
        edges = sorted(
            {turn, *(t for t in (100.0, 150.0) if t > turn)} | {*np.arange(turn, 561, 80)}
        )
        for since, until in zip(edges, edges[1:], strict=False):
            if since > turn and since % 80 == 0:
                state = state * [-1, -1, 1, 1]
            span = (since + 1e-9, until - 1e-9)
            state = solve_ivp(slope, span, state, rtol=1e-9, atol=1e-12).y[:, -1]
        assert reversal_transients.heading_at_end(model, turn, 560.0) == pytest.approx(
            state[2], rel=1e-4
        )


def test_kicks_are_what_an_exact_reflection_does_not_explain(data):
    model = model_of(data)
    time = np.arange(1.0, 561.0)
    tilt = np.zeros((2, 560))
    tilt[0, 159:161] = 0.3, -0.3  # reflected
    tilt[1, 479:481] = 0.2, 0.1  # a kick of 0.3 where -0.2 should be
    lines = Ensemble("x", time, {"phi_e_arcmin": tilt})
    found = reversal_transients.transients_of(model, lines)
    np.testing.assert_allclose(found, [[0] * 6, [0, 0, 0, 0, 0, 0.3]], atol=1e-12)
    heading = reversal_transients.heading_of_kicks(model, lines)
    last = reversal_transients.heading_at_end(model, 480.0, 560.0)
    np.testing.assert_allclose(heading, [0, 0.3 * last], atol=1e-9)
    assert last > 100  # arcmin an arcmin


# --- the real record ----------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.optimised(False)
def test_tilt_at_the_turns_explains_the_heading_on_the_real_record(data, data_dir, tmp_path):
    """On a base that sways, 7 passes over 80 s end as well as a filter does, if turned with care.

    Whatever the turn, the heading without what its kicks do is the same.
    """
    hasty, careful, flipped, kalman = (
        "80 s tape, reflected, delay 2 s",
        "80 s tape, reflected",
        "80 s tape, V flipped",
        "Kalman, 80 s",
    )
    record = data["record"] | {"start_s": [0, 40, 80, 120, 180]}
    study = study_of(data, hasty, careful, flipped, kalman, record=record)
    files = (data_dir / f"lasergyro_0_900{end}" for end in (".imu", "_reference.csv"))
    study_run.run_into(study, tmp_path, study_run.load_tape(study, *files), curves=True)
    source = Source.read(tmp_path)
    cases = compass_cases.cases_of(source)
    errors = {case.name: case.errors for case in cases}
    size = {name: rms(values).value for name, values in errors.items()}
    assert size[kalman] < 5 and size[careful] < 5 and size[flipped] < 7 < size[hasty]
    assert np.corrcoef(errors[careful], errors[kalman])[0, 1] > 0.9
    rest = reversal_transients.without_kicks(source, cases)
    assert list(rest) == [careful, flipped, hasty]
    for name in (flipped, hasty):
        assert np.abs(rest[name] - rest[careful]).max() < 0.1  # arcmin
    assert rms(errors[hasty] - rest[hasty]).value > 7

"""What a study may not have whose variants are estimated by covariance."""

from typing import Any

import pytest
from support.studies import refusal, small_study, small_tables

from sinsjax.alignment.base import Options
from sinsjax.alignment.methods import METHODS
from sinsjax.errors import InputError
from sinsjax.study.fingerprint import fingerprint
from sinsjax.study.load import study_from_dict, tables_of

ESTIMATED = {"estimate": "covariance", "draws": None}
COLOURED = "its noise is not white"
WHY: dict[str, tuple[dict[str, Any], str]] = {
    "[motion] vibration_ug_rms": ({"motion": {"vibration_ug_rms": 10.0}}, COLOURED),
    "[motion] vibration_deg_per_h_rms": (
        {"motion": {"vibration_deg_per_h_rms": [0.0, 1.0, 0.0]}},
        COLOURED,
    ),
    "[motion] surge_m_per_s": ({"motion": {"surge_m_per_s": 0.1}}, COLOURED),
    "[axes] surge_m_per_s": ({"axes": {"surge_m_per_s": [0.0, 0.1]}}, COLOURED),
    "[sensors] gyro_instability_deg_per_h": (
        {"sensors": {"gyro_instability_deg_per_h": 0.01}},
        COLOURED,
    ),
    "[sensors] accel_instability_ug": ({"sensors": {"accel_instability_ug": 9.0}}, COLOURED),
    "[sensors] gyro_rrw_deg_per_h_per_sqrt_h": (
        {"sensors": {"gyro_rrw_deg_per_h_per_sqrt_h": 0.1}},
        COLOURED,
    ),
    "[sensors] accel_rrw_ug_per_sqrt_h": (
        {"sensors": {"accel_rrw_ug_per_sqrt_h": 1.0}},
        COLOURED,
    ),
    "[sensors] gyro_quantisation_arcsec": (
        {"sensors": {"gyro_quantisation_arcsec": 1.0}},
        "quanta are no noise",
    ),
    "[sensors] accel_quantisation_um_per_s": (
        {"sensors": {"accel_quantisation_um_per_s": 1.0}},
        "quanta are no noise",
    ),
    "[alignment] method": (
        {"alignment": {"method": "compass"}},
        "'compass' does not tell its linear part",
    ),
    "[axes] method": (
        {"axes": {"method": ["kalman5", "optimisation"]}},
        "'optimisation' does not tell its linear part",
    ),
    "[cases] method": (
        {"cases": [{"method": "kalman5"}, {"method": "inertial"}]},
        "'inertial' does not tell its linear part",
    ),
    "[resets] reset_trigger": (
        {"resets": {"reset_trigger": "nis", "trigger_threshold": 5.0}},
        "triggered resets move with the noise",
    ),
    "[coarse]": (
        {"coarse": {"coarse_method": "inertial", "coarse_duration_s": 2.0}},
        "its methods do not tell their linear part",
    ),
    "[passes]": ({"passes": {"tape_s": 2.0}}, "repeated passes use the same noise again"),
    "[drawn]": (
        {"drawn": {"vn0_m_per_s": {"normal": [0, 1]}}},
        "what is drawn differs between draws, of which there are none",
    ),
    "[stop_when]": (
        {"stop_when": {"statistic": "success_rate", "half_width": 0.1}},
        "there are no draws to stop",
    ),
    "[study] curves": (
        {"study": {"curves": True}},
        "there are no runs whose curves could be kept",
    ),
}


@pytest.mark.parametrize("place", WHY)
def test_what_the_covariance_does_not_hold_is_refused_with_the_reason(place: str) -> None:
    changes, why = WHY[place]
    small_study(**changes)  # with draws it runs
    changes = changes | {"study": ESTIMATED | changes.get("study", {})}
    told = f"{place}: does not go with estimate = 'covariance': {why}"
    assert refusal(**changes) == told


def test_searches_are_refused() -> None:
    tune = {
        "objective": "mean_settling_time",
        "variables": {"p0_yaw_deg": {"low": 10.0, "high": 90.0}},
        "baseline": {"p0_yaw_deg": 80.0},
        "searches": ["sobol"],
    }
    assert refusal(study=ESTIMATED, tune=tune).startswith("[tune]")


def test_recorded_data_are_refused() -> None:
    recorded = small_tables(study=ESTIMATED)
    del recorded["motion"], recorded["sensors"]
    recorded["record"] = {"format": "psins", "start_s": [0.0]}
    with pytest.raises(InputError) as caught:
        study_from_dict(recorded)
    assert str(caught.value) == (
        "study: [record]: does not go with estimate = 'covariance': the noise of recorded data is"
        " not known"
    )


def test_draws_and_samples_are_for_one_kind_of_estimate_each() -> None:
    told = "[study] draws: is not read beside estimate = 'covariance' (estimate_samples is)"
    assert refusal(study={"estimate": "covariance"}) == told
    told = "[study] estimate_samples: requires estimate = 'covariance'"
    assert refusal(study={"estimate_samples": 64}) == told
    assert "estimate_samples: must be" in refusal(study=ESTIMATED | {"estimate_samples": 65})


def test_defaults_are_written_out_and_read_again() -> None:
    study = small_study(study=ESTIMATED)
    assert (study.study.estimate_samples, study.study.draws, study.n_draws) == (256, None, 1)
    assert study_from_dict(tables_of(study), study.name) == study
    assert small_study().study.estimate_samples is None


def test_a_study_of_draws_keeps_its_fingerprint() -> None:
    plain = fingerprint(small_study())
    assert fingerprint(small_study(study={"estimate": "draws"})) == plain
    estimated = [ESTIMATED, ESTIMATED | {"estimate_samples": 64}]
    found = {fingerprint(small_study(study=keys)) for keys in estimated}
    assert len({plain, *found}) == 3


@pytest.mark.parametrize("name", METHODS)
def test_a_description_says_whether_steps_tell_their_linear_part(name: str) -> None:
    method = METHODS[name](Options(0.01))
    assert METHODS[name].has_error_step == (method.error_step is not None)

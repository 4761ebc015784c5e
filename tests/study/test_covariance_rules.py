"""Settings that conflict with covariance estimates."""

from typing import Any

import pytest
from support.studies import refusal_line, small_study, small_tables

from sinsjax.errors import InputError
from sinsjax.methods.base import Options
from sinsjax.methods.registry import METHODS
from sinsjax.study.identity import fingerprint
from sinsjax.study.load import study_from_dict, study_to_tables

ESTIMATED = {"estimate": "covariance", "draws": None}
COLOURED = "does not model vibration or quantisation"
WHY: dict[str, tuple[dict[str, Any], str]] = {
    "[motion] vibration_ug_rms": ({"motion": {"vibration_ug_rms": 10.0}}, COLOURED),
    "[motion] vibration_deg_per_h_rms": (
        {"motion": {"vibration_deg_per_h_rms": [0.0, 1.0, 0.0]}},
        COLOURED,
    ),
    "[sensors] gyro_quantisation_arcsec": (
        {"sensors": {"gyro_quantisation_arcsec": 1.0}},
        COLOURED,
    ),
    "[sensors] accel_quantisation_um_per_s": (
        {"sensors": {"accel_quantisation_um_per_s": 1.0}},
        COLOURED,
    ),
    "[alignment] method": (
        {"alignment": {"method": "inertial"}},
        "has no linear model of inertial",
    ),
    "[axes] method": (
        {"axes": {"method": ["kalman5", "inertial"]}},
        "has no linear model of inertial",
    ),
    "[cases] method": (
        {"cases": [{"method": "compass"}, {"method": "inertial"}]},
        "has no linear model of inertial",
    ),
    "[resets] reset_trigger": (
        {"resets": {"reset_trigger": "nis", "trigger_threshold": 5.0}},
        "needs resets at given times",
    ),
    "[coarse]": (
        {"coarse": {"coarse_method": "inertial", "coarse_duration_s": 2.0}},
        "starts from the method's P0",
    ),
    "[passes]": (
        {"passes": {"stored_s": 2.0}},
        "assumes new white noise, which repeated passes lack",
    ),
    "[drawn] gyro_scale_ppm": (
        {"drawn": {"gyro_scale_ppm": {"normal": [0, 1]}}},
        "needs a fixed value (sweep it instead)",
    ),
    "[drawn] vn0_m_per_s": (
        {"drawn": {"vn0_m_per_s": {"uniform": [-1, 1]}}},
        "needs a normal distribution",
    ),
}


@pytest.mark.parametrize("place", WHY)
def test_covariance_estimate_refuses_unsupported_settings_with_reason(place: str) -> None:
    changes, why = WHY[place]
    small_study(**changes)  # with draws it runs
    changes = changes | {"study": ESTIMATED | changes.get("study", {})}
    told = f"{place}: covariance analysis {why} (use estimate = 'draws')"
    assert refusal_line(**changes) == told


def test_covariance_search_without_linear_part_is_refused_at_load() -> None:
    tune = {
        "searches": ["sobol", "covariance"],
        "variables": {"phi_u0_deg": {"low": 1.0, "high": 9.0}},
    }
    assert refusal_line(alignment={"method": "inertial"}, tune=tune) == (
        "[tune] searches: 'covariance' does not apply to this study (use 'sobol'): [alignment]"
        " method: covariance analysis has no linear model of inertial"
    )


UNREAD: dict[str, tuple[dict[str, Any], str]] = {
    "[study] curves": ({"study": {"curves": True}}, "drop it: there are no runs"),
    "[stop_when]": (
        {"stop_when": {"statistic": "success_rate", "half_width": 0.1}},
        "drop it: there are no draws",
    ),
    "[tune]": (
        {
            "tune": {
                "objective": "settle_mean",
                "variables": {"p0_yaw_deg": {"low": 10.0, "high": 90.0}},
                "baseline": {"p0_yaw_deg": 80.0},
                "searches": ["sobol"],
            }
        },
        "use estimate = 'draws', and 'covariance' in searches",
    ),
}


@pytest.mark.parametrize("place", UNREAD)
def test_covariance_estimate_refuses_settings_that_need_draws(place: str) -> None:
    changes, why = UNREAD[place]
    changes = changes | {"study": ESTIMATED | changes.get("study", {})}
    told = f"{place}: does not apply to estimate = 'covariance' ({why})"
    assert refusal_line(**changes) == told


def test_covariance_estimate_refuses_recorded_data() -> None:
    recorded = small_tables(study=ESTIMATED)
    del recorded["motion"], recorded["sensors"]
    recorded["record"] = {"format": "psins", "start_s": [0.0]}
    with pytest.raises(InputError) as caught:
        study_from_dict(recorded)
    assert str(caught.value) == (
        "study: [record]: covariance analysis needs simulated sensors (use estimate = 'draws')"
    )


def test_estimate_samples_must_be_even_and_require_estimate() -> None:
    told = "[study] estimate_samples: requires estimate = 'covariance'"
    assert refusal_line(study={"estimate_samples": 64}) == told
    told = "[study] check_linearity: requires estimate = 'covariance'"
    assert refusal_line(study={"check_linearity": True}) == told
    assert "estimate_samples: must be" in refusal_line(study=ESTIMATED | {"estimate_samples": 65})


def test_controlled_estimate_is_refused_with_its_replacements() -> None:
    told = "[study] estimate: 'controlled' was dropped (leave the key out for Monte Carlo, or use"
    assert refusal_line(study={"estimate": "controlled"}) == f"{told} 'covariance')"


def test_estimates_accept_normally_drawn_starts_and_biases() -> None:
    laws = {"vn0_m_per_s": {"normal": [0, 1]}, "accel_bias_ug": {"normal": [0, 100]}}
    small_study(study=ESTIMATED, sensors={"accel_bias_ug": None}, drawn=laws)


def test_estimate_defaults_survive_round_trip() -> None:
    study = small_study(study=ESTIMATED)
    assert (study.study.estimate_samples, study.study.draws, study.n_draws) == (256, 64, 1)
    assert study.checks_linearity
    assert study_from_dict(study_to_tables(study), study.name) == study
    assert small_study().study.estimate_samples is None


def test_fingerprint_changes_with_covariance_estimate_but_not_with_draws() -> None:
    plain = fingerprint(small_study())
    assert fingerprint(small_study(study={"estimate": "draws"})) == plain
    estimated = [ESTIMATED, ESTIMATED | {"estimate_samples": 64}]
    found = {fingerprint(small_study(study=keys)) for keys in estimated}
    assert len({plain, *found}) == 3


@pytest.mark.parametrize("name", METHODS)
def test_has_error_model_flag_matches_method(name: str) -> None:
    method = METHODS[name](Options(0.01))
    assert METHODS[name].has_error_model == (method.error_model is not None)

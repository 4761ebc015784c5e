"""Settings that conflict with covariance estimates."""

import pytest
from support.refusals import assert_named, refused
from support.studies import refusal_line, small_study, small_tables

from sinsjax.errors import InputError
from sinsjax.methods.base import Options
from sinsjax.methods.registry import METHODS
from sinsjax.study.identity import fingerprint
from sinsjax.study.load import study_from_dict, study_to_tables

ESTIMATED = {"estimate": "covariance", "draws": None}


@refused("""
motion.vibration_ug_rms = 10.0                       -> [motion] vibration_ug_rms
motion.vibration_deg_per_h_rms = [0.0, 1.0, 0.0]     -> [motion] vibration_deg_per_h_rms
sensors.gyro_quantisation_arcsec = 1.0               -> [sensors] gyro_quantisation_arcsec
sensors.accel_quantisation_um_per_s = 1.0            -> [sensors] accel_quantisation_um_per_s
alignment.method = "inertial"                        -> [alignment] method: inertial
axes.method = ["kalman5", "inertial"]                -> [axes] method: inertial
cases = [{method = "compass"}, {method = "inertial"}]    -> [cases] method: inertial
resets = {reset_trigger = "innovation", trigger_threshold = 5.0}    -> [resets] reset_trigger
coarse = {coarse_method = "inertial", coarse_duration_s = 2.0}    -> [coarse]
passes.stored_s = 2.0                                -> [passes]
drawn.gyro_scale_ppm.normal = [0, 1]                 -> [drawn] gyro_scale_ppm
drawn.vn0_m_per_s.uniform = [-1, 1]                  -> [drawn] vn0_m_per_s: normal
""")
def test_covariance_estimate_refuses_settings_that_draws_allow(refusal):
    small_study(**refusal.tables)
    refusal.check(refusal_line(**refusal.tables, study=ESTIMATED))


@refused("""
study.curves = true                                  -> [study] curves: 'covariance'
stop_when = {statistic = "success_rate", half_width = 0.1}    -> [stop_when]: 'covariance'
tune.searches = ["sobol"] & tune.variables.p0_yaw_deg = {low = 10.0, high = 90.0}
    -> [tune]: 'covariance'
study.estimate_samples = 65                          -> [study] estimate_samples: 2
""")
def test_covariance_estimate_refuses_settings_that_need_draws(refusal):
    study = ESTIMATED | refusal.tables.get("study", {})
    refusal.check(refusal_line(**refusal.tables | {"study": study}))


@refused("""
study.estimate_samples = 64                          -> [study] estimate_samples: 'covariance'
study.check_linearity = true                         -> [study] check_linearity: 'covariance'
study.estimate = "controlled"                        -> [study] estimate: 'controlled' 'covariance'
alignment.method = "inertial" & tune.searches = ["sobol", "covariance"]
    & tune.variables.phi_u0_deg = {low = 1.0, high = 9.0}
    -> [tune] searches: 'covariance' 'sobol' inertial
""")
def test_settings_of_the_estimate_need_one_that_applies(refusal):
    refusal.check(refusal_line(**refusal.tables))


def test_covariance_estimate_refuses_recorded_data():
    recorded = small_tables(study=ESTIMATED)
    del recorded["motion"], recorded["sensors"]
    recorded["record"] = {"format": "psins", "start_s": [0.0]}
    with pytest.raises(InputError) as caught:
        study_from_dict(recorded)
    assert_named(str(caught.value), "study: [record]", "simulated")


def test_estimates_accept_normally_drawn_starts_and_biases():
    laws = {"vn0_m_per_s": {"normal": [0, 1]}, "accel_bias_ug": {"normal": [0, 100]}}
    small_study(study=ESTIMATED, sensors={"accel_bias_ug": None}, drawn=laws)


def test_estimate_defaults_survive_round_trip():
    study = small_study(study=ESTIMATED)
    assert (study.study.estimate_samples, study.study.draws, study.n_draws) == (256, 64, 1)
    assert study.checks_linearity
    assert study_from_dict(study_to_tables(study), study.name) == study
    assert small_study().study.estimate_samples is None


def test_fingerprint_changes_with_covariance_estimate_but_not_with_draws():
    plain = fingerprint(small_study())
    assert fingerprint(small_study(study={"estimate": "draws"})) == plain
    estimated = [ESTIMATED, ESTIMATED | {"estimate_samples": 64}]
    found = {fingerprint(small_study(study=keys)) for keys in estimated}
    assert len({plain, *found}) == 3


@pytest.mark.parametrize("name", METHODS)
def test_has_error_model_flag_matches_method(name):
    method = METHODS[name](Options(0.01))
    assert METHODS[name].has_error_model == (method.error_model is not None)

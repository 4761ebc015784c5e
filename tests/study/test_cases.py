"""What a case has of its sections: the keys that it leaves out."""

import tomllib

import pytest
from support.studies import small_study

from sinsjax.study.load import fingerprint, study_from_dict, study_to_toml

COMPASS = {"case": "designed", "method": "compass", "level_sigma_per_s": 0.1, "level_time_s": 5.0}
TRIGGER = {"reset_trigger": "innovation", "trigger_threshold": 9.0, "trigger_window_s": 3.0}


def test_cases_of_different_keys_are_those_that_repeat_all_of_them() -> None:
    short = [
        {"case": "a"},
        {"case": "b", "reset_times_s": [2.0]},
        {"case": "c", "vn0_m_per_s": 9.0},
    ]
    full = [{"reset_times_s": [], "vn0_m_per_s": 5.0} | case for case in short]
    section = {"resets": {"reset_times_s": []}, "alignment": {"vn0_m_per_s": 5.0}}
    shorter, longer = small_study(cases=short, **section), small_study(cases=full)
    assert shorter.variant_values() == longer.variant_values()
    assert fingerprint(shorter) == fingerprint(longer)


@pytest.mark.parametrize(
    ("key", "cases", "values"),
    [
        ("reset_times_s", [{"schedule": "none"}, {"reset_times_s": [3.0]}], [None, (3.0,)]),
        ("gyro_noise_deg_per_h", [{}, {"gyro_arw_deg_per_sqrt_h": 0.01}], [0.1, None]),
        ("level_sigma_per_s", [COMPASS, {"method": "compass", "level_time_s": 4.0}], [0.1, 0.02]),
        ("level_sigma_per_s", [COMPASS, {"level_gains": [0.3, 1e4, 1e-4]}], [0.1, None]),
        ("trigger_window_s", [{}, TRIGGER], [None, 3.0]),
        ("gravity_m_per_s2", [{"earth": "wgs84"}, {"gravity_m_per_s2": 9.7}], [9.8, 9.7]),
    ],
)
def test_case_of_another_key_of_the_same_quantity_drops_that_of_its_section(
    key, cases, values
) -> None:
    study = small_study(
        sensors={"gyro_noise_deg_per_h": 0.1},
        cases=[case | {"case": str(number)} for number, case in enumerate(cases)],
    )
    assert study.values(key) == values
    again = study_from_dict(tomllib.loads(study_to_toml(study)))
    assert again == study and fingerprint(again) == fingerprint(study)

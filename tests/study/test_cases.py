"""What a case has of its sections: the keys that it leaves out."""

import tomllib

import pytest
from support.studies import small_study

from sinsjax.errors import InputError
from sinsjax.study.identity import fingerprint
from sinsjax.study.load import study_from_dict, study_to_toml

COMPASS = {"case": "designed", "method": "compass", "level_sigma_per_s": 0.1, "level_time_s": 5.0}
TRIGGER = {"reset_trigger": "innovation", "trigger_threshold": 9.0, "trigger_window_s": 3.0}


def test_case_has_value_of_section_or_default_for_key_it_leaves_out() -> None:
    cases = [{"p0_yaw_deg": 20.0}, {"phi_u0_deg": 7.0}, {"reset_kind": "yaw"}]
    study = small_study(alignment={"phi_u0_deg": 5.0}, cases=cases)
    assert study.values("phi_u0_deg") == [5.0, 7.0, 5.0]
    assert study.values("p0_yaw_deg") == [20.0, 80.0, 80.0]
    assert study.values("reset_kind") == ["full", "full", "yaw"]


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


def test_two_keys_of_one_quantity_in_a_case_are_refused() -> None:
    both = {"gyro_noise_deg_per_h": 1.0, "gyro_arw_deg_per_sqrt_h": 0.1}
    with pytest.raises(InputError, match=r"\[cases\] gyro_\w+\[1\]: conflicts"):
        small_study(cases=[{"case": "a"}, {"case": "b"} | both])


def test_case_with_value_of_section_that_is_wrong_names_the_section() -> None:
    with pytest.raises(InputError, match=r"\[filter\] p0_yaw_deg: .* -1"):
        small_study(
            filter={"p0_yaw_deg": -1}, cases=[{"case": "a"}, {"p0_yaw_deg": 3.0, "case": "b"}]
        )


@pytest.mark.parametrize("key", ["latitude_deg", "q_reading"])
def test_key_that_every_case_needs_is_refused_where_one_has_none(key) -> None:
    row = {"latitude_deg": 32.0, "q_reading": "psd", "q_accel_ug": 1.0, "q_gyro_deg_per_h": 1.0}
    with pytest.raises(InputError, match=rf"\[cases\] {key}: required"):
        small_study(
            earth={"latitude_deg": None}, cases=[{k: v for k, v in row.items() if k != key}, row]
        )

"""Implausible values are refused wherever they are given, by the usual range of each key."""

import copy
import tomllib
from typing import Any

import pytest
from support.memory import limit_memory_mb
from support.studies import BASE, refusal_line, small_study

from sinsjax import columns
from sinsjax.errors import InputError
from sinsjax.study import rules
from sinsjax.study.identity import fingerprint
from sinsjax.study.keys import KEYS, SECTIONS
from sinsjax.study.load import study_from_dict, study_to_toml
from sinsjax.study.study import Study

BOUNDED = {
    f"{angle}_{what}_deg" for angle in ("pitch", "roll", "yaw") for what in ("center", "phase")
}
BOUNDED |= {"latitude_deg", "mounting_deg", "phi_e0_deg", "phi_n0_deg", "phi_u0_deg"}
"""Angles whose bounds say it all."""


def unchecked_study(**tables: Any) -> Study:
    return small_study(**tables | {"study": tables.get("study", {}) | {"unchecked": True}})


def test_refusal_names_value_position_in_file():
    """Also where others before it are given twice."""
    heights = {"z": {"height_m": [0, 0, 1e12], "ve0_m_per_s": [1, 2, 3]}}
    assert refusal_line(axes=heights).startswith("[axes.z] height_m[2]: 1e+12 is outside")
    gains = {"alignment": {"method": "compass"}, "compass": {"level_gains": [1.0, 9e11, 0.0]}}
    assert "level_gains[1]: 900000000000 is outside" in refusal_line(**gains)


@pytest.mark.parametrize("draws", [4_100_000, 4_300_000, 40_000_000])
def test_many_draws_are_accepted_unless_law_exceeds_usual_range(draws):
    def of(deviation: float) -> Study:
        data = copy.deepcopy(BASE) | {"drawn": {"phi_u0_deg": {"normal": [0, deviation]}}}
        del data["alignment"]["phi_u0_deg"]
        data["study"]["draws"] = draws
        return study_from_dict(data)

    assert of(25).n_draws == draws
    with pytest.raises(InputError, match=r"phi_u0_deg: .*(draw \d+ gives|may give)"):
        of(60)


def test_every_key_with_unit_has_usual_range():
    for section, model in SECTIONS.items():
        for key in model.model_fields:
            if columns.split_unit(key)[1] and key not in BOUNDED:
                assert KEYS[section, key].info.usual_range, f"[{section}] {key}"


def test_defaults_lie_in_usual_range():
    for section, model in SECTIONS.items():
        for key, field in model.model_fields.items():
            if KEYS[section, key].info.usual_range:
                assert rules.describe_implausible(key, field.default) is None


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ("earth", "radius_m", 1.0),
        ("earth", "gravity_m_per_s2", 980.0),
        ("earth", "height_m", -6e6),
        ("earth", "height_m", 1e12),
        ("sensors", "gyro_bias_deg_per_h", 1e12),
        ("sensors", "accel_bias_ug", -1e12),
        ("motion", "roll_period_s", 1e-6),
        ("alignment", "ve0_m_per_s", 1e6),
        ("filter", "p0_yaw_deg", 1e6),
        ("study", "success_band_arcmin", 1e6),
    ],
)
def test_unusual_value_is_refused_unless_unchecked(section: str, key: str, value: float):
    low, high = KEYS[section, key].info.usual_range
    line = f"[{section}] {key}: {value:.12g} is outside the usual range of {low:g} to {high:g}"
    line += " ([study] unchecked = true accepts it)"
    assert refusal_line(**{section: {key: value}}) == line
    if section != "study":
        assert getattr(getattr(unchecked_study(**{section: {key: value}}), section), key) == value


@pytest.mark.parametrize(
    ("tables", "place"),
    [
        ({"sensors": {"gyro_bias_deg_per_h": [0, 1e9, 0]}}, "[sensors] gyro_bias_deg_per_h[1]"),
        ({"axes": {"radius_m": [6.4e6, 1.0]}}, "[axes] radius_m[1]"),
        ({"axes": {"z": {"radius_m": [6.4e6, 1.0], "phi_u0_deg": [1, 2]}}}, "[axes.z] radius_m[1]"),
        ({"cases": [{"radius_m": 6.4e6}, {"radius_m": 1.0}]}, "[cases] radius_m[1]"),
        ({"axes": {"accel_noise_ug": [1.0, [0, 0, 1e9]]}}, "[axes] accel_noise_ug[1][2]"),
        ({"resets": {"reset_times_s": [1e-12, 1.0]}}, "[resets] reset_times_s"),
    ],
)  # fmt: skip
def test_unusual_value_is_refused_in_lists_axes_and_cases(tables: dict[str, Any], place: str):
    assert refusal_line(**tables).startswith(place)


@pytest.mark.parametrize(
    "law",
    [
        {"uniform": [0, 1e9]},
        {"normal": [1e9, 1]},
        {"normal": [0, 1e9]},
        {"values": [0, 1e9]},
        {"grid": [0, 1e9]},
        {"values": [0, [0, 1e9, 0]]},
    ],
)
def test_unusual_drawn_value_is_refused_unless_unchecked(law: dict[str, Any]):
    tables = {"drawn": {"accel_bias_ug": law}, "sensors": {}}
    data = {name: dict(table) for name, table in BASE.items()} | {"drawn": tables["drawn"]}
    del data["sensors"]["accel_bias_ug"]
    with pytest.raises(InputError, match=r"\[drawn\] accel_bias_ug: draw \d gives .* outside"):
        study_from_dict(data)
    data["study"]["unchecked"] = True
    assert study_from_dict(data).drawn


@pytest.mark.parametrize(
    ("law", "text"),
    [({"normal": [0, 1.0]}, None), ({"normal": [0, 2e4]}, "one of 896000000 draws")],
)
def test_law_of_huge_draw_count_is_checked_without_listing_draws(
    law: dict[str, Any], text: str | None
):
    tables = {"study": {"draws": 896_000_000}, "drawn": {"vn0_m_per_s": law}}
    with limit_memory_mb(100):  # a list of the draws is 7,000
        if text is None:
            small_study(**tables)
        else:
            assert text in refusal_line(**tables)


@pytest.mark.parametrize(
    ("kind", "place"),
    [
        ({"low": 1.0, "high": 1e6}, "with every range at its high end: "),
        ({"fixed": 1e6}, "with these values: "),
        ({"candidates": [1.0, 1e6]}, "with these values: "),
    ],
)
def test_unusual_tuning_value_is_refused_unless_unchecked(kind: dict[str, Any], place: str):
    tune = {"variables": {"p0_yaw_deg": kind}, "searches": ["grid"]}
    line = refusal_line(tune=tune)
    assert line.startswith(f"[tune.variables] {place}") and "p0_yaw_deg: 1000000 is" in line
    unchecked_study(tune=tune)


def test_feedback_interval_longer_than_run_is_refused_unless_unchecked():
    line = refusal_line(alignment={"feedback_interval_s": 7.0})
    assert line == (
        "[alignment] feedback_interval_s: 7 s is longer than a run of 6 s: there is no feedback"
        " ([study] unchecked = true accepts it)"
    )
    unchecked_study(alignment={"feedback_interval_s": 7.0})
    small_study(alignment={"feedback_interval_s": 6.0})


@pytest.mark.parametrize("earth", ["constants", "wgs84"])
def test_height_below_earth_centre_is_always_refused(earth: str):
    line = refusal_line(earth={"height_m": -6378137.0, "earth": earth}, study={"unchecked": True})
    assert line == (
        "[earth] height_m: -6378137 m reaches the centre of the Earth (give the height in m)"
    )


def test_default_feedback_interval_is_accepted_in_short_study():
    study = small_study(study={"duration_s": 0.5, "record_interval_s": 0.1, "window_s": [0, 0.5]})
    assert study_from_dict(tomllib.loads(study_to_toml(study))) == study


def test_unchecked_does_not_change_fingerprint():
    assert unchecked_study() != small_study() and fingerprint(unchecked_study()) == fingerprint(
        small_study()
    )
    assert "unchecked" not in study_to_toml(small_study())

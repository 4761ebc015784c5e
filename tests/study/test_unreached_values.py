"""Times after the end of all runs, unread keys and unreached draws are refused."""

import tomllib
from typing import Any

import pytest
from support.refusals import assert_named, refused
from support.studies import BASE, refusal_line, small_study

from sinsjax.errors import InputError
from sinsjax.study.load import study_from_dict, study_to_toml

COMPASS = {"alignment": {"method": "compass"}}


@refused("""
alignment.method = "compass" & compass.level_time_s = 7.0
    -> [compass] level_time_s: 7 6
alignment.method = "compass" & compass = {sigma_factors = [2, 1], sigma_times_s = [6.5]}
    -> [compass] sigma_times_s: 6.5 6
alignment.method = "compass" & compass.level_passes = 4 & passes.stored_s = 2.0
    -> [compass] level_passes: 8 6
alignment.method = "compass" & compass = {sigma_factors = [2, 1], sigma_passes = [5]}
    & axes.passes = [1, 2] & passes.stored_s = 2.0
    -> [compass] sigma_passes: 10 4
resets = {reset_trigger = "innovation", trigger_threshold = 9.0, trigger_until_s = 6.1}
    -> [resets] trigger_until_s: 6.1 6
resets = {reset_trigger = "innovation", trigger_threshold = 9.0}
    & axes.trigger_until_s = [3.0, 600.0]
    -> [axes] trigger_until_s: 600 6
""")
def test_time_after_end_of_all_runs_is_refused(refusal):
    refusal.check(refusal_line(**refusal.tables))


@pytest.mark.parametrize(
    "tables",
    [
        COMPASS | {"compass": {"level_time_s": 6.0}},
        COMPASS | {"compass": {"level_time_s": 5.0}, "axes": {"stored_s": [2.0], "passes": [1, 3]}},
        {"axes": {"method": ["compass", "kalman5"]}, "compass": {"level_time_s": 5.0}},
        {"resets": {"trigger_threshold": 9.0}, "cases": [
            {"reset_trigger": "innovation", "trigger_until_s": 3.0},
            {"reset_trigger": "none", "trigger_until_s": 600.0},
        ]},
    ],
    ids=["at the end", "of one of two lengths", "of one method", "where there is no trigger"],
)  # fmt: skip
def test_reachable_or_unread_time_is_accepted(tables):
    small_study(**tables)


def test_default_time_after_end_of_study_is_accepted():
    """What a study of 6 s resolves to loads again: 150 s of levelling is the default."""
    study = small_study(**COMPASS)
    assert study.compass and study.compass.level_time_s == 150
    assert study_from_dict(tomllib.loads(study_to_toml(study))) == study


@pytest.mark.parametrize("loop", ["level", "azimuth"])
def test_damping_given_with_gains_is_refused(loop):
    gains = {"level": [1.0, 2.0, 3.0], "azimuth": [1.0, 2.0, 3.0, 4.0]}[loop]
    damping, key = {f"{loop}_damping": 0.6}, f"{loop}_gains"
    line = refusal_line(**COMPASS, compass={key: gains} | damping)
    assert_named(line, f"[compass] {loop}_damping", key, "[compass]")
    line = refusal_line(**COMPASS, compass=damping, axes={key: [gains]})
    assert_named(line, f"[compass] {loop}_damping", key, "[axes]")
    line = refusal_line(**COMPASS, axes={key: [gains], f"{loop}_damping": [0.6, 0.7]})
    assert_named(line, f"[axes] {loop}_damping", key)
    study = small_study(**COMPASS, compass={key: gains})
    assert study_from_dict(tomllib.loads(study_to_toml(study))) == study


def drawing(laws: dict[str, Any], **changes: Any) -> Any:
    data: dict[str, Any] = {name: dict(table) for name, table in BASE.items()} | changes
    for key in laws:
        for section in ("motion", "alignment"):
            data[section].pop(key, None)
    return study_from_dict(data | {"drawn": laws})


@pytest.mark.parametrize(
    ("laws", "place", "count"),
    [
        ({"yaw_center_deg": {"values": [1, 2, 3, 4]}}, "yaw_center_deg.values", "4"),
        (
            {"yaw_center_deg": {"grid": [1, 2]}, "phi_u0_deg": {"grid": [3, 4]}},
            "yaw_center_deg.grid",
            "4",
        ),
    ],
)
def test_drawn_lists_longer_than_draws_are_refused(laws, place, count):
    with pytest.raises(InputError) as caught:
        drawing(laws)
    assert_named(str(caught.value), f"study: [drawn] {place}", count, "3")
    assert drawing(laws, study=BASE["study"] | {"draws": 4}).n_draws == 4

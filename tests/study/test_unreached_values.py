"""Times after the end of all runs, unread keys and unreached draws are refused."""

import tomllib
from typing import Any

import pytest
from support.studies import BASE, refusal_line, small_study

from sinsjax.errors import InputError
from sinsjax.study.load import study_from_dict, study_to_toml

COMPASS = {"alignment": {"method": "compass"}}
TRIGGER = {"reset_trigger": "nis", "trigger_threshold": 9.0}


@pytest.mark.parametrize(
    ("tables", "line"),
    [
        (
            COMPASS | {"compass": {"level_time_s": 7.0}},
            (
                "[compass] level_time_s: 7 s is after the end of all runs that use it, at 6 s (give"
                " an earlier time, or longer runs)"
            ),
        ),
        (
            COMPASS | {"compass": {"sigma_factors": [2, 1], "sigma_times_s": [6.5]}},
            (
                "[compass] sigma_times_s: 6.5 s is after the end of all runs that use it, at 6 s"
                " (give an earlier time, or longer runs)"
            ),
        ),
        (
            COMPASS | {"compass": {"level_passes": 4}, "passes": {"stored_s": 2.0}},
            (
                "[compass] level_passes: 8 s is after the end of all runs that use it, at 6 s (give"
                " an earlier time, or longer runs)"
            ),
        ),
        (
            COMPASS
            | {"compass": {"sigma_factors": [2, 1], "sigma_passes": [5]}}
            | {"axes": {"passes": [1, 2]}, "passes": {"stored_s": 2.0}},
            (
                "[compass] sigma_passes: 10 s is after the end of all runs that use it, at 4 s"
                " (give an earlier time, or longer runs)"
            ),
        ),
        (
            {"resets": TRIGGER | {"trigger_until_s": 6.1}},
            (
                "[resets] trigger_until_s: 6.1 s is after the end of all runs that use it, at 6 s"
                " (give an earlier time, or longer runs)"
            ),
        ),
        (
            {"resets": TRIGGER | {"trigger_refractory_s": 10.0}},
            (
                "[resets] trigger_refractory_s: 10 s is after the end of all runs that use it, at 6"
                " s (give an earlier time, or longer runs)"
            ),
        ),
        (
            {"resets": TRIGGER, "axes": {"trigger_until_s": [3.0, 600.0]}},
            (
                "[axes] trigger_until_s: 600 s is after the end of all runs that use it, at 6 s"
                " (give an earlier time, or longer runs)"
            ),
        ),
        (
            COMPASS | {"cases": [{"level_time_s": 1.0}, {"level_time_s": 60.0}]},
            (
                "[cases] level_time_s: 60 s is after the end of all runs that use it, at 6 s (give"
                " an earlier time, or longer runs)"
            ),
        ),
    ],
)
def test_time_after_end_of_all_runs_is_refused(tables: dict[str, Any], line: str):
    assert refusal_line(**tables) == line


@pytest.mark.parametrize(
    "tables",
    [
        COMPASS | {"compass": {"level_time_s": 6.0}},
        COMPASS | {"compass": {"level_time_s": 5.0}, "axes": {"stored_s": [2.0], "passes": [1, 3]}},
        {"axes": {"method": ["compass", "kalman5"]}, "compass": {"level_time_s": 5.0}},
        {"resets": {"trigger_threshold": 9.0}, "cases": [
            {"reset_trigger": "nis", "trigger_until_s": 3.0},
            {"reset_trigger": "none", "trigger_until_s": 600.0},
        ]},
    ],
    ids=["at the end", "of one of two lengths", "of one method", "where there is no trigger"],
)  # fmt: skip
def test_reachable_or_unread_time_is_accepted(tables: dict[str, Any]):
    small_study(**tables)


def test_default_time_after_end_of_study_is_accepted():
    """What a study of 6 s resolves to loads again: 150 s of levelling is the default."""
    study = small_study(**COMPASS)
    assert study.compass and study.compass.level_time_s == 150
    assert study_from_dict(tomllib.loads(study_to_toml(study))) == study


@pytest.mark.parametrize("loop", ["level", "azimuth"])
def test_damping_given_with_gains_is_refused(loop: str):
    gains = {"level": [1.0, 2.0, 3.0], "azimuth": [1.0, 2.0, 3.0, 4.0]}[loop]
    compass = {f"{loop}_gains": gains, f"{loop}_damping": 0.6}
    text = f"{loop}_damping: has no effect with {loop}_gains in"
    assert (
        refusal_line(**COMPASS, compass=compass) == f"[compass] {text} [compass] (give one of them)"
    )
    axes = {f"{loop}_gains": [gains]}
    line = refusal_line(**COMPASS, compass={f"{loop}_damping": 0.6}, axes=axes)
    assert line == f"[compass] {text} [axes] (give one of them)"
    line = refusal_line(**COMPASS, axes=axes | {f"{loop}_damping": [0.6, 0.7]})
    assert line.startswith(f"[axes] {text}")
    del compass[f"{loop}_damping"]
    study = small_study(**COMPASS, compass=compass)
    assert study_from_dict(tomllib.loads(study_to_toml(study))) == study


def drawing(laws: dict[str, Any], **changes: Any) -> Any:
    data: dict[str, Any] = {name: dict(table) for name, table in BASE.items()} | changes
    for key in laws:
        for section in ("motion", "alignment"):
            data[section].pop(key, None)
    return study_from_dict(data | {"drawn": laws})


@pytest.mark.parametrize(
    ("laws", "text"),
    [
        (
            {"yaw_center_deg": {"values": [1, 2, 3, 4]}},
            "yaw_center_deg.values: has 4 entries for 3 draws (drop those that are never drawn)",
        ),
        (
            {"yaw_center_deg": {"grid": [1, 2]}, "phi_u0_deg": {"grid": [3, 4]}},
            "yaw_center_deg.grid: 4 points of the grid of yaw_center_deg, phi_u0_deg are more"
            " than 3 draws (drop some, or draw more)",
        ),
    ],
)
def test_drawn_lists_longer_than_draws_are_refused(laws: dict[str, Any], text: str):
    with pytest.raises(InputError) as caught:
        drawing(laws)
    assert str(caught.value) == f"study: [drawn] {text}"
    assert drawing(laws, study=BASE["study"] | {"draws": 4}).n_draws == 4

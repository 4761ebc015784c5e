"""``--set`` tells what it drops, and refuses what cannot hold together."""

import pytest

from sinsjax.errors import InputError
from sinsjax.study.changes import apply_changes, parse_changes

SHEET = {"sensors": {"gyro_arw_deg_per_sqrt_h": 0.01}, "axes": {"reset_count": [1, 2]}}


@pytest.mark.parametrize(
    ("change", "dropped"),
    [
        ("sensors.gyro_noise_deg_per_h=1", "[sensors] gyro_arw_deg_per_sqrt_h"),
        ("axes.gyro_noise_deg_per_h=[1,2]", "[sensors] gyro_arw_deg_per_sqrt_h"),
        ("resets.reset_times_s=[]", "[axes] reset_count"),
    ],
)
def test_key_that_is_replaced_by_another_is_told_in_one_line(change, dropped, capsys) -> None:
    options = parse_changes([change])
    for _ in range(2):  # a command may read its study twice
        apply_changes(SHEET, options)
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"Warning: --set {change.partition('=')[0]} replaces {dropped}."


def test_other_value_of_the_same_key_is_not_told(capsys) -> None:
    apply_changes(SHEET, parse_changes(["sensors.gyro_arw_deg_per_sqrt_h=1"]))
    assert capsys.readouterr().err == ""


def test_two_keys_of_one_quantity_are_refused() -> None:
    options = parse_changes(["sensors.gyro_noise_deg_per_h=1", "sensors.gyro_arw_deg_per_sqrt_h=1"])
    with pytest.raises(InputError, match="gyro_arw.* conflicts with sensors.gyro_noise"):
        apply_changes(SHEET, options)

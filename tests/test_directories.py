"""What keeps a directory of results from being gone on with: other keys, other versions."""

from typing import Any

import pytest
from studies import small_study

from sinsjax import campaign, directories, runtime
from sinsjax.types import InputError

ZIP = {"reset_count": [0, 1, 2], "reset_cycle_s": [1.0, 1.0, 2.0]}


@pytest.mark.parametrize(
    ("there", "here", "told"),
    [
        (
            {"axes": {"sched": ZIP}},
            {"axes": {"sched": ZIP | {"reset_cycle_s": [1.0, 1.0, 2.5]}}},
            ["[axes.sched] reset_cycle_s: [1.0, 1.0, 2.0] there, [1.0, 1.0, 2.5] here"],
        ),
        (
            {"drawn": {"vn0_m_per_s": {"normal": [0.0, 1.0]}}},
            {"drawn": {"vn0_m_per_s": {"normal": [0.0, 2.0]}}},
            ["[drawn] vn0_m_per_s: {'normal': (0.0, 1.0)} there, {'normal': (0.0, 2.0)} here"],
        ),
        (
            {"cases": [{"p0_yaw_deg": 40.0}, {"p0_yaw_deg": 50.0}]},
            {"cases": [{"p0_yaw_deg": 40.0}, {"p0_yaw_deg": 60.0}]},
            ["[cases 1] p0_yaw_deg: 50.0 there, 60.0 here"],
        ),
        ({}, {"axes": {"p0_yaw_deg": [1.0]}}, ["[axes] p0_yaw_deg: none there, [1.0] here"]),
        (
            {"axes": {"p0_yaw_deg": [1.0], "phi_u0_deg": [2.0]}},
            {"axes": {"phi_u0_deg": [2.0], "p0_yaw_deg": [1.0]}},
            ["its keys stand in another order"],
        ),
    ],
)
def test_the_keys_that_differ_are_named(
    there: dict[str, Any], here: dict[str, Any], told: list[str]
) -> None:
    assert directories.differences(small_study(**there), small_study(**here)) == told


@pytest.mark.parametrize("name", ["jaxlib", "scipy"])
def test_rows_of_other_versions_are_not_added(
    name: str, tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study, out = small_study(), tmp_path / "out"
    campaign.run_into(study, out)
    before = (out / "manifest.json").read_bytes()
    other = runtime.versions() | {name: "0.0"}
    monkeypatch.setattr(runtime, "versions", lambda: other)
    with pytest.raises(InputError, match=f"out: was made with {name} .*, here is 0.0"):
        campaign.run_into(study, out, resume=True)
    assert (out / "manifest.json").read_bytes() == before

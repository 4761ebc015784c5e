"""Keys of turns: whole samples, refused values, notes and warnings."""

import numpy as np
import pytest
from support.refusals import refused
from support.studies import STILL, refusal_line, small_study

from sinsjax.arena.simulated_record import simulated_record
from sinsjax.engine.scenario import read_motion
from sinsjax.errors import InputError
from sinsjax.execution import run
from sinsjax.execution.checks import study_warnings
from sinsjax.execution.hidden_north import hidden_north
from sinsjax.execution.prepare import prepare_job
from sinsjax.study.identity import fingerprint
from sinsjax.study.load import study_from_dict
from sinsjax.study.schema import TURN_KEYS
from sinsjax.study.turns import describe_rounding, turns_in_samples
from sinsjax.study.variants import Variants

pytestmark = pytest.mark.optimised(False)

FAST = {"turn_times_s": [1.0], "turn_rate_deg_per_s": 90.0, "turn_ramp_s": 0.5}
THERE_AND_BACK = {"turn_times_s": [0.0, 3.0], "turn_angles_deg": [400.0, -400.0]}
THERE_AND_BACK |= {"turn_rate_deg_per_s": 200.0, "turn_ramp_s": 0.2}


def plan(rate_hz=100.0, end_s=60.0, **given):
    values = dict.fromkeys(TURN_KEYS) | {f"turn_{key}": value for key, value in given.items()}
    return turns_in_samples(rate_hz, end_s, values)


def test_turn_has_exact_angle_in_whole_samples():
    made = plan(times_s=(1.004,), angles_deg=-100.0, rate_deg_per_s=7.0, ramp_s=0.333)
    (turn,) = made.turns
    assert (turn.begin, turn.length, made.ramp) == (100, 1429, 33)
    assert turn.rate_deg_per_s * turn.length / 100 == pytest.approx(-100.0, rel=1e-15)
    assert made.changes == (
        "ramp 0.333 s to 0.33 s",
        "begin 1.004 s to 1 s",
        "rate 7 deg/s to 6.99790062981 deg/s",
    )


def test_unfinished_turn_keeps_its_rate():
    made = plan(times_s=(1.0,), angles_deg=1e6, rate_deg_per_s=7.0)
    assert made.turns[0].rate_deg_per_s == 7.0 and not made.changes


def test_turns_repeat_until_the_end():
    made = plan(times_s=(0.0, 5.0), angles_deg=(90.0, -90.0), rate_deg_per_s=45.0, repeat_s=12.0)
    assert [t.begin / 100 for t in made.turns] == [0, 5, 12, 17, 24, 29, 36, 41, 48, 53]
    assert [t.angle_deg for t in made.turns] == [90.0, -90.0] * 5


@refused("""
motion.turn_angles_deg = 90.0                -> [motion] turn_angles_deg: turn_times_s
motion = {turn_times_s = [1.0, 2.0], turn_rate_deg_per_s = 90.0}
    -> [motion] turn_times_s: 1 4 2
motion = {turn_times_s = [1.0], turn_rate_deg_per_s = 90.0, turn_ramp_s = 0.5, turn_repeat_s = 2.0}
    -> [motion] turn_times_s: 1 3.5 3
motion = {turn_times_s = [1.0, 6.0], turn_angles_deg = 30.0}
    -> [motion] turn_times_s: 6
motion = {turn_times_s = [1.0], turn_rate_deg_per_s = 900.0}
    -> [motion] turn_rate_deg_per_s: 900 572.9 100
motion = {turn_times_s = [1.0], turn_ramp_s = 0.001}
    -> [motion] turn_ramp_s: 0.001 0.01
motion = {turn_times_s = [1.0], turn_angles_deg = [1.0, 2.0]}
    -> [motion] turn_angles_deg: 2 1
motion.turn_times_s = [2.0, 1.0]             -> [motion] turn_times_s: increase
""")
def test_turns_are_refused_in_one_line(refusal):
    refusal.check(refusal_line(**refusal.tables))


def test_floor_of_turned_base_is_refused():
    study = small_study(study={"judged_from": "floor"}, motion=STILL | FAST)
    with pytest.raises(InputError, match="no bias floor") as caught:
        run.run(study)
    assert len(caught.value.lines) == 1


def test_rounding_is_said_in_one_line():
    (line,) = describe_rounding(small_study(motion=FAST | {"turn_times_s": [1.004]}))
    assert line == "Turns are rounded to whole samples: begin 1.004 s to 1 s."
    assert line in prepare_job(small_study(motion=FAST | {"turn_times_s": [1.004]})).notes
    assert not [*describe_rounding(small_study(motion=FAST))]
    assert not [*describe_rounding(small_study())]


@pytest.mark.parametrize(
    ("method", "motion", "warned"),
    [
        ("kalman5", FAST, True),
        ("compass", FAST, True),
        ("inertial", FAST, True),
        ("inertial", FAST | {"turn_angles_deg": 1e6, "turn_rate_deg_per_s": 200.0}, False),
        ("inertial", FAST | THERE_AND_BACK, False),
        ("kalman10", FAST, False),
        ("kalman5", {}, False),
    ],
)
def test_methods_that_do_not_use_turns_are_named(method, motion, warned):
    study = small_study(motion=motion, alignment={"method": method, "phi_u0_deg": 0.0})
    lines = [line for line in study_warnings(study) if line.startswith("[alignment] method")]
    assert len(lines) == warned
    assert all(line.startswith(f"[alignment] method: {method} does not") for line in lines)


def test_hidden_north_is_not_feared_on_a_turned_base():
    biased = {"gyro_bias_deg_per_h": [50.0, 0.0, 0.0]}
    assert hidden_north(small_study(motion=STILL, sensors=biased)) is not None
    assert hidden_north(small_study(motion=STILL | FAST, sensors=biased)) is None


@pytest.mark.nightly
def test_turns_can_be_swept_with_none_among_them():
    axes = {"turn_times_s": [[], [1.0], [0.0, 4.0]]}
    study = small_study(motion=STILL | {"turn_angles_deg": 30.0}, axes=axes)
    table = run.run(study).summary
    assert table["has_floor"].to_pylist()[:3] == [True, False, False]
    assert table["floor_arcmin"].to_pylist()[1:3] == [None, None]
    counts = []
    for variant in range(3):
        turns = read_motion(Variants(study, np.array([variant]))).vertical
        counts.append(0 if turns is None else len(turns.begin))
    assert counts == [0, 1, 2]


@pytest.mark.nightly
@pytest.mark.parametrize("axis", ["vertical", "body"])
def test_drawn_motion_turns_like_fixed_one(axis):
    turns = FAST | {"turn_axis": axis, "lever_arm_m": [0.2, 0.1, 0.0]}
    fixed = simulated_record(small_study(motion=turns))
    law = {"yaw_center_deg": {"values": [10.0]}}
    drawn = small_study(motion=turns | {"yaw_center_deg": None}, drawn=law)
    made = simulated_record(drawn)
    np.testing.assert_allclose(made.dtheta, fixed.dtheta, rtol=0, atol=1e-15)
    np.testing.assert_allclose(made.dv, fixed.dv, rtol=0, atol=1e-13)


@pytest.mark.nightly
def test_table_without_sway_turns_like_vertical_axis():
    still = STILL | FAST | {"lever_arm_m": [0.2, 0.1, 0.0]}
    made = [
        simulated_record(small_study(motion=still | {"turn_axis": axis}))
        for axis in ("vertical", "body")
    ]
    np.testing.assert_allclose(made[0].dtheta, made[1].dtheta, rtol=0, atol=1e-15)
    np.testing.assert_allclose(made[0].dv, made[1].dv, rtol=0, atol=1e-13)


def test_identity_of_study_without_turns_ignores_the_keys():
    study, turned = small_study(), small_study(motion=FAST)
    assert not set(study.motion.model_dump(exclude_none=True)).intersection(TURN_KEYS)
    assert fingerprint(study) != fingerprint(turned)
    assert study_from_dict(turned.to_dict()) == turned

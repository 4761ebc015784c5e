"""The law of resets: its information against least squares and the filter, and its schedules."""

import math
import re
from typing import Any

import numpy as np
import pytest
from support.commands import Command, command_line
from support.studies import STILL, refusal_line, small_study

import sinsjax
from sinsjax.errors import InputError
from sinsjax.methods import reset_law
from sinsjax.methods.reset_law import NoSchedule, ResetProblem
from sinsjax.platform.assets import asset_path
from sinsjax.study.load import study_from_dict, study_to_tables
from sinsjax.units import ARCMIN, DEG

pytestmark = pytest.mark.optimised(False)

G, RATE = 9.8, 15.041067 * DEG / 3600
PAPER = ResetProblem(
    velocity_noise=(500e-6 * G) ** 2 / 0.01,
    measurement_noise=0.01,
    velocity=0.1,
    level=15 * DEG,
    heading=80 * DEG,
    north_rate=RATE * math.cos(32 * DEG),
    gravity=G,
    feedback_s=1.0,
    is_force_measured=True,
)
"""Q per step and R as a density, as paper 1 prints them."""

NOISY = PAPER._replace(
    accel_noise=(500e-6 * G) ** 2 * 0.01, gyro_noise=(0.1 * DEG / 3600) ** 2 * 0.01
)


def dense_information(length_s: float, problem: ResetProblem, steps: int = 400) -> float:
    """The information on heading of velocities with unknown start, tilt and heading, 1/rad^2."""
    dt = length_s / steps
    t = dt * np.arange(1, steps + 1)
    noise = problem.velocity_noise * np.minimum.outer(t, t)
    noise += problem.measurement_noise / dt * np.eye(steps)
    design = np.column_stack([np.ones(steps), G * t, G * problem.north_rate * t**2 / 2])
    information = design.T @ np.linalg.solve(noise, design)
    return 1 / float(np.linalg.inv(information)[2, 2])


@pytest.mark.parametrize("in_tau", [0.3, 0.69, 0.71, 2.0, 8.0, 40.0])
def test_information_is_that_of_least_squares(in_tau: float) -> None:
    length_s = in_tau * PAPER.tau
    dense = dense_information(length_s, PAPER)
    assert reset_law.heading_information(length_s, PAPER) == pytest.approx(dense, rel=0.02)


@pytest.mark.parametrize("length_s", [30.0, 120.0])
def test_heading_sigma_of_surge_is_that_of_least_squares(length_s: float) -> None:
    surging = PAPER._replace(surge=0.004)
    white = PAPER._replace(measurement_noise=0.004, velocity_noise=1e-15)
    sigma = dense_information(length_s, white) ** -0.5
    assert reset_law.heading_sigma(length_s, surging) == pytest.approx(sigma, rel=0.02)


def test_last_reset_waits_until_surge_leaves_two_degrees() -> None:
    problem = NOISY._replace(velocity_noise=NOISY.accel_noise, measurement_noise=0.004)
    times = reset_law.schedule(problem, 150 * DEG).times_s
    surging = problem._replace(surge=0.004)
    later = reset_law.schedule(surging, 150 * DEG)
    assert later.times_s[:3] == times[:3] and later.times_s[3] > times[3]
    length_s = later.segments[0]
    surge_alone = PAPER._replace(surge=0.004)
    assert reset_law.heading_sigma(length_s, surge_alone) == pytest.approx(2 * DEG)
    assert later.settling_s > reset_law.schedule(problem, 150 * DEG).settling_s
    # A weak surge does not move it.
    weak = reset_law.schedule(problem._replace(surge=1e-6), 150 * DEG)
    assert weak.times_s == times


def test_information_has_its_limits() -> None:
    factor = (G * PAPER.north_rate) ** 2
    q_limited = factor * 1e3**3 / (12 * PAPER.velocity_noise)
    assert reset_law.heading_information(1e3, PAPER) == pytest.approx(q_limited, rel=0.02)
    slow = PAPER._replace(velocity_noise=1e-9)
    r_limited = factor * 30.0**5 / (720 * slow.measurement_noise)
    assert reset_law.heading_information(30.0, slow) == pytest.approx(r_limited, rel=1e-3)


@pytest.mark.nightly
@pytest.mark.parametrize("length_s", [40.0, 120.0])
def test_contraction_is_that_of_the_filter(length_s: float) -> None:
    """P_UU of a noise-free run that is linear throughout, without gyro noise in Q."""
    study = small_study(
        study={"duration_s": length_s, "draws": 1, "window_s": [0, length_s]},
        motion=STILL,
        sensors={f"{key}": 0.0 for key in ("gyro_noise_deg_per_h", "accel_noise_ug")}
        | {"gyro_bias_deg_per_h": 0.0, "accel_bias_ug": 0.0},
        alignment={
            "specific_force": "gravity", "phi_e0_deg": 0.0, "phi_n0_deg": 0.0, "phi_u0_deg": 0.0
        },
        filter={
            "q_accel_ug": 500.0, "q_gyro_deg_per_h": 1e-6, "q_reading": "per_step",
            "r_reading": "psd", "p0_velocity_m_per_s": 10.0,
        },
    )  # fmt: skip
    (row,) = sinsjax.run(study, curves=False).summary.to_pylist()
    measured = (PAPER.heading / (row["sigma_u_arcmin"] * ARCMIN)) ** 2
    assert reset_law.contraction(length_s, PAPER) == pytest.approx(measured, rel=0.01)


CELLS: dict[str, tuple[dict[str, Any], tuple[float, ...], float]] = {
    "R1": ({"is_force_measured": False, "feedback_s": 0.1}, (1.9, 85.7, 169.5), 254),
    "R2": (
        {"is_force_measured": False, "latitude": 60, "q": 10}, (3.0, 249.0, 495.0), 742,
    ),
    "R3": (
        {"is_force_measured": False, "latitude": 0, "q": 0.1, "feedback_s": 0.1}, (1.8, 66.4), 132
    ),
    "R4": ({"is_force_measured": False, "latitude": 75}, (2.0, 182.0, 362.0), 543),
    "R5": (
        {"is_force_measured": False, "q": 10, "feedback_s": 10.0}, (2.86, 179.23, 349.23), 524
    ),
    "R6": ({"noise": True}, (2.0, 4.0, 6.0, 120.0), 328),
    "R8": ({"noise": True, "latitude": 60, "q": 0.1}, (2.0, 4.0, 6.0, 75.0), 320),
    "R10": ({"noise": True, "feedback_s": 10.0}, (1.87, 3.74, 5.61, 117.55), 328),
}  # fmt: skip
"""Changes of `PAPER`, the resets of the theory's table, and the time that they promise."""


def cell(changes: dict[str, Any]) -> ResetProblem:
    given = dict(changes)
    base = NOISY if given.pop("noise", False) else PAPER
    q, latitude = given.pop("q", 1.0), given.pop("latitude", 32)
    return base._replace(
        velocity_noise=PAPER.velocity_noise * q,
        north_rate=RATE * math.cos(latitude * DEG),
        **given,
    )


@pytest.mark.parametrize("name", CELLS)
def test_schedule_of_cells_is_at_their_optimum(name: str) -> None:
    """The optimum is flat: times differ by two seconds, what they promise does not."""
    changes, times_s, promised_s = CELLS[name]
    problem = cell(changes)
    found = reset_law.schedule(problem, 150 * DEG)
    assert found.settling_s == pytest.approx(promised_s, rel=0.005)
    assert len(found.times_s) == len(times_s)
    assert found.times_s == pytest.approx(times_s, rel=0.03)


@pytest.mark.parametrize("heading_deg", [30.0, 120.0, 150.0])
@pytest.mark.parametrize("q", [1.0, 1e-2])
def test_schedule_with_a_number_of_resets(heading_deg: float, q: float) -> None:
    """With as many as the law it is the law's; with fewer it settles later, early ones left out."""
    problem = NOISY._replace(velocity_noise=q * PAPER.velocity_noise)
    bound, band = heading_deg * DEG, 10 * ARCMIN
    law = reset_law.schedule(problem, bound, band)
    if len(law.times_s) > 3:
        assert reset_law.schedule_with(problem, bound, band, len(law.times_s)) == law
    first_s = reset_law.levelling_time(problem)
    for resets in range(1, 6):
        found = reset_law.schedule_with(problem, bound, band, resets)
        assert len(found.times_s) == resets and found.times_s[0] == pytest.approx(first_s)
        assert list(found.times_s) == sorted(set(found.times_s))
        if heading_deg > 60 and resets > 1:  # one segment alone takes a large error too long
            assert found.times_s[-1] > 0.9 * problem.ell


@pytest.mark.parametrize(
    "change",
    [
        {"velocity_noise": 0.0},  # no reset ever pays
        {"measurement_noise": 0.0},
        {"north_rate": 1e-9},
        {"gyro_noise": (100 * DEG / 3600) ** 2},  # its sigma alone is wider than the band
    ],
)
def test_filters_without_a_schedule_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(NoSchedule):
        reset_law.schedule(NOISY._replace(**change), 150 * DEG)


# --- in a study

LAW = {"schedule": "law"}
PER_STEP = {
    "filter": {
        "q_accel_ug": 500.0, "q_gyro_deg_per_h": 0.1, "q_reading": "per_step", "r_reading": "psd"
    },
    "study": {"duration_s": 400.0, "window_s": [200, 400]},
}  # fmt: skip


def test_sweep_carries_the_schedule_of_each_variant() -> None:
    study = small_study(
        **PER_STEP, resets=LAW, axes={"latitude_deg": [0.0, 32.0], "q_scale": [0.1, 1.0]}
    )
    times = study.reset_times()
    assert len(set(times)) == 4
    assert times[3] == reset_law.schedule(NOISY, 150 * DEG).times_s
    assert study.values("reset_count") == [None] * 4


@pytest.mark.parametrize("axes", [{}, {"schedule": ["law", "none"]}])
def test_study_stored_with_every_value_loads_again(axes: dict[str, Any]) -> None:
    resets = {} if axes else LAW
    study = small_study(**PER_STEP, resets=resets, axes=axes)
    assert study_from_dict(study_to_tables(study)).reset_times() == study.reset_times()


@pytest.mark.nightly
def test_schedules_by_name_are_swept_beside_times() -> None:
    policies = ["none", "times", "law", "trigger"]
    axes = {"policy": {"schedule": policies, "reset_times_s": [[], [10.0, 60.0], [], []]}}
    study = small_study(**PER_STEP, resets={}, axes=axes)
    none, times, law, trigger = study.reset_times()
    assert (none, times, trigger) == ((), (10.0, 60.0), ()) and law[:3] == (2.0, 4.0, 6.0)
    assert study.values("reset_trigger") == [None, None, None, "linearisation"]
    summary = sinsjax.run(study.replace({"study.draws": 2}), curves=False).summary
    rows = {(row["schedule"], row["draw_id"]): row for row in summary.to_pylist()}
    assert rows["trigger", 0]["triggered_count"] > 0 == rows["law", 0]["triggered_count"]
    assert rows["law", 1]["reset_times_s"] == list(law)
    assert rows["law", 0]["predicted_settle_s"] == pytest.approx(
        rows["law", 0]["settle_10_s"], rel=0.15
    )
    assert rows["none", 0]["predicted_settle_s"] is None is rows["none", 0]["settle_10_s"]
    assert rows["trigger", 0]["predicted_settle_s"] is None
    changes = {"axes.policy": {}, "resets.reset_times_s": list(law), "study.draws": 2}
    given = study.replace(changes | {"resets.reset_velocity_m_per_s": 1.0})
    same = sinsjax.run(given, curves=False).summary.to_pylist()
    assert [row["phi_u_arcmin"] for row in same] == [
        rows["law", draw]["phi_u_arcmin"] for draw in range(2)
    ]


QUIET = {"gyro_noise_deg_per_h": 0.0, "accel_noise_ug": 0.0}
TWICE = {"schedule": ["times", "times", "law"], "reset_times_s": [[10.0], [20.0], []]}


@pytest.mark.parametrize(
    ("tables", "key"),
    [
        ({"resets": LAW | {"reset_times_s": [10.0]}}, "[resets] reset_times_s"),
        (
            {"resets": LAW, "study": {"duration_s": 30.0, "window_s": [2, 30]}, "sensors": QUIET},
            "[resets] schedule: 90 s",
        ),
        ({"resets": LAW, "alignment": {"method": "kalman10"}}, "[resets] schedule"),
        ({"resets": LAW | {"settle_band_arcmin": 0.1}}, "[resets] settle_band_arcmin"),
        ({"resets": LAW, "filter": PER_STEP["filter"] | {"q_accel_ug": 0.0}}, "[resets] schedule"),
        ({"resets": LAW | {"heading_bound_deg": 180.0}}, "[resets] heading_bound_deg"),
        ({"resets": LAW | {"reset_kind": "yaw"}}, "[resets] reset_kind"),
        ({"axes": {"policy": TWICE}}, "[axes.policy] schedule"),
    ],
)
def test_schedule_that_cannot_be_made_is_refused_in_one_line(
    tables: dict[str, Any], key: str
) -> None:
    assert refusal_line(**PER_STEP | tables).startswith(key)


# --- the command


@pytest.fixture
def run_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Any
) -> Command:
    monkeypatch.chdir(tmp_path)
    return command_line(monkeypatch, capsys)


def test_schedule_command_shows_times_and_writes_a_study_with_them(run_command: Command) -> None:
    code, out, error = run_command("schedule", "paper1_resets", "--study", "no_folder/law.toml")
    assert (code, out) == (2, "") and error.count("\n") == 1 and "no_folder/law.toml" in error
    code, out, error = run_command("schedule", "paper1_resets", "--study", "law.toml")
    assert (code, error) == (0, "")
    assert "2, 4, 6, 118 s" in out and re.search(r" 10' from 150 deg: 30\d s", out)
    study = sinsjax.load_study("law.toml")
    assert study.resets.schedule == "law"  # type: ignore[attr-defined]
    assert set(study.reset_times()) == {(2.0, 4.0, 6.0, 118.0)}
    assert run_command("schedule", "paper1_resets", "--study", "law.toml")[0] == 2
    places = ["axes.latitude_deg=[32, 60]", 'axes.specific_force=["measured", "gravity"]']
    code, out, _ = run_command("schedule", "reset_sweep", "--set", places[0], "--set", places[1])
    gravity = [line for line in out.splitlines() if 'specific_force "gravity"' in line]
    assert code == 0 and any("latitude_deg 32, " in line and ": 2, " in line for line in gravity)


def test_plan_has_the_settings_that_its_times_need() -> None:
    study = small_study(**PER_STEP, resets=LAW)
    plan = sinsjax.reset_schedule(study)
    assert plan.settings["reset_velocity_m_per_s"] == 1.0
    changes = {f"resets.{key}": value for key, value in plan.settings.items()}
    listed = study.replace({"resets.schedule": "times"} | changes)
    keys = ("reset_times_s", "reset_velocity_m_per_s")
    assert [*listed.combinations(*keys)] == [*study.combinations(*keys)]


def test_plan_states_what_noise_and_instability_add() -> None:
    """The template sweep: 48 runs of the law from 150 deg have a median of 211 s, 90 % by 434 s."""
    study = sinsjax.load_study(asset_path("configs/templates/sweep.toml"))
    plan = sinsjax.reset_schedule(study)
    assert plan.settling_s < 0.85 * 211 and plan.noisy_s == pytest.approx(211, rel=0.15)
    assert plan.late_s > 434 and plan.median == "163 to 238 s" and plan.left_out == ()
    quiet = sinsjax.reset_schedule("paper1_resets")
    assert quiet.median == "301 s"
    drifting = sinsjax.reset_schedule(study.replace({"sensors.accel_instability_ug": 10.0}))
    assert drifting.left_out == ("accel_instability_ug",)


@pytest.mark.nightly
def test_plan_within_a_small_bound_and_studies_without_one_plan() -> None:
    plan = sinsjax.reset_schedule("paper1_resets", heading_bound_deg=20.0)
    assert plan.times_s == (2.0, 4.0, 6.0)
    inertial = sinsjax.load_study("paper1_resets").replace({"alignment.method": "inertial"})
    several = sinsjax.load_study("reset_sweep").replace({"axes.latitude_deg": [32.0, 60.0]})
    for study in (several, inertial):  # several filters, and none
        with pytest.raises(InputError):
            sinsjax.reset_schedule(study)

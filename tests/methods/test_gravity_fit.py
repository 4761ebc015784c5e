"""The gravity fit against the information bound, a dense least squares, and the truth."""

from typing import Any

import numpy as np
import pytest
from oracles.naive import log, of_quaternion
from scipy import stats
from scipy.spatial.transform import Rotation
from support.synthetic_tables import synthetic_summary

import sinsjax
from sinsjax.execution.results import Results
from sinsjax.methods.gravity_fit.fit import Block, FitParams, solve
from sinsjax.methods.gravity_fit.noise import SensorNoise
from sinsjax.report.verdict import build_short_report
from sinsjax.strapdown import earth
from sinsjax.types import Quat, Vec3

pytestmark = pytest.mark.optimised(False)

DEG = np.pi / 180
TURN = {"turn_times_s": [50.5], "turn_angles_deg": [180.0], "turn_rate_deg_per_s": 10.0}
NOISE = {"gyro_arw_deg_per_sqrt_h": 0.02, "accel_vrw_ug_per_sqrt_hz": 50.0}
DRAWN = {"gyro_bias_deg_per_h": {"normal": [0.0, 1.0]}, "accel_bias_ug": {"normal": [0.0, 500.0]}}


def study(
    draws: int,
    motion: dict[str, Any] | None = None,
    sensors: dict[str, Any] | None = None,
    drawn: dict[str, Any] | None = None,
    **tables: Any,
) -> sinsjax.Study:
    settings = {"duration_s": 120.0, "rate_hz": 10.0, "draws": draws, "seed": 3}
    made = {
        "study": settings | tables.pop("study", {}),
        "earth": {"earth": "wgs84", "latitude_deg": 45.0},
        "motion": {"yaw_center_deg": 70.0} | (TURN if motion is None else motion),
        "sensors": NOISE if sensors is None else sensors,
        "alignment": {"method": "gravity_fit"},
        **tables,
    }
    if drawn is None or drawn:
        made["drawn"] = DRAWN if drawn is None else drawn
    return sinsjax.study_from_dict(made)


def columns(study: sinsjax.Study, *names: str) -> tuple[np.ndarray, ...]:
    table = sinsjax.run(study).summary
    return tuple(np.asarray(table[name], float) for name in names)


CASES = {
    "turned": {},
    "parked": {"motion": {}},
    "swaying": {
        "motion": TURN
        | {"pitch_amplitude_deg": 2.0, "pitch_period_s": 6.0}
        | {"roll_amplitude_deg": 3.0, "roll_period_s": 8.0}
    },
    "carousel": {
        "motion": {"turn_times_s": [0.0], "turn_angles_deg": [1e6], "turn_rate_deg_per_s": 6.0}
    },
    "scale": {
        "drawn": DRAWN
        | {"gyro_scale_ppm": {"normal": [0.0, 300.0]}}
        | {"gyro_misalignment_arcsec": {"normal": [0.0, 206.0]}}
    },
    "drift": {
        "sensors": NOISE | {"gyro_instability_deg_per_h": 0.3, "gyro_instability_time_s": 60.0}
    },
}


@pytest.mark.nightly
@pytest.mark.parametrize("case", CASES)
def test_errors_and_sigma_are_those_of_information_bound(case: str) -> None:
    given = study(64, **CASES[case])
    bound = sinsjax.information_bound(given)["bound_u_arcmin"].to_pylist()[-1]
    error, sigma, nees, misfit = columns(
        given, "phi_u_arcmin", "sigma_u_arcmin", "nees", "fit_misfit"
    )
    np.testing.assert_allclose(sigma, bound, rtol=0.02)
    low, high = stats.chi2.ppf([0.001, 0.999], 64)
    assert low < np.sum((error / bound) ** 2) < high
    low, high = stats.chi2.ppf([0.001, 0.999], 3 * 64)
    assert low < np.sum(nees) < high
    assert abs(misfit.mean() - 1) < 0.05


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("motion", "sensors"),
    [
        ({"lever_arm_m": [2.0, 1.0, 0.5]}, {"gyro_quantisation_arcsec": 5.0}),
        ({"yaw_amplitude_deg": 3.0, "yaw_period_s": 3.3}, {"accel_rrw_ug_per_sqrt_h": 5e3}),
    ],
)
def test_swing_of_an_arm_and_drifts_on_a_base_that_sways_leave_the_own_sigma(
    motion: dict[str, Any], sensors: dict[str, Any]
) -> None:
    """Of an arm, with rounded angles at the rate of an IMU, and of a drift in yaw."""
    given = CASES["swaying"]["motion"] | motion, NOISE | sensors
    nees, misfit = columns(study(16, *given, study={"rate_hz": 50.0}), "nees", "fit_misfit")
    assert misfit.max() < 1.25 and np.sum(nees) < stats.chi2.ppf(0.999, 3 * 16)


@pytest.mark.nightly
def test_heading_depends_neither_on_later_data_nor_on_the_length_of_records() -> None:
    ends = "phi_u_arcmin", "sigma_u_arcmin"
    whole = study(4, study={"report_times_s": [90.0]})
    at = columns(whole, "phi_u_at_90_arcmin", "sigma_u_at_90_arcmin")
    np.testing.assert_allclose(at, columns(study(4, study={"duration_s": 90.0}), *ends), rtol=1e-6)
    fine = study(4, study={"record_interval_s": 0.5})  # joined to blocks of a second
    np.testing.assert_allclose(columns(fine, *ends), columns(study(4), *ends), rtol=1e-6)


@pytest.mark.parametrize("truth", [True, False])
def test_doubts_about_fits_are_cautions_of_every_verdict(truth: bool) -> None:
    """Of 16 runs, of which two have one column beyond its limit."""
    given, none = study(16), np.zeros(16)
    usual = {"fit_misfit": 1.0, "fit_prior_ratio": 2.9, "fit_change": 0.1}
    columns = {name: none + value for name, value in usual.items()}
    columns |= {f"fit_gyro_bias_{axis}_deg_per_h": none for axis in ("right", "front", "up")}
    for name in ("none", *usual):
        changed = np.where(np.arange(16) < 2, 3.14, columns.get(name, none))
        made = columns | ({} if name == "none" else {name: changed})
        values = {column: value.tolist() for column, value in made.items()}
        summary = synthetic_summary(given, truth=truth, **values)
        facts = build_short_report(Results(given, None, tables={"summary": summary})).facts
        doubts = [fact.text for fact in facts if fact.is_caution and "the fit" in fact.text]
        assert len(doubts) == (name != "none")
        assert all("3.1" in text and text.endswith("(2 of 16 fits)") for text in doubts)


def test_linear_pass_is_dense_least_squares() -> None:
    """One pass over blocks at rest, with the covariance of all of them written out.

    The beliefs about the biases take them for smaller than they are, by as much as that says.
    """
    gyro, accel, length, count = 6e-6, 5e-4, 1.0, 40
    place = earth.place(earth.wgs84(), 45 * DEG)
    rate = np.hypot(place.rate_n, place.rate_u)
    biases = np.array([4e-6, -3e-6, 2e-6])
    pole = np.array([0.0, place.rate_n, place.rate_u])
    times = np.arange(count + 1) * length
    c = Rotation.from_rotvec(np.outer(times, pole)) * Rotation.from_euler("Z", 0.7)
    turns = c[:-1].inv() * c[1:]
    middle = Rotation.from_rotvec(np.outer((times[:-1] + times[1:]) / 2, pole))
    force = c[:-1].inv().apply(middle.apply([0.0, 0.0, place.gravity * length]))
    turn = Rotation.from_rotvec(turns.as_rotvec() + biases * length).as_quat(scalar_first=True)
    still = Vec3(0.0, 0.0, 0.0)
    pairs = zip(turn, force, strict=True)
    rows = np.stack([Block.of_turn(Quat(*q), Vec3(*f), still).row() for q, f in pairs])
    sigma_b, sigma_a = 5e-6, 5e-3
    params = FitParams(SensorNoise(np.float64(gyro), np.float64(accel)), sigma_b, sigma_a)
    solution = solve(params, place, rows, np.asarray(count), length)

    j = np.arange(count) + 0.5
    t = j * length
    gh, (cos, sin) = place.gravity * length, (place.rate_n / rate, place.rate_u / rate)
    level = cos * np.sin(rate * t) + 1j * cos * sin * (1 - np.cos(rate * t))
    up = 1 - cos**2 * (1 - np.cos(rate * t))
    # l: level at the first sample, along the axes of the body; c = e^{-0.7 i}
    along = np.exp(-0.7j) * level
    p = t[:, None] * np.eye(3)[:, None]  # (axis, block, component)
    x = [1j * gh * along, -1j * gh * up, gh * up]
    x += [gh * (up * (q[:, 1] - 1j * q[:, 0]) + 1j * along * q[:, 2]) for q in p]
    x += [length + 0 * along, 1j * length + 0 * along, 0 * along]
    walk = np.minimum.outer(t, t) - np.eye(count) * length / 6
    noise = (gh * gyro) ** 2 * walk + accel**2 * length * np.eye(count)
    x = np.stack(x, axis=1)
    information = (x.conj().T @ np.linalg.solve(noise, x)).real
    information += np.diag([0, 1, 1, *[sigma_b**-2] * 3, *[sigma_a**-2] * 3])
    covariance = np.linalg.inv(information)
    heading = np.array([1, 0, 0, 0, 0, times[-1], 0, 0, 0])
    expected = heading @ covariance @ heading + gyro**2 * times[-1]
    np.testing.assert_allclose(solution.covariance.uu, expected, rtol=2e-3)
    found = of_quaternion(np.array(solution.attitude))
    off = log(c[0].as_matrix() @ found.T)
    pull = np.array([0, 0, 0, *(biases / sigma_b**2), 0, 0, 0])
    assert np.abs(off[:2]).max() < 1e-5
    assert off[2] == pytest.approx(-(heading @ covariance @ pull), rel=0.02)


def test_lever_arm_that_moves_at_first_sample_leaves_the_attitude() -> None:
    """Blocks without errors of a base that sways about a distant point, and never stands still."""
    length, count, arm = 1.0, 40, np.array([2.0, 1.0, 0.5])
    place = earth.place(earth.wgs84(), 45 * DEG)
    pole = np.array([0.0, place.rate_n, place.rate_u])
    times = np.arange(count + 1) * length
    phase = 2 * np.pi * times / 7.3 + 0.7
    pitch, pitch_rate = 0.03 * np.sin(phase), 0.03 * 2 * np.pi / 7.3 * np.cos(phase)
    sway = Rotation.from_euler("Z", 0.7) * Rotation.from_euler("X", pitch[:, None])
    in_space = Rotation.from_rotvec(np.outer(times, pole))
    c = in_space * sway
    rate = np.stack([pitch_rate, 0 * times, 0 * times], axis=1) + sway.inv().apply(pole)
    velocity = c.apply(np.cross(rate, arm))
    middle = Rotation.from_rotvec(np.outer((times[:-1] + times[1:]) / 2, pole))
    gained = middle.apply([0.0, 0.0, place.gravity * length]) + np.diff(velocity, axis=0)
    turn = (c[:-1].inv() * c[1:]).as_quat(scalar_first=True)
    triples = zip(turn, c[:-1].inv().apply(gained), rate[1:], strict=True)
    rows = np.stack([Block.of_turn(Quat(*q), Vec3(*f), Vec3(*w)).row() for q, f, w in triples])
    noise = SensorNoise(np.float64(6e-6), np.float64(5e-4))
    params = FitParams(noise, np.float64(1e-9), np.float64(1e-7), lever_arm=np.float64(3.0))
    solution = solve(params, place, rows, np.asarray(count), length)
    off = log(c[0].as_matrix() @ of_quaternion(np.array(solution.attitude)).T)
    assert np.abs(off[:2]).max() < 1e-7 and abs(off[2]) < 1e-4
    assert solution.misfit < 0.01


def blocks_of_positions(bias: np.ndarray, count: int = 120) -> tuple[np.ndarray, Rotation]:
    """Return blocks of a second of a base turned by 90 deg each 30 s, and its last attitude in n0.

    Their rotations and velocity increments are those of gyros with a bias, at 20 samples a second.
    """
    place, dt, rate = earth.place(earth.wgs84(), 45 * DEG), 0.05, 10 * DEG
    pole = np.array([0.0, place.rate_n, place.rate_u])
    step = np.arange(count * 20 + 1)
    turned = sum(np.clip(step * dt - start, 0.0, 9.0) for start in (30.0, 60.0, 90.0)) * rate
    c = Rotation.from_rotvec(np.outer(step * dt, pole))
    c = c * Rotation.from_euler("z", (0.7 + turned)[:, None])
    middle = Rotation.from_rotvec(np.outer((step[:-1] + 0.5) * dt, pole))
    turns = (c[:-1].inv() * c[1:]).as_rotvec() + bias * dt
    force = c[:-1].inv().apply(middle.apply([0.0, 0.0, place.gravity * dt]))
    rows = []
    for block in np.arange(count):
        turn, dv = Rotation.identity(), np.zeros(3)
        for n in range(20 * block, 20 * block + 20):
            dv = dv + (turn * Rotation.from_rotvec(bias * dt / 2)).apply(force[n])
            turn = turn * Rotation.from_rotvec(turns[n])
        one = Quat(*turn.as_quat(scalar_first=True))
        rows.append(Block.of_turn(one, Vec3(*dv), Vec3(0.0, 0.0, 0.0)).row())
    return np.stack(rows), c[-1]


@pytest.mark.parametrize(
    ("bias", "prior", "most", "doubts"),
    [
        ([1.0, -1.0, 1.0], 1.0, 0.1, set()),
        ([900.0, 900.0, 900.0], 900.0, 1.0, set()),
        ([4.0, 0.0, 0.0], 1.0, 1.0, {"prior_ratio"}),
        ([5e4, -5e4, 5e4], 900.0, np.inf, {"prior_ratio", "misfit", "change"}),
    ],
)
def test_large_gyro_bias_leaves_the_right_heading_or_a_doubt(
    bias: list[float], prior: float, most: float, doubts: set[str]
) -> None:
    """900 deg/h turn l by 30 deg in 120 s: the linear first pass is far off, and three passes too.

    ``most`` is the largest heading error, in sigma, of data without noise.
    """
    rows, end = blocks_of_positions(np.array(bias) * DEG / 3600)
    noise = SensorNoise(np.float64(0.01 * DEG / 60), np.float64(5e-4))
    params = FitParams(noise, np.float64(prior * DEG / 3600), np.float64(5e-3))
    place = earth.place(earth.wgs84(), 45 * DEG)
    solution = solve(params, place, rows, np.asarray(len(rows)), 1.0)
    found = of_quaternion(np.array(solution.attitude)) @ of_quaternion(np.array(solution.carried))
    off = log(end.as_matrix() @ found.T)[2] / np.sqrt(float(solution.covariance.uu))
    limits = {"prior_ratio": 3.0, "misfit": 3.0, "change": 1.0}
    assert {name for name, limit in limits.items() if getattr(solution, name) > limit} == doubts
    assert abs(off) < most


@pytest.mark.parametrize(
    ("tables", "key"),
    [
        ({"study": {"record_interval_s": 5.0}}, "[study] record_interval_s"),
        ({"gravity_fit": {"fit_gyro_bias_deg_per_h": 0.0}}, "fit_gyro_bias_deg_per_h"),
        ({"sensors": {"accel_vrw_ug_per_sqrt_hz": 50.0}}, "fit_gyro_arw_deg_per_sqrt_h"),
    ],
)
def test_what_it_cannot_do_is_refused(tables: dict[str, Any], key: str) -> None:
    with pytest.raises(sinsjax.InputError) as caught:
        study(2, **tables)
    assert key in str(caught.value) and "\n" not in str(caught.value)

"""The numbers of each method, from the units of a study; loops that are refused."""

import copy
from typing import Any

import numpy as np
import pytest
from support.studies import with_paper_values

from sinsjax.engine import build
from sinsjax.errors import InputError
from sinsjax.study.load import study_from_dict

G, R = 9.8, 6378165.0
BASE: dict[str, Any] = {
    "study": {"name": "some", "duration_s": 20.0, "rate_hz": 100.0, "draws": 1, "window_s": [4, 6]},
    "earth": {"latitude_deg": 32.057313, "radius_m": R},
    "motion": {"yaw_center_deg": 0.0},
    "alignment": {"method": "compass"},
}
PRINTED = {
    "level_gains": [0.06, 1040.33306122, 0.000081632653],
    "azimuth_gains": [0.02, 259.3332653, 4.082e-9, 0.02],
}
"""As [P2] section 3.1 prints them; the K3 of the level is 50 times what its formula gives."""


def numbers(**tables: Any) -> Any:
    """The method's numbers of a study: leaves (variants, ...)."""
    data = copy.deepcopy(BASE)
    for name, table in tables.items():
        data[name] = data.get(name, {}) | table if isinstance(table, dict) else table
    (part,) = build.parts(study_from_dict(with_paper_values(data)))
    return part.group.variants.method


def refusal(**tables: Any) -> str:
    with pytest.raises(InputError) as caught:
        numbers(**tables)
    line = str(caught.value)
    assert len(line.splitlines()) == 1
    return line


def all_of(gains: Any) -> np.ndarray:
    return np.stack(gains, axis=-1)


def test_default_compass_gains_match_paper2_except_level_k3() -> None:
    made = numbers()
    np.testing.assert_allclose(all_of(made.level)[0][:2], PRINTED["level_gains"][:2], rtol=5e-11)
    np.testing.assert_allclose(made.level.k3, PRINTED["level_gains"][2] / 50, rtol=1e-8)
    np.testing.assert_allclose(all_of(made.azimuth)[0], PRINTED["azimuth_gains"], rtol=1e-4)


def test_given_compass_gains_are_used_unchanged() -> None:
    own = {"level_gains": [0.05, 1000.0, 1.0e-6], "azimuth_gains": [0.03, 300.0, 5e-9, 0.01]}
    made = numbers(compass=own)
    np.testing.assert_array_equal(all_of(made.level), [own["level_gains"]])
    np.testing.assert_array_equal(all_of(made.azimuth), [own["azimuth_gains"]])


def test_compass_gains_follow_sigma_damping_and_adjustment_time() -> None:
    """Gains whose roots are -sigma and -sigma +- j sigma sqrt(1/xi^2 - 1)."""
    compass = {"level_sigma_per_s": 0.03, "level_damping": 0.6}
    made = numbers(compass=compass | {"azimuth_sigma_per_s": 0.02, "azimuth_damping": 0.8})
    for sigma, xi, gains in ((0.03, 0.6, made.level), (0.02, 0.8, made.azimuth)):
        pair = [1.0, 2 * sigma, (sigma / xi) ** 2]
        rest = [1.0, sigma] if gains is made.level else pair
        k1, k2, k3, *k4 = all_of(gains)[0]
        lag = k4[0] if k4 else 0.0
        q2 = [1.0, k1, (1 + k2) * G / R]
        whole = np.polyadd(
            np.polymul([1.0, lag] if k4 else [1.0], np.polymul([1.0, 0.0], q2)), G * k3
        )
        np.testing.assert_allclose(whole, np.polymul(pair, rest), rtol=1e-9)
    period = numbers(compass={"level_adjustment_s": 150.0, "azimuth_adjustment_s": 450.0})
    np.testing.assert_allclose(period.level.k1, 3 * 2 * np.pi / 150)
    np.testing.assert_allclose(period.azimuth.k1, 2 * 2 * np.pi / 450)
    reading = {"adjustment_reading": "settling", "adjustment_remainder": np.exp(-3.0)}
    settling = numbers(compass={"level_adjustment_s": 150.0} | reading)
    np.testing.assert_allclose(settling.level.k1, 0.06)
    np.testing.assert_allclose(settling.azimuth.k1, 0.02)


def test_compass_schedules_in_seconds_or_passes_become_samples() -> None:
    times = numbers(
        compass={"level_time_s": 3.21},
        cases=[
            {"sigma_factors": [4.0, 2.0, 1.0], "sigma_times_s": [5.0, 7.5]},
            {"sigma_factors": [3.0], "sigma_times_s": []},
        ],
    )
    np.testing.assert_array_equal(times.azimuth_from, [321, 321])
    np.testing.assert_array_equal(times.pace.samples, [[500, 750], [np.inf, np.inf]])
    # A piece that never begins has some value.
    np.testing.assert_array_equal(times.pace.values, [[4, 2, 1], [3, 1, 1]])
    counted = numbers(
        passes={"stored_s": 4.0},
        compass={"level_passes": 2, "sigma_factors": [4.0, 2.0, 1.0], "sigma_passes": [1, 3]},
    )
    np.testing.assert_array_equal(counted.azimuth_from, [800])
    np.testing.assert_array_equal(counted.pace.samples, [[400, 1200]])


def test_compass_turn_rules_set_signs_and_smoothing() -> None:
    rules = {
        # velocity, integral, rate, reflection
        "reflect": (-1, -1, 1, 1),
        "velocity": (-1, -1, 1, 0),
        "velocity_and_rate": (-1, -1, -1, 0),
        "velocity_drop_rate": (-1, -1, 0, 0),
        "restart": (0, 0, 0, 0),
        "keep": (1, -1, 1, 0),
    }
    passes = {"stored_s": 4.0, "turn_smoothing_s": 0.5}
    made = numbers(passes=passes, axes={"turn": list(rules)})
    np.testing.assert_array_equal(all_of(made.reversal), list(rules.values()))
    # Two stages of half the delay each: a force that grows steadily is seen 0.5 s late.
    np.testing.assert_allclose(made.smoothing, 1 - np.exp(-0.01 / 0.25))
    late = 2 * 0.01 * (1 - made.smoothing) / made.smoothing
    np.testing.assert_allclose(late, 0.5, rtol=0, atol=0.01)


def test_turn_covariance_rules_set_filter_turn_factors() -> None:
    made = numbers(
        alignment={"method": "kalman5"},
        passes={"stored_s": 4.0, "turn_inflation": 3.0},
        axes={"turn_covariance": ["carried", "inflated", "reset"]},
    )
    # keep, keep_yaw, renew, renew_yaw
    np.testing.assert_array_equal(all_of(made.reversal), [[1, 1, 0, 0], [3, 3, 0, 0], [0, 0, 1, 1]])


# Filters

UG, DEG = 9.8e-6, np.pi / 180
DEG_PER_H = DEG / 3600
STATES = ("dve", "dvn", "phi_e", "phi_n", "phi_u", "nabla_x", "nabla_y", "eps_x", "eps_y", "eps_z")


def of_filter(method: str = "kalman10", **tables: Any) -> Any:
    return numbers(alignment={"method": method}, **tables)


@pytest.mark.parametrize("method", ["kalman5", "kalman10"])
@pytest.mark.parametrize(
    ("key", "value", "states", "sigma"),
    [
        ("reset_velocity_m_per_s", 0.3, "dve dvn", 0.3),
        ("reset_level_deg", 2.0, "phi_e phi_n", 2.0 * DEG),
        ("reset_yaw_deg", 30.0, "phi_u", 30.0 * DEG),
        ("reset_accel_bias_ug", 70.0, "nabla_x nabla_y", 70.0 * UG),
        ("reset_gyro_bias_deg_per_h", 0.02, "eps_x eps_y eps_z", 0.02 * DEG_PER_H),
    ],
)
def test_reset_keys_set_reset_variance_of_their_states(
    method: str, key: str, value: float, states: str, sigma: float
) -> None:
    """A key of its own for each kind of state; the others are reset to what they began with."""
    plain, own = of_filter(method), of_filter(method, resets={key: value})
    assert len(plain.p0) == {"kalman5": 5, "kalman10": 10}[method]
    np.testing.assert_array_equal(plain.reset_to, plain.p0)
    np.testing.assert_array_equal(own.p0, plain.p0)
    for state, start, to in zip(STATES, plain.p0, own.reset_to, strict=False):
        expected = [sigma**2] if state in states.split() else start
        np.testing.assert_allclose(to, expected, rtol=1e-14)
    np.testing.assert_array_equal(
        all_of(own.resets.covariance_reset), all_of(plain.resets.covariance_reset)
    )


@pytest.mark.parametrize("readings", [{}, {"q_reading": "psd", "r_reading": "psd"}])
def test_q_scale_and_r_scale_multiply_only_q_and_r(readings: dict[str, str]) -> None:
    plain = of_filter(filter=readings)
    for key, names in (("q_scale", {"q"}), ("r_scale", {"r"})):
        made = of_filter(filter=readings, axes={key: [1.0, 0.25, 4.0]})
        for name in ("p0", "q", "r", "reset_to"):
            before = np.array(getattr(plain, name))
            factors = np.array([1.0, 0.25, 4.0]) if name in names else np.ones(3)
            np.testing.assert_array_equal(getattr(made, name), before * factors)


def test_reset_trigger_times_are_converted_to_samples() -> None:
    trigger = {"reset_trigger": "innovation", "trigger_threshold": 9.5, "trigger_until_s": 12.34}
    given = {"trigger_window_s": 2.0, "trigger_refractory_s": 0.5, "trigger_most": 3}
    made = of_filter(resets=trigger | given).trigger
    assert made._asdict() == {
        "threshold": [9.5],
        "window": [200.0],
        "refractory": [50.0],
        "most": [3.0],
        "until": [1234.0],
        "at_feedback": None,
    }
    swept = of_filter(resets=trigger, axes={"reset_at_feedback": [False, True]}).trigger
    assert swept.at_feedback.tolist() == [0.0, 1.0]
    # What is left out.
    short = {key: trigger[key] for key in ("reset_trigger", "trigger_threshold")}
    assert all_of(of_filter(resets=short).trigger[:-1]).tolist() == [[9.5, 1000, 500, 10, np.inf]]
    for none in ({}, {"reset_trigger": "none"}):
        assert of_filter(resets=none).trigger is None


# Loops that are refused


def test_printed_level_gains_are_refused_with_their_roots() -> None:
    start, _, roots = refusal(compass={"level_gains": PRINTED["level_gains"]}).partition(" are ")
    assert start.startswith("some: [compass] level_gains: [0.06, 1040.33306122, 8.1632653e-05] ")
    k1, k2, k3 = PRINTED["level_gains"]
    found = np.roots([1, k1, (1 + k2) * G / R, G * k3])
    shown = [complex(text) for text in roots.partition(" 1/s ")[0].split(", ")]
    np.testing.assert_allclose(np.sort_complex(shown), np.sort_complex(found), rtol=1e-3)


@pytest.mark.parametrize(
    ("compass", "key"),
    [
        ({"level_gains": PRINTED["level_gains"]}, "level_gains"),
        ({"azimuth_gains": [0.02, 259.0, -4e-9, 0.02]}, "azimuth_gains"),
        ({"azimuth_gains": [0.0, 0.0, 0.0, 0.0]}, "azimuth_gains"),
        # Too fast for the sample time.
        ({"level_sigma_per_s": 100.0}, "level_sigma_per_s"),
        ({"level_adjustment_s": 0.01}, "level_adjustment_s"),
        ({"azimuth_adjustment_s": 0.01}, "azimuth_adjustment_s"),
        ({"level_gains": [300.0, 2e10, 1e5]}, "level_gains"),
        # The quickest piece decides.
        ({"sigma_factors": [1.0, 1e4, 1.0], "sigma_times_s": [5.0, 6.0]}, "azimuth_sigma_per_s"),
    ],
)
def test_loop_that_is_unstable_or_too_fast_is_refused_unless_allowed(
    compass: dict[str, Any], key: str
) -> None:
    assert refusal(compass=compass).startswith(f"some: [compass] {key}: ")
    assert numbers(compass=compass | {"allow_unstable": True})


def test_study_with_one_unstable_variant_is_refused() -> None:
    cases = [{"level_gains": [0.05, 1000.0, 1e-6]}, {"level_gains": PRINTED["level_gains"]}]
    allowed = [case | {"allow_unstable": i == 1} for i, case in enumerate(cases)]
    assert numbers(cases=allowed)
    wrong = [case | {"allow_unstable": i == 0} for i, case in enumerate(cases)]
    for refused in (cases, wrong):
        assert refusal(cases=refused).startswith("some: [cases] level_gains: [0.06, ")


def test_unstable_compass_is_refused_in_study_with_filters() -> None:
    """A part of filters beside a part of compass runs has none; a refusal comes before any run."""
    compass = {"level_gains": PRINTED["level_gains"]}
    data = with_paper_values(
        BASE | {"alignment": {}, "axes": {"method": ["kalman5", "compass"]}, "compass": compass}
    )
    with pytest.raises(InputError, match="level_gains"):
        build.parts(study_from_dict(data))
    assert len(list(build.parts(study_from_dict(data | {"compass": {}})))) == 2


def test_nonfinite_compass_gain_is_refused() -> None:
    line = refusal(compass={"level_adjustment_s": 1e-300}, study={"unchecked": True})
    assert line.startswith("some: [compass] level_adjustment_s: 1e-300 ")

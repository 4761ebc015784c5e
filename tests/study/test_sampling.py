"""Values of drawn keys: distributions, streams, Sobol points, lists and grids."""

import itertools
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from support.refusals import assert_named, refused
from support.studies import BASE, with_paper_values

from sinsjax.errors import InputError
from sinsjax.study import sampling
from sinsjax.study.keys import SECTION_OF
from sinsjax.study.load import study_from_dict
from sinsjax.study.schema import INITIAL_NUMBERS, NUMBERS_DRAWN, SensorsSection
from sinsjax.study.study import Study

MANY = 1 << 14
LAWS: dict[str, Any] = {
    "phi_e0_deg": {"uniform": [-5, 5]},
    "phi_n0_deg": {"uniform": [-5, 5]},
    "phi_u0_deg": {"normal": [2, 10]},
    "gyro_bias_deg_per_h": {"normal": [0, 0.01]},
    "accel_misalignment_arcsec": {"uniform": [0, 1]},
    "yaw_center_deg": {"values": [0, 90, 180]},
}


def make_study(laws: dict[str, Any] | None, *, seed: int = 1, **changes: Any) -> Study:
    """A small study that gives no key but the required ones and draws some."""
    data: dict[str, Any] = {name: dict(BASE[name]) for name in ("study", "earth")}
    data["motion"] = {"yaw_center_deg": 10.0}
    data["study"]["seed"] = seed
    for key in laws if isinstance(laws, dict) else ():
        data.get(SECTION_OF.get(key, ""), {}).pop(key, None)
    if laws is not None:
        data["drawn"] = laws
    for name, change in changes.items():
        data[name] = data.get(name, {}) | change
    return study_from_dict(with_paper_values(data), "s.toml")


def drawn(laws: dict[str, Any], count: int = MANY, **more: Any) -> dict[str, np.ndarray]:
    return sampling.drawn_values(make_study(laws, **more), count)


def sobol(laws: dict[str, Any]) -> dict[str, Any]:
    return {"sampling": "sobol"} | laws


BOTH = pytest.mark.parametrize("laws", [LAWS, sobol(LAWS)], ids=["random", "sobol"])


def test_drawn_keys_need_as_many_numbers_as_their_section():
    for key, numbers in NUMBERS_DRAWN.items():
        one = make_study(
            {key: {"values": [[0.5] * numbers if numbers > 1 else 0.5]}}, **periods(key)
        )
        assert sampling.drawn_values(one, 2)[key].shape == ((2, numbers) if numbers > 1 else (2,))
        with pytest.raises(InputError, match="must be a number|required"):
            make_study({key: {"values": [[0.5, 0.6]]}}, **periods(key))
    assert NUMBERS_DRAWN.keys() >= {*SensorsSection.model_fields, *INITIAL_NUMBERS}


def periods(key: str) -> dict[str, Any]:
    """The period that a drawn amplitude needs, and the R of a drawn surge."""
    if key == "surge_m_per_s":
        return {"filter": {"r_velocity_m_per_s": 0.1}}
    swung = key.endswith("_amplitude_deg")
    return {"motion": {f"{key.partition('_')[0]}_period_s": 5.0}} if swung else {}


# Distributions


@BOTH
def test_drawn_values_follow_their_distributions(laws):
    values = drawn(laws)
    for key in ("phi_e0_deg", "phi_n0_deg"):
        assert stats.kstest(values[key], stats.uniform(-5, 10).cdf).pvalue > 1e-3
    assert stats.kstest(values["phi_u0_deg"], stats.norm(2, 10).cdf).pvalue > 1e-3
    for axis in values["gyro_bias_deg_per_h"].T:
        assert stats.kstest(axis, stats.norm(0, 0.01).cdf).pvalue > 1e-3
    for axis in values["accel_misalignment_arcsec"].T:
        assert stats.kstest(axis, stats.uniform(0, 1).cdf).pvalue > 1e-3
        assert 0 < axis.min() < 10 / MANY and 1 - 10 / MANY < axis.max() < 1


@BOTH
def test_drawn_values_are_uncorrelated_across_keys_axes_and_draws(laws):
    """Of other keys, of the other axes of a vector, and of the draw before."""
    values = drawn(laws)
    columns = np.column_stack([rows for key, rows in values.items() if key != "yaw_center_deg"])
    n = columns.shape[1]
    found = np.corrcoef(columns[:-1], columns[1:], rowvar=False)[:n] - np.eye(n, 2 * n)
    if "sampling" in laws:
        found = found[:, :n]  # a Sobol point avoids the one before it
    assert np.abs(found).max() < 4.5 / np.sqrt(MANY)


def test_every_dyadic_interval_holds_one_sobol_point():
    """The defining property of the sequence, which the scrambling keeps, in every dimension."""
    laws = sobol({"gyro_scale_ppm": {"uniform": [0, 1]}, "phi_u0_deg": {"uniform": [0, 1]}})
    values = drawn(laws, 64)
    for column in (*values["gyro_scale_ppm"].T, values["phi_u0_deg"]):
        np.testing.assert_array_equal(np.sort(np.floor(column * 64)), np.arange(64))


@pytest.mark.parametrize("end", [0.0, 1 - 2.0**-30])
def test_extreme_sobol_points_give_finite_values(end, monkeypatch):
    """The lowest and the highest point that the sequence has."""
    monkeypatch.setattr(stats.qmc.Sobol, "random", lambda self, n: np.full((n, self.d), end))
    values = drawn(sobol(LAWS), 4)
    assert np.abs(values["phi_u0_deg"] - 2) == pytest.approx(10 * stats.norm.isf(2.0**-31))
    assert np.all(np.abs(values["phi_e0_deg"]) < 5)


# Streams


@BOTH
@given(first=st.integers(0, 70), count=st.integers(0, 70))
def test_draws_do_not_depend_on_block(laws, first, count):
    study = make_study(
        laws | {"pitch_center_deg": {"grid": [0, 1]}, "roll_center_deg": {"grid": [0, 10, 20]}},
        study={"draws": 6},
    )
    whole = sampling.drawn_values(study, 140)
    for key, rows in sampling.drawn_values(study, count, first=first).items():
        np.testing.assert_array_equal(rows, whole[key][first : first + count])


def test_adding_drawn_keys_keeps_values_of_others():
    alone = drawn({"phi_e0_deg": LAWS["phi_e0_deg"]}, 100)["phi_e0_deg"]
    later = dict(reversed(LAWS.items()))
    np.testing.assert_array_equal(drawn(later, 100)["phi_e0_deg"], alone)


@BOTH
def test_seed_determines_drawn_values(laws):
    one, same, other = (drawn(laws, 100, seed=seed) for seed in (1, 1, 2**63 - 1))
    for key in LAWS:
        np.testing.assert_array_equal(one[key], same[key])
        assert np.array_equal(one[key], other[key]) == (key == "yaw_center_deg")


@pytest.mark.parametrize(
    ("laws", "level", "heading"),
    [
        (
            LAWS,
            [-3.034434542285841, -3.3844064925443593, 4.990089562075395],
            [5.91668242042428, 5.098483037369475, 2.98800778190141],
        ),
        (
            sobol(LAWS),
            [-2.1383083751425147, 4.9912525760009885, 0.2523040445521474],
            [4.233272388687993, 1.438813417016906, 20.259318624579052],
        ),
    ],
    ids=["random", "sobol"],
)
def test_drawn_values_match_frozen_reference(laws, level, heading):
    """Stored results rest on them."""
    values = drawn(laws, 3)
    np.testing.assert_allclose(values["phi_e0_deg"], level, rtol=1e-14)
    np.testing.assert_allclose(values["phi_u0_deg"], heading, rtol=1e-12)


# Lists and grids


def test_value_list_is_cycled_over_draws():
    values = drawn({"yaw_center_deg": {"values": [0, 90, 180]}}, 8)
    np.testing.assert_array_equal(values["yaw_center_deg"], [0, 90, 180, 0, 90, 180, 0, 90])
    laws = {"gyro_bias_deg_per_h": {"values": [0.5, [1, 2, 3]]}}
    rows = [[0.5, 0.5, 0.5], [1, 2, 3], [0.5, 0.5, 0.5]]
    np.testing.assert_array_equal(drawn(laws, 3)["gyro_bias_deg_per_h"], rows)


@given(lengths=st.lists(st.integers(1, 4), min_size=1, max_size=4), count=st.integers(1, 300))
def test_grids_cycle_through_their_product(lengths, count):
    keys = ("latitude_deg", "roll_center_deg", "phi_u0_deg", "accel_bias_ug")
    grids = {key: [float(i) for i in range(n)] for key, n in zip(keys, lengths, strict=False)}
    laws: dict[str, Any] = {key: {"grid": grid} for key, grid in grids.items()}
    laws["ve0_m_per_s"] = {"uniform": [0, 1]}
    values = drawn(laws, count, study={"draws": 256})
    points = itertools.islice(itertools.cycle(itertools.product(*grids.values())), count)
    rows = [values[key].reshape(count, -1)[:, -1] for key in grids]
    assert list(zip(*rows, strict=True)) == list(points)


@given(lengths=st.lists(st.integers(1, 4), min_size=1, max_size=3), count=st.integers(1, 40))
def test_fewer_draws_have_the_same_values(lengths, count):
    keys = ("roll_center_deg", "phi_u0_deg", "accel_bias_ug")
    laws: dict[str, Any] = {
        key: {"grid": [float(i) for i in range(n)]} for key, n in zip(keys, lengths, strict=False)
    }
    laws |= LAWS | {k: laws[k] for k in keys[: len(lengths)]}
    whole = make_study(laws, study={"draws": 64})
    assert whole.drawn
    fewer = make_study(sampling.truncate_drawn_table(whole.drawn, count), study={"draws": count})
    for key, rows in sampling.drawn_values(fewer, count).items():
        np.testing.assert_array_equal(rows, sampling.drawn_values(whole, count)[key])


# What a study refuses to draw


def refusal_line(laws: Any, **changes: Any) -> str:
    with pytest.raises(InputError) as caught:
        make_study(laws, **changes)
    line = str(caught.value)
    assert len(line.splitlines()) == 1 and line.startswith("s.toml: ")
    return line.removeprefix("s.toml: ")


@refused("""
alignment.phi_e0_deg = 1.0                   -> [drawn] phi_e0_deg: [alignment]
axes.phi_e0_deg = [1.0]                      -> [drawn] phi_e0_deg: [axes]
axes.level = {phi_e0_deg = [1.0], phi_n0_deg = [1.0]}    -> [drawn] phi_e0_deg: [axes.level]
""")
def test_drawn_key_given_elsewhere_is_refused(refusal):
    law = {"phi_e0_deg": {"uniform": [0, 1]}}
    refusal.check(refusal_line(law, **refusal.tables))
    data = {**BASE, "alignment": {}, "drawn": law, "cases": [{"phi_e0_deg": 1.0}]}
    with pytest.raises(InputError) as caught:
        study_from_dict(data, "s.toml")
    assert_named(str(caught.value), "s.toml: [drawn] phi_e0_deg", "[cases]")


@refused("""
drawn = 3                                    -> [drawn]
drawn = {sampling = "sobol"}                 -> [drawn]
drawn = {sampling = "halton", phi_e0_deg.uniform = [0, 1]}
    -> [drawn] sampling: 'random' 'sobol' 'halton'
drawn.phi_e_deg.uniform = [0, 1]             -> [drawn] phi_e_deg: phi_e0_deg
drawn.case.values = ["a"]                    -> [drawn] case
drawn.height_m.uniform = [0, 1]              -> [drawn] height_m: latitude_deg [motion] phi_u0_deg
drawn.phi_e0_deg.unifrom = [0, 1]            -> [drawn] phi_e0_deg.unifrom: uniform
drawn.phi_e0_deg = {uniform = [0, 1], grid = [1]}    -> [drawn] phi_e0_deg: uniform normal grid
drawn.phi_e0_deg.sigma = 3                   -> [drawn] phi_e0_deg.sigma: normal uniform
drawn.phi_e0_deg.uniform = [1, 2, 3]         -> [drawn] phi_e0_deg.uniform: 2 3
drawn.phi_e0_deg.uniform = [2, 1]            -> [drawn] phi_e0_deg.uniform: low high 2 1
drawn.phi_e0_deg.normal = [0, -1]            -> [drawn] phi_e0_deg.normal[1]: 0 -1
drawn.phi_e0_deg.values = []                 -> [drawn] phi_e0_deg.values: empty
drawn.phi_e0_deg.grid = [0, 200]             -> [drawn] phi_e0_deg.grid[1]: 180 200
drawn.accel_bias_ug.values = [0, [1, 2, "3"]]    -> [drawn] accel_bias_ug.values[1][2]: '3'
drawn = {gyro_noise_deg_per_h.values = [1], gyro_arw_deg_per_sqrt_h.values = [1]}
    -> [drawn] gyro_noise_deg_per_h: gyro_arw_deg_per_sqrt_h [drawn]
""")
def test_invalid_drawn_tables_are_refused(refusal):
    refusal.check(refusal_line(refusal.tables["drawn"]))


def test_none_is_refused_as_a_law():
    assert_named(refusal_line({"phi_e0_deg": None}), "[drawn] phi_e0_deg")
    line = refusal_line({"phi_e0_deg": {"uniform": None}})
    assert_named(line, "[drawn] phi_e0_deg.uniform")


def test_drawn_key_with_conflicting_sensor_key_is_refused():
    key, other = "accel_noise_ug", "accel_vrw_ug_per_sqrt_hz"
    line = refusal_line({key: {"values": [1]}}, sensors={other: 1.0})
    assert_named(line, f"[drawn] {key}", other, "[sensors]")


@BOTH
@pytest.mark.parametrize(
    ("key", "law", "bound"),
    [
        ("latitude_deg", {"uniform": [80, 100]}, "90"),
        ("pitch_center_deg", {"normal": [0, 60]}, "90"),
        ("pitch_period_s", {"normal": [6, 4]}, "0"),
        ("phi_u0_deg", {"uniform": [170, 190]}, "180"),
        ("gyro_arw_deg_per_sqrt_h", {"normal": [1, 1]}, "0"),
        ("accel_scale_ppm", {"normal": [1e12, 1]}, "1000000000000"),
    ],
)
def test_draw_out_of_bounds_is_refused(laws, key, law, bound):
    table = {"sampling": laws.get("sampling", "random"), key: law}
    line = refusal_line(table, study={"draws": 1000, "unchecked": True})
    assert re.fullmatch(rf"\[drawn\] {key}: draw \d+ gives \S+: must .*{bound}", line)


def test_worst_draw_out_of_bounds_is_named_in_any_block(monkeypatch):
    law = {"yaw_phase_deg": {"normal": [0, 95]}}
    values = drawn({"yaw_phase_deg": {"normal": [0, 1]}}, 40_000)["yaw_phase_deg"] * 95
    out = int(np.argmax(np.abs(values) > 360))
    assert out > 1000
    make_study(law, study={"draws": out})
    monkeypatch.setattr("sinsjax.study.rules._DRAWS_PER_BLOCK", 1000)
    line = f"[drawn] yaw_phase_deg: draw {out} gives {float(values[out])!r}: must be "
    assert refusal_line(law, study={"draws": out + 1}).startswith(line)


# What a drawn key is to the rest of the study


def test_drawn_key_counts_as_given():
    data: dict[str, Any] = {"study": dict(BASE["study"])}
    laws: dict[str, Any] = {
        "latitude_deg": {"uniform": [20, 60]},
        "yaw_center_deg": {"values": [0, 90]},
        "gyro_noise_deg_per_h": {"values": [1]},
        "accel_vrw_ug_per_sqrt_hz": {"values": [1]},
        "roll_amplitude_deg": {"uniform": [0, 0]},
    }
    with pytest.raises(InputError, match=r"roll_period_s: required with roll_amplitude_deg > 0"):
        study_from_dict(data | {"drawn": laws})
    laws["roll_period_s"] = {"uniform": [5, 6]}
    study = study_from_dict(with_paper_values(data | {"drawn": laws}))
    assert study.drawn_keys == tuple(laws)
    assert study.sensors is not None and study.sensors.gyro_noise_deg_per_h is None
    assert study.sensors.accel_noise_ug is None
    for key in laws:
        assert study.values(key) == [None]
        assert list(study.combinations(key, "method")) == [{key: None, "method": "kalman5"}]


RECORDED = {"study": {"duration_s": 300.0, "rate_hz": 100.0}, "record": {"format": "psins"}}


def test_recorded_study_may_draw_only_initial_keys():
    laws = {key: {"normal": [0, 1]} for key in INITIAL_NUMBERS}
    record = {"format": "psins", "start_s": [0, 10, 20]}
    study = study_from_dict(with_paper_values(RECORDED | {"record": record, "drawn": laws}))
    assert study.n_draws == 3 and study.drawn_keys == INITIAL_NUMBERS
    for key, named in (
        ("yaw_center_deg", "[motion]"),
        ("gyro_bias_deg_per_h", "[sensors]"),
        ("latitude_deg", "phi_u0_deg"),
    ):
        with pytest.raises(InputError) as caught:
            drawn = {"drawn": {key: {"values": [1]}}}
            study_from_dict(with_paper_values(RECORDED | drawn), "s.toml")
        assert_named(str(caught.value), f"s.toml: [drawn] {key}", named)

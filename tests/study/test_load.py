"""What a study file gives: values, variants, the resolved file, the fingerprint and its display."""

import itertools
import re
import tomllib
from typing import Any

import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st
from support.plain_studies import (
    COMPASS,
    RECORDED,
    SIMULATED,
    TABULAR,
    build_study,
    merge_tables,
    refusal_lines,
)
from support.refusals import assert_named
from support.studies import small_study, with_paper_values

import sinsjax
from sinsjax import InputError, load_study, study_from_dict
from sinsjax.study import files
from sinsjax.study.load import fingerprint, study_to_toml, with_rate

FULL = """
study = {name = "example", duration_s = 900.0, rate_hz = 100.0, settle_bands_arcmin = [60, 10, 3]}
earth.latitude_deg = 32.0
motion.yaw_center_deg = 20
sensors = {gyro_bias_deg_per_h = [0.1, 0, -0.1], gyro_arw_deg_per_sqrt_h = 0.01, accel_noise_ug = 5}
alignment = {method = "kalman10", phi_e0_deg = 5}
filter.q_reading = "psd"
resets.reset_cycle_s = 50.0
axes = {reset_count = [0, 1, 2], misalignment = ["vector", "euler"]}
cases = [{phi_u0_deg = 0, case = "small"}, {case = "large", phi_u0_deg = 30}]
"""
ZIPPED: dict[str, Any] = {
    "reset_kind": ["full", "yaw"],
    "z level": {"phi_n0_deg": [0, 5], "phi_e0_deg": [0, 5]},
    "errors": {"gyro_scale_ppm": [0, [1, 2, 3]], "accel_scale_ppm": [1, 1]},
}
DRAWN: dict[str, Any] = {
    "sampling": "sobol",
    "vn0_m_per_s": {"uniform": [0, 1]},
    "accel_bias_ug": {"normal": [0, 1]},
    "gyro_arw_deg_per_sqrt_h": {"values": [0, [1, 2, 3], 0]},
    "phi_u0_deg": {"values": [3, 2, 1]},
}
TRIGGER = {"reset_trigger": "innovation", "trigger_threshold": 9.0}


# What a study gives


def test_defaults_are_filled_in():
    study = study_from_dict(with_paper_values(SIMULATED), "folder/swing.toml")
    assert study.name == "swing"
    assert study.study.window_s == (600.0, 900.0)
    assert (study.n_draws, study.n_variants, study.axis_keys) == (64, 1, ())
    assert (study.earth.gravity_m_per_s2, study.earth.height_m) == (9.8, 0.0)
    assert study.sensors.gyro_noise_deg_per_h == 0.0 and study.resets.reset_count == 0
    assert (study.record, study.coarse, study.is_recorded) == (None, None, False)


def test_recorded_study_has_one_draw_per_start_time():
    study = build_study(RECORDED)
    assert study.is_recorded and study.n_draws == 1 and study.record.start_s == (0.0,)
    assert (study.motion, study.sensors, study.study.draws) == (None, None, None)
    assert (study.coarse.coarse_duration_s, study.earth.latitude_deg) == (60.0, None)
    assert build_study(RECORDED, record={"start_s": [0, 30, 60]}).n_draws == 3
    assert build_study(RECORDED, record={"from_s": 30}).record.start_s == (30.0,)
    assert build_study(RECORDED, study={"rate_hz": 199.8}).record_every == 200  # the nearest
    assert_named(refusal_lines(study={"rate_hz": 199.8})[0], "[study] record_interval_s", "1")
    # Its file may give the rate.
    study = study_from_dict(with_paper_values(RECORDED | {"study": {"duration_s": 300.0}}))
    assert fingerprint(with_rate(study, 100.0)) == fingerprint(build_study(RECORDED))
    with pytest.raises(InputError, match=r"\[study\] rate_hz: required"):
        study_from_dict({"study": {"duration_s": 300.0}, "record": TABULAR})


def test_sections_and_defaults_depend_on_methods():
    filters, loops = build_study(), build_study(COMPASS)
    both = build_study(axes={"method": ["kalman5", "compass"]})
    sections = ("filter", "resets", "compass", "passes")
    assert [[*map(study.has, sections)] for study in (filters, loops, both)] == [
        [True, True, False, False],
        [False, False, True, False],
        [True, True, True, False],
    ]
    assert loops.alignment.feedback_interval_s is None
    assert (loops.compass.level_sigma_per_s, loops.compass.azimuth_sigma_per_s) == (0.02, 0.01)
    over = build_study(COMPASS, passes={"stored_s": 80}).passes
    assert (over.turn, over.turn_smoothing_s, over.turn_covariance) == ("reflect", 5.0, None)
    over = build_study(passes={"stored_s": 80}).passes
    assert (over.turn, over.turn_covariance, over.turn_inflation) == (None, "carried", 10.0)


# Variants

SWEPT = ("phi_e0_deg", "phi_n0_deg", "phi_u0_deg", "ve0_m_per_s", "vn0_m_per_s", "height_m")


@st.composite
def sweeps(draw: st.DrawFn) -> tuple[list[dict], list[dict], dict]:
    """Cases, zips and axes over some of the keys, with values that repeat within a zip or case."""
    keys = draw(st.permutations(SWEPT))
    cuts = [0, *itertools.accumulate(draw(st.integers(0, 2)) for _ in range(3))]
    cases, *zips = (
        [dict(zip(some, row, strict=True)) for row in draw(st.lists(
            st.tuples(*[st.integers(0, 2)] * len(some)), min_size=bool(some), unique=True,
            max_size=9 * bool(some)))]
        for some in (keys[a:b] for a, b in itertools.pairwise(cuts))
    )  # fmt: skip
    values = st.lists(st.integers(0, 9), min_size=1, max_size=3, unique=True)
    axes = {key: draw(values) for key in keys[cuts[-1] :] if draw(st.booleans())}
    return cases, [table for table in zips if table], axes


@given(sweep=sweeps(), data=st.data())
def test_variants_are_numbered_like_itertools_product(sweep, data):
    """Cases first, then zips and axes as they are written, the last one fastest."""
    cases, zips, axes = sweep
    tables = {
        name: {k: [row[k] for row in rows] for k in rows[0]}
        for name, rows in zip(("zip 1", "method"), zips, strict=False)  # any name will do
    }
    # A zip may stand before an axis in a dictionary.
    study = build_study(axes=tables | axes, **({"cases": cases} if cases else {}))
    grids = [[{key: value} for value in values] for key, values in axes.items()]
    points = [
        {key: value for part in parts for key, value in part.items()}
        for parts in itertools.product(cases or [{}], *zips, *grids)
    ]
    assert study.n_variants == len(points)
    values = study.variant_values()
    assert list(values) == list(study.axis_keys) == list(points[0])
    assert [dict(zip(values, row, strict=True)) for row in zip(*values.values(), strict=True)] == (
        points if values else []
    )
    keys = data.draw(st.lists(st.sampled_from([*SWEPT, "method"]), unique=True))
    met = {tuple(row) for row in zip(*(study.values(key) for key in keys), strict=True)} or {()}
    found = [tuple(point[key] for key in keys) for point in study.combinations(*keys)]
    assert set(found) == met and len(found) == len(met)


# Files


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (None, "read"),
        (b"\xff\xfe", "UTF-8"),
        (b"[study]\nname = \nseed = 1", "line 2"),
        (b"[study]\nseed = " + b"9" * 5000, "TOML"),
        (b"[study]\nduration_s = 60\nrate_hz = 100\n'a\\nb' = 1", r"[study] a\nb"),
    ],
    ids=["missing", "no text", "no value", "digits", "key of two lines"],
)
def test_unusable_file_is_refused_by_its_name(content, named, tmp_path):
    path = tmp_path / "s.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        load_study(path)
    (line,) = caught.value.lines
    assert line.startswith(f"{path}: ") and named in line and "\n" not in line


def test_study_is_loaded_from_a_study_or_a_file_with_a_byte_order_mark(tmp_path):
    (tmp_path / "s.toml").write_text("\ufeff" + FULL, encoding="utf-8")
    study = load_study(tmp_path / "s.toml")
    assert study.name == "example" and load_study(study) is study
    assert load_study(study, {"study.draws": 2}).n_draws == 2
    with pytest.raises(InputError, match=r"did you mean tune_large\?"):
        sinsjax.tune("tune_larg", tmp_path / "out")


def test_changed_key_replaces_its_alternative():
    study = small_study(resets={"reset_count": 2, "reset_cycle_s": 2.0})
    changed = study.replace({"resets.reset_times_s": [1.5]})
    assert [*map(tuple, changed.reset_times())] == [(1.5,)]
    both = {"sensors.gyro_noise_deg_per_h": 1.0, "sensors.gyro_arw_deg_per_sqrt_h": 1.0}
    with pytest.raises(InputError, match=r"gyro_arw.* conflicts with sensors.gyro_noise"):
        study.replace(both)


PASSES = {"stored_s": 80, "ending": "forward", "turn": "velocity"}
LOOPS = {"level_gains": [0.06, 1040.0, 1.6e-6], "level_time_s": 80.0, "azimuth_sigma_per_s": 0.02}
PIECES = {"sigma_factors": [2, 1], "sigma_times_s": [160.0]}


@pytest.mark.parametrize(
    ("base", "changes"),
    [
        (tomllib.loads(FULL), {}),
        (SIMULATED, {"axes": {"earth": ["wgs84", "constants"], "radius_m": [6.3e6, 6.4e6]}}),
        (SIMULATED, {"resets": TRIGGER | {"reset_times_s": [], "reset_yaw_deg": 10.0}}),
        (SIMULATED, {"cases": [TRIGGER, TRIGGER | {"reset_trigger": "none"}]}),
        (SIMULATED, {"motion": {"turn_times_s": [1.0], "surge_m_per_s": 0.02}}),  # R is left out
        (SIMULATED, {"study": {"name": '[b] $x$ "q" \\ <i>', "settle_bands_arcmin": []}}),
        (SIMULATED, {"stop_when": {"statistic": "success_rate", "half_width": 0.02}}),
        (SIMULATED, {"axes": ZIPPED, "cases": [{"case": "a"}]}),
        (SIMULATED, {"drawn": DRAWN}),
        (COMPASS, {"study": {"duration_s": 6.0}}),  # 150 s of levelling is the default
        (SIMULATED, {"passes": {"stored_s": 80}, "axes": {"method": ["kalman5", "compass"]}}),
        (RECORDED, {"record": TABULAR | {"time_column": "t", "start_s": [0, 2.5]}}),
        (
            RECORDED,
            {"alignment": {"method": "compass"}, "passes": PASSES, "compass": LOOPS | PIECES},
        ),
    ],
)
def test_resolved_study_reloads_equal(base, changes, tmp_path):
    study = build_study(base, **changes)
    text = study_to_toml(study)
    (tmp_path / "study.toml").write_text(text, encoding="utf-8")
    again = load_study(tmp_path / "study.toml")
    assert again == study and study_to_toml(again) == text
    assert again.axis_keys == study.axis_keys and list(again.axes) == list(study.axes)
    assert list(again.zips) == list(study.zips) and again.drawn_keys == study.drawn_keys
    assert fingerprint(again) == fingerprint(study)


# Fingerprint


def reversed_keys(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: reversed_keys(value) for key, value in reversed(data.items())}
    return data


def test_fingerprint_ignores_names_key_order_and_explicit_defaults():
    data = tomllib.loads(FULL)
    print_ = fingerprint(study_from_dict(data))
    assert re.fullmatch("[0-9a-f]{16}", print_)
    shuffled = reversed_keys(data) | {"axes": data["axes"]}
    renamed = merge_tables(data, study={"name": "other"}, filter={"p0_yaw_deg": 80})
    assert {fingerprint(study_from_dict(same)) for same in (shuffled, renamed)} == {print_}
    one, other = ({name: {"phi_u0_deg": [0, 1], "phi_e0_deg": [0, 1]}} for name in "ab")
    other["b"] = reversed_keys(other["b"])
    assert fingerprint(build_study(axes=one)) == fingerprint(build_study(axes=other))


def test_fingerprint_changes_with_what_varies():
    axes = {"reset_count": [0, 1], "misalignment": ["vector", "euler"]}
    base = merge_tables(SIMULATED, resets={"reset_cycle_s": 50}, axes=axes)
    drawn = [DRAWN, dict(reversed(DRAWN.items())), {"phi_u0_deg": {"values": [0]}}]
    laws = ({"uniform": [0, 2]}, {"normal": [0, 1]}, {"values": [3, 2, 1]})
    drawn += [DRAWN | {"vn0_m_per_s": law} for law in laws]
    level = {"phi_u0_deg": [0, 1]}, {"phi_e0_deg": [0, 1]}
    other: list[dict[str, Any]] = [
        {},
        {"axes": {"reset_count": [1, 0]}},
        *({"cases": [{"case": "a", "phi_u0_deg": value}]} for value in (30, 31)),
        *({"drawn": table} for table in drawn),
        {"axes": {"a": level[0] | level[1]}},
        {"axes": {"a": level[0], "b": level[1]}},
        {"axes": {"b": level[1], "a": level[0]}},
        {"axes": level[0] | level[1]},
    ]
    studies = [build_study(base, **tables) for tables in other]
    studies += [build_study(base | {"axes": reversed_keys(axes)})]  # which numbers the variants
    assert len({*map(fingerprint, studies)}) == len(studies)


# Display


@pytest.mark.nightly(
    fast=(
        "reset_sweep",
        "methods",
        "arena",
        "car_test",
        "compass_car",
        "paper1_resets",
        "tune_condition5",
    )
)
@pytest.mark.parametrize("name", files.shipped_studies())
def test_shipped_study_is_displayed_in_five_short_lines_and_round_trips(name):
    study = load_study(name)
    title, *facts = lines = repr(study).splitlines()
    assert title == f"Study {name}" and len(lines) == 5 and max(map(len, lines)) <= 80
    assert f"{study.n_variants:,} variant" in facts[0] and study.methods[0] in facts[2]
    assert study_from_dict(tomllib.loads(tomli_w.dumps(study.to_dict()))) == study

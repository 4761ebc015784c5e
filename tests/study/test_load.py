"""What a study file gives: values, variants, the resolved file and the fingerprint."""

import copy
import itertools
import re
import tomllib
from typing import Any

import pytest
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
from support.studies import with_paper_values

from sinsjax.errors import InputError
from sinsjax.messages import CONTROL
from sinsjax.study.identity import fingerprint
from sinsjax.study.load import load_study, study_from_dict, study_to_toml, with_rate

FULL = """
[study]
name = "example"
duration_s = 900.0
rate_hz = 100.0
record_interval_s = 1.0
draws = 8
seed = 1
settle_bands_arcmin = [60, 10, 3]
window_s = [600, 900]
consistency_after_s = 10.0
curves = false
[earth]
earth = "constants"
gravity_m_per_s2 = 9.8
radius_m = 6378137.0
earth_rate_deg_per_h = 15.041067
latitude_deg = 32.0
height_m = 0.0
[motion]
pitch_amplitude_deg = 1.8
pitch_period_s = 6.0
yaw_center_deg = 20
[sensors]
gyro_bias_deg_per_h = [0.1, 0, -0.1]
gyro_arw_deg_per_sqrt_h = 0.01
gyro_misalignment_arcsec = [1, 2, 3, 4, 5, 6]
accel_bias_ug = 500
accel_noise_ug = 500.0
[alignment]
method = "kalman10"
phi_e0_deg = 5
[filter]
q_reading = "psd"
[resets]
reset_count = 3
reset_cycle_s = 50.0
[axes]
reset_count = [0, 1, 2]
misalignment = ["vector", "euler"]
[[cases]]
phi_u0_deg = 0
case = "small"
[[cases]]
case = "large"
phi_u0_deg = 30
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
    "phi_u0_deg": {"grid": [3, 2, 1]},
}


# What a study gives


def test_defaults_are_filled_in():
    study = study_from_dict(with_paper_values(SIMULATED), "folder/swing.toml")
    assert study.name == "swing"
    assert study.study.window_s == (600.0, 900.0)
    assert (study.n_draws, study.n_variants, study.axis_keys) == (64, 1, ())
    assert (study.earth.gravity_m_per_s2, study.earth.height_m) == (9.8, 0.0)
    assert study.sensors is not None and study.sensors.gyro_noise_deg_per_h == 0.0
    assert study.resets.reset_count == 0
    assert (study.record, study.coarse, study.is_recorded) == (None, None, False)


def test_recorded_study_has_one_draw_per_start_time():
    study = build_study(RECORDED)
    assert study.is_recorded and study.n_draws == 1
    assert study.record is not None and study.record.start_s == (0.0,)
    assert (study.motion, study.sensors, study.study.draws) == (None, None, None)
    assert study.coarse is not None and study.coarse.coarse_duration_s == 60.0
    assert (study.earth.latitude_deg, study.earth.height_m) == (None, None)
    several = build_study(RECORDED, record={"start_s": [0, 30, 60]})
    assert several.n_draws == 3 and several.n_variants == 1
    assert build_study(RECORDED, record={"start_s": 30}).n_draws == 1


def test_input_tables_are_not_modified():
    tables = with_paper_values(SIMULATED)
    data = copy.deepcopy(tables)
    study_from_dict(data)
    assert data == tables


def test_study_fields_cannot_be_assigned():
    study = build_study()
    with pytest.raises(ValueError, match="frozen"):
        study.seed = 2
    with pytest.raises(ValueError, match="frozen"):
        study.earth = study.earth


# Variants


def test_variant_order_is_cases_then_axes_last_fastest():
    study = study_from_dict(tomllib.loads(FULL))
    assert study.axis_keys == ("case", "phi_u0_deg", "reset_count", "misalignment")
    assert study.n_variants == 12
    values = study.variant_values()
    assert list(values) == list(study.axis_keys)
    cases = [("small", 0.0), ("large", 30.0)]
    expected = [
        (*case, *point) for case, *point in itertools.product(cases, (0, 1, 2), ("vector", "euler"))
    ]
    assert list(zip(*values.values(), strict=True)) == expected


def test_values_list_swept_and_constant_keys_per_variant():
    study = study_from_dict(tomllib.loads(FULL))
    assert study.values("phi_u0_deg") == [0.0] * 6 + [30.0] * 6
    assert study.values("phi_e0_deg") == [5.0] * 12
    assert study.values("reset_count") == [0, 0, 1, 1, 2, 2] * 2
    for key in ("start_s", "seed", "nonsense"):
        with pytest.raises(KeyError):
            study.values(key)
    with pytest.raises(KeyError):
        build_study(RECORDED).values("gyro_bias_deg_per_h")


SWEPT = ("phi_e0_deg", "phi_n0_deg", "phi_u0_deg", "ve0_m_per_s", "vn0_m_per_s", "height_m")


@st.composite
def sweeps(draw: st.DrawFn) -> tuple[list[dict], list[dict], dict]:
    """Cases, zips and axes over some of the keys, with values that repeat within a zip or case."""
    keys = draw(st.permutations(SWEPT))
    sizes = draw(st.lists(st.integers(0, 2), min_size=3, max_size=3))
    cuts = list(itertools.accumulate([0, *sizes]))
    joint = [keys[a:b] for a, b in itertools.pairwise(cuts)]
    rows = [
        draw(st.lists(st.tuples(*[st.integers(0, 2)] * len(some)), min_size=1, unique=True))
        for some in joint
    ]
    cases, *zips = (
        [dict(zip(some, row, strict=True)) for row in table] if some else []
        for some, table in zip(joint, rows, strict=True)
    )
    alone = draw(st.lists(st.sampled_from(keys[cuts[-1] :] or ["roll_phase_deg"]), unique=True))
    axes = {
        key: draw(st.lists(st.integers(0, 9), min_size=1, max_size=3, unique=True)) for key in alone
    }
    return cases, [table for table in zips if table], axes


@given(sweep=sweeps(), data=st.data())
def test_variants_are_numbered_like_itertools_product(sweep, data):
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


def test_required_keys_may_be_swept():
    data = merge_tables(SIMULATED, axes={"latitude_deg": [0, 80], "yaw_center_deg": [0, 90]})
    del data["earth"], data["motion"]
    study = study_from_dict(with_paper_values(data))
    assert study.values("latitude_deg") == [0.0, 0.0, 80.0, 80.0]
    assert study_from_dict(tomllib.loads(study_to_toml(study))) == study


# Files


def test_load_study_reads_file_with_or_without_bom(tmp_path):
    path = tmp_path / "swing.toml"
    path.write_text(FULL.replace('name = "example"\n', ""))
    assert load_study(path).study.name == "swing"
    path.write_text("\ufeff" + FULL, encoding="utf-8")
    assert load_study(path).study.name == "example"


REST = "[earth]\nlatitude_deg = 32\n[motion]\nyaw_center_deg = 20\n[alignment]\nmethod = 'inertial'"


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (None, "read"),
        ("\udcff\udcfe", "UTF-8"),
        ("[study]\nname = \nseed = 1", "line 2"),
        ("[study]\nseed = " + "9" * 5000, "TOML"),
        (f"[study]\nduration_s = nan\nrate_hz = 100\n{REST}", "[study] duration_s: nan"),
        (f'[study]\nduration_s = 60\nrate_hz = 100\n"a\\nb" = 1\n{REST}', "[study] a b:"),
    ],
    ids=["missing", "no text", "no value", "digits", "value", "key of two lines"],
)
def test_unusable_file_is_refused_by_its_name(content, named, tmp_path):
    path = tmp_path / "s.toml"
    if content is not None:
        path.write_bytes(content.encode("utf-8", "surrogateescape"))
    with pytest.raises(InputError) as caught:
        load_study(path)
    place, _, words = named.rpartition(":")
    assert_named(str(caught.value), f"{path}: {place}" if place else f"{path}", *words.split())


# Round trip


@pytest.mark.parametrize(
    "data",
    [
        SIMULATED,
        RECORDED,
        tomllib.loads(FULL),
        merge_tables(SIMULATED, earth={"earth": "wgs84"}),
        merge_tables(SIMULATED, axes={"earth": ["wgs84", "constants"], "radius_m": [6.3e6, 6.4e6]}),
        merge_tables(SIMULATED, resets={"reset_times_s": [50, 100]}),
        merge_tables(SIMULATED, resets={"reset_times_s": []}),
        merge_tables(
            SIMULATED, study={"name": '[b] $x$ "quotes" \\ <i>', "settle_bands_arcmin": []}
        ),
        merge_tables(RECORDED, record=TABULAR | {"time_column": "t", "start_s": [0, 2.5]}),
        merge_tables(SIMULATED, stop_when={"statistic": "success_rate", "half_width": 0.02}),
        merge_tables(SIMULATED, axes=ZIPPED, cases=[{"case": "a"}]),
        merge_tables(SIMULATED, drawn=DRAWN),
        merge_tables(RECORDED, drawn={"phi_u0_deg": {"normal": [0, 10]}}),
        merge_tables(COMPASS, filter={}, resets={}),
        merge_tables(SIMULATED, compass={}, passes={}),
        merge_tables(SIMULATED, passes={"stored_s": 80}, axes={"method": ["kalman5", "compass"]}),
        merge_tables(
            RECORDED,
            alignment={"method": "compass"},
            passes={"stored_s": 80, "ending": "forward", "turn": "velocity"},
            compass={
                "level_gains": [0.06, 1040.0, 1.6e-6],
                "level_passes": 1,
                "azimuth_adjustment_s": 450,
                "sigma_factors": [2, 1],
                "sigma_passes": [2],
            },
        ),
    ],
)
def test_resolved_study_reloads_equal(data, tmp_path):
    study = study_from_dict(with_paper_values(data))
    text = study_to_toml(study)
    path = tmp_path / "study.toml"
    path.write_text(text, encoding="utf-8")
    again = load_study(path)
    assert again == study
    assert again.axis_keys == study.axis_keys and list(again.axes) == list(study.axes)
    assert list(again.zips) == list(study.zips) and again.drawn_keys == study.drawn_keys
    assert study_to_toml(again) == text
    assert fingerprint(again) == fingerprint(study)


angles = st.floats(-180, 180)
sizes = st.floats(1e-300, 1e12) | st.integers(1, 10**6)
letters = st.characters(codec="utf-8").filter(lambda letter: not CONTROL.search(letter))


@given(
    duration=st.floats(10, 1e6),
    phi=st.lists(angles, min_size=1, max_size=4, unique=True),
    bias=st.floats(-1e12, 1e12) | st.tuples(angles, angles, angles),
    p0=sizes,
    name=st.text(letters, min_size=1),
    methods=st.permutations(["kalman5", "kalman10", "compass"]),
)
def test_random_resolved_study_reloads_equal(duration, phi, bias, p0, name, methods):
    study = build_study(
        study={"duration_s": duration, "name": name, "unchecked": True},
        sensors={"gyro_bias_deg_per_h": bias},
        filter={"p0_yaw_deg": p0},
        axes={"phi_u0_deg": phi, "method": methods},
    )
    again = study_from_dict(tomllib.loads(study_to_toml(study)))
    assert again == study
    assert fingerprint(again) == fingerprint(study)


# Fingerprint


def reversed_keys(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: reversed_keys(value) for key, value in reversed(data.items())}
    return data


def test_fingerprint_ignores_name_key_order_and_explicit_defaults():
    data = tomllib.loads(FULL)
    print_ = fingerprint(study_from_dict(data))
    assert re.fullmatch("[0-9a-f]{16}", print_)
    shuffled = reversed_keys(data) | {"axes": data["axes"]}
    assert fingerprint(study_from_dict(shuffled)) == print_
    other = merge_tables(data, study={"name": "other"})
    assert fingerprint(study_from_dict(other)) == print_
    assert fingerprint(build_study(filter={"p0_yaw_deg": 80})) == fingerprint(build_study())


def test_fingerprint_changes_with_any_value():
    data = tomllib.loads(FULL)
    changes: list[dict[str, Any]] = [
        {"earth": {"latitude_deg": 32.000001}},
        {"sensors": {"gyro_bias_deg_per_h": [0.1, 0, -0.2]}},
        {"axes": {"reset_count": [0, 2, 1]}},
        {"cases": [{"case": "small", "phi_u0_deg": 0}, {"case": "large", "phi_u0_deg": 31}]},
    ]
    studies = [data, *(merge_tables(data, **change) for change in changes)]
    studies += [data | {"axes": reversed_keys(data["axes"])}]  # which numbers the variants
    assert len({fingerprint(study_from_dict(study)) for study in studies}) == len(studies)


def test_fingerprint_changes_with_zips_drawn_keys_and_stop_rule():
    drawn = [
        DRAWN,
        DRAWN | {"sampling": "random"},
        DRAWN | {"vn0_m_per_s": {"uniform": [0, 2]}},
        DRAWN | {"vn0_m_per_s": {"normal": [0, 1]}},
        DRAWN | {"phi_u0_deg": {"values": [3, 2, 1]}},
        dict(reversed(DRAWN.items())),
        {"phi_u0_deg": {"values": [0]}},
    ]
    other: list[dict[str, Any]] = [
        {},
        *({"drawn": table} for table in drawn),
        {"axes": {"a": {"phi_u0_deg": [0, 1], "phi_e0_deg": [0, 1]}}},
        {"axes": {"a": {"phi_u0_deg": [0, 1]}, "b": {"phi_e0_deg": [0, 1]}}},
        {"axes": {"b": {"phi_e0_deg": [0, 1]}, "a": {"phi_u0_deg": [0, 1]}}},
        {"axes": {"phi_u0_deg": [0, 1], "phi_e0_deg": [0, 1]}},
        {"resets": {"reset_first_s": 25}},
        {"resets": {"reset_first_s": 26}},
        {"stop_when": {"statistic": "success_rate", "half_width": 0.02}},
        {"stop_when": {"statistic": "success_rate", "half_width": 0.03}},
        {"stop_when": {"statistic": "settle_60_s_mean", "half_width": 0.03}},
    ]
    assert len({fingerprint(build_study(**tables)) for tables in other}) == len(other)
    named = {"other": {"phi_e0_deg": [0, 1], "phi_u0_deg": [0, 1]}}
    assert fingerprint(build_study(axes=named)) == fingerprint(build_study(**other[len(drawn) + 1]))


# Resets, stops and runs


def test_valid_resets_are_accepted():
    build_study(resets={"reset_times_s": [0.01, 0.02, 900]})  # the last one exactly at the end
    build_study(resets={"reset_count": 0, "reset_cycle_s": 1e6})
    build_study(resets={"reset_count": 1, "reset_first_s": 900, "reset_cycle_s": 1e6})
    build_study(resets={"reset_count": 3, "reset_first_s": 100, "reset_cycle_s": 400})
    # 3 x 0.1 is a rounding error more than 0.3.
    build_study(
        study={"duration_s": 0.3, "record_interval_s": 0.1},
        resets={"reset_count": 3, "reset_cycle_s": 0.1},
    )
    # Each case with its own cycle: only what happens together is checked.
    pairs = [{"reset_count": 2, "reset_cycle_s": 400}, {"reset_count": 8, "reset_cycle_s": 100}]
    build_study(cases=pairs)


def test_reset_times_follow_count_first_time_and_cycle():
    """A first one of its own; without it the cycle's multiples, as exactly as ever."""
    cycle = {"reset_cycle_s": 0.1}
    study = build_study(resets=cycle, axes={"reset_count": [0, 1, 3], "reset_first_s": [25, 7.5]})
    assert study.reset_times() == [
        (),
        (),
        (25.0,),
        (7.5,),
        (25.0, 25.0 + 0.1, 25.0 + 2 * 0.1),
        (7.5, 7.5 + 0.1, 7.5 + 2 * 0.1),
    ]
    (times,) = build_study(resets=cycle | {"reset_count": 3}).reset_times()
    assert times == (0.1, 0.2, 3 * 0.1)
    alone = build_study(resets={"reset_first_s": 25}, axes={"reset_count": [0, 1]})
    assert alone.reset_times() == [(), (25.0,)]


def test_record_intervals_round_to_nearest_samples():
    """In a simulation, whose rate is given, such an interval is an error."""
    study = build_study(RECORDED, study={"rate_hz": 199.8}, record={"start_s": [0, 0.004]})
    assert study.record_every == 200
    assert_named(refusal_lines(study={"rate_hz": 199.8})[0], "[study] record_interval_s", "1")


def test_record_may_supply_sample_rate():
    tables = {"study": {"duration_s": 300.0}, "record": {"format": "psins"}}
    study = study_from_dict(with_paper_values(tables))
    assert not study.study.rate_hz
    for rate in (100.0, 199.8):
        assert with_rate(study, rate).study.rate_hz == rate
    whole = build_study(RECORDED)
    assert fingerprint(with_rate(study, whole.study.rate_hz)) == fingerprint(whole)
    with pytest.raises(InputError, match="is longer than a run"):
        with_rate(
            study.model_copy(
                update={"study": study.study.model_copy(update={"record_interval_s": 301.0})}
            ),
            1.0,
        )
    with pytest.raises(InputError, match=r"\[study\] rate_hz: required"):
        study_from_dict({"study": {"duration_s": 300.0}, "record": TABULAR})
    timed = {"study": {"duration_s": 300.0}, "record": TABULAR | {"time_column": "t"}}
    study_from_dict(with_paper_values(timed))


def test_sections_and_defaults_depend_on_methods():
    filters, loops, both = (
        build_study(),
        build_study(COMPASS),
        build_study(axes={"method": ["kalman5", "compass"]}),
    )
    assert filters.compass is None and filters.filter and filters.resets
    assert loops.filter is None and loops.resets is None
    assert loops.alignment.feedback_interval_s is None
    assert both.compass and both.filter and both.resets
    for study in (filters, loops, both):
        assert study.passes is None
    assert filters.alignment.feedback_interval_s == both.alignment.feedback_interval_s == 1.0
    compass = loops.compass
    assert compass is not None
    assert (compass.level_sigma_per_s, compass.azimuth_sigma_per_s) == (0.02, 0.01)
    assert (compass.level_time_s, compass.sigma_factors) == (150.0, (1.0,))
    over = build_study(COMPASS, passes={"stored_s": 80}).passes
    assert over is not None
    assert (over.turn, over.turn_smoothing_s, over.turn_covariance) == ("reflect", 5.0, None)
    over = build_study(passes={"stored_s": 80}).passes
    assert over is not None
    assert (over.turn, over.turn_covariance, over.turn_inflation) == (None, "carried", 10.0)


@pytest.mark.parametrize(
    ("passes", "spans"),
    [
        # Record intervals in the run and in a pass, of 900.
        ({}, (900, 900)),
        ({"stored_s": 80}, (900, 80)),
        ({"stored_s": 80, "passes": 3}, (240, 80)),
        ({"stored_s": 80, "ending": "forward"}, (880, 80)),
        ({"stored_s": 100, "ending": "forward"}, (900, 100)),
        ({"stored_s": 900}, (900, 900)),
        ({"stored_s": 90, "ending": "forward", "direction": "rewind"}, (900, 90)),
        ({"stored_s": 80, "passes": 4, "ending": "forward", "direction": "rewind"}, (320, 80)),
    ],
)
def test_run_and_pass_lengths_follow_passes_settings(passes, spans):
    (span,) = build_study(study={"window_s": [0, 200]}, passes=passes).spans
    assert (span.records, span.pass_records, span.rewinds) == (*spans, "direction" in passes)


def test_run_ends_at_last_whole_record_interval():
    partial = {"duration_s": 900.5, "window_s": [600, 900]}
    study = build_study(study=partial, resets={"reset_times_s": [900]})
    assert (study.run_s, study.dropped_s) == (900.0, 0.5)
    build_study(study=partial | {"window_s": [898, 900.5]})

import copy
import itertools
import json
import math
import re
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.studies import with_paper_values

from sinsjax.errors import InputError
from sinsjax.messages import CONTROL
from sinsjax.methods.registry import METHODS
from sinsjax.study.identity import fingerprint
from sinsjax.study.keys import SECTION_OF, SECTIONS, SWEEPABLE
from sinsjax.study.load import load_study, study_from_dict, study_to_toml, with_rate
from sinsjax.study.study import Study
from sinsjax.value_types import Section

*FIRST, LAST = (f"'{name}'" for name in METHODS)
ONE_OF_METHODS = f"{', '.join(FIRST)} or {LAST}"

SIMULATED: dict[str, Any] = {
    "study": {"duration_s": 900, "rate_hz": 100},
    "earth": {"latitude_deg": 32.0},
    "motion": {"yaw_center_deg": 0},
}
RECORDED: dict[str, Any] = {
    "study": {"duration_s": 300.0, "rate_hz": 100.0},
    "record": {"format": "psins"},
}
COMPASS = SIMULATED | {"alignment": {"method": "compass"}}
TABULAR: dict[str, Any] = {
    "format": "csv",
    "quantity": "rates",
    "gyro_columns": ["gx", "gy", "gz"],
    "accel_columns": ["ax", "ay", "az"],
    "gyro_unit": "deg_per_h",
    "accel_unit": "m_per_s2",
}
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


STOP = {"statistic": "success_rate", "half_width": 0.02}
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


def build_study(base: dict[str, Any] = SIMULATED, **tables: Any) -> Study:
    return study_from_dict(with_paper_values(merge_tables(base, **tables)), "s.toml")


def merge_tables(base: dict[str, Any], **tables: Any) -> dict[str, Any]:
    data = copy.deepcopy(base)
    for name, table in tables.items():
        old = data.get(name)
        data[name] = old | table if isinstance(old, dict) and isinstance(table, dict) else table
    return data


def refusal_lines(base: dict[str, Any] = SIMULATED, **tables: Any) -> list[str]:
    """Return the lines of the error without the file's name, which must begin each."""
    with pytest.raises(InputError) as caught:
        build_study(base, **tables)
    lines = str(caught.value).splitlines()
    assert all(line.startswith("s.toml: ") for line in lines)
    return [line.removeprefix("s.toml: ") for line in lines]


def refusal_line(base: dict[str, Any] = SIMULATED, **tables: Any) -> str:
    """Return the single line of the error without the file's name, which must begin it."""
    (line,) = refusal_lines(base, **tables)
    return line


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


def test_values_are_converted_to_key_types():
    study = build_study(sensors={"gyro_bias_deg_per_h": [1, 2, 3]})
    assert type(study.duration_s) is float
    assert study.sensors is not None and study.sensors.gyro_bias_deg_per_h == (1.0, 2.0, 3.0)


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


@pytest.mark.parametrize("order", ["xyz", "y-xz", "-x-yz", "zxy", "+yx-z"])
def test_right_handed_axes_orders_are_accepted(order: str):
    study = build_study(RECORDED, record={"axes_order": order})
    assert study.record is not None and study.record.axes_order == order


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


def test_leaf_keys_are_unique_and_described():
    keys = Counter(key for model in SECTIONS.values() for key in model.model_fields)
    # What [record] takes for plausible is no axis, and has the names that it has in [sensors].
    assert [key for key in keys if keys[key] > 1] == ["gyro_bias_deg_per_h", "accel_bias_ug"]
    assert SECTION_OF["gyro_bias_deg_per_h"] == SECTION_OF["accel_bias_ug"] == "sensors"
    for model in SECTIONS.values():
        assert issubclass(model, Section)
        assert all(field.description for field in model.model_fields.values())


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


def test_unlabelled_cases_combine_with_vector_axes():
    study = build_study(
        cases=[{"phi_e0_deg": 1, "phi_n0_deg": 2}, {"phi_n0_deg": 2, "phi_e0_deg": 3}],
        axes={"gyro_bias_deg_per_h": [0, [1, 2, 3]], "reset_times_s": [[], [10, 20]]},
    )
    assert study.axis_keys == ("phi_e0_deg", "phi_n0_deg", "gyro_bias_deg_per_h", "reset_times_s")
    assert study.values("phi_e0_deg") == [1.0] * 4 + [3.0] * 4
    assert study.values("gyro_bias_deg_per_h") == [0.0, 0.0, (1.0, 2.0, 3.0), (1.0, 2.0, 3.0)] * 2
    assert study.values("reset_times_s") == [(), (10.0, 20.0)] * 4


def test_combinations_are_distinct_values_of_variants():
    study = build_study(
        cases=[{"phi_e0_deg": e, "reset_cycle_s": c} for e, c in ((1, 50), (2, 50), (3, 60))],
        axes={"phi_u0_deg": [0, 10], "reset_count": [0, 1]},
    )
    keys = ("reset_count", "reset_cycle_s", "phi_n0_deg")
    met = {tuple(point[key] for key in keys) for point in study.combinations(*keys)}
    assert met == set(zip(*(study.values(key) for key in keys), strict=True))
    assert len(list(study.combinations(*keys))) == len(met) == 4


def test_zipped_axes_vary_together_between_cases_and_axes():
    study = build_study(
        axes={
            "reset_kind": ["full", "yaw"],
            "level": {"phi_e0_deg": [0, 5], "phi_n0_deg": [1, 5]},
            "method": {"phi_u0_deg": [0, 10, 20]},  # any name will do
        },
        cases=[{"ve0_m_per_s": 0.0}, {"ve0_m_per_s": 1.0}],
    )
    level = {"phi_e0_deg": (0.0, 5.0), "phi_n0_deg": (1.0, 5.0)}
    assert study.zips == {"level": level, "method": {"phi_u0_deg": (0.0, 10.0, 20.0)}}
    assert study.axes == {"reset_kind": ("full", "yaw")}
    keys = ("ve0_m_per_s", "phi_e0_deg", "phi_n0_deg", "phi_u0_deg", "reset_kind")
    assert study.axis_keys == keys and study.n_variants == 24
    product = itertools.product((0, 1), ((0, 1), (5, 5)), (0, 10, 20), ("full", "yaw"))
    expected = [(ve, *pair, u, kind) for ve, pair, u, kind in product]
    assert list(zip(*study.variant_values().values(), strict=True)) == expected
    assert list(study.combinations("phi_n0_deg", "phi_e0_deg")) == [
        {"phi_n0_deg": 1.0, "phi_e0_deg": 0.0},
        {"phi_n0_deg": 5.0, "phi_e0_deg": 5.0},
    ]


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
def test_variants_are_numbered_like_itertools_product(sweep: tuple, data: st.DataObject):
    cases, zips, axes = sweep
    tables = {
        f"zip {i}": {k: [row[k] for row in rows] for k in rows[0]} for i, rows in enumerate(zips)
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


def test_values_of_200_thousand_variants_are_listed():
    study = build_study(
        axes={
            "phi_u0_deg": [i / 10 for i in range(1000)],
            "phi_e0_deg": [i / 10 for i in range(100)],
            "feedback_interval_s": [1, 2],
        }
    )
    assert len(study.values("phi_e0_deg")) == study.n_variants == 200_000


# Files


def test_load_study_reads_file_with_or_without_bom(tmp_path: Path):
    path = tmp_path / "swing.toml"
    path.write_text(FULL.replace('name = "example"\n', ""))
    assert load_study(path).study.name == "swing"
    path.write_text("\ufeff" + FULL, encoding="utf-8")
    assert load_study(path).study.name == "example"


def assert_load_refused(path: Path, text: str) -> None:
    with pytest.raises(InputError, match=text) as caught:
        load_study(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_unreadable_files_are_refused(tmp_path: Path):
    assert_load_refused(tmp_path / "missing.toml", "cannot be read: No such file")
    assert_load_refused(tmp_path, "cannot be read: Is a directory")
    path = tmp_path / "s.toml"
    path.write_bytes(b"\xff\xfe")
    assert_load_refused(path, "not UTF-8 text")


@pytest.mark.parametrize(
    "text", ["[study]\nname = \nseed = 1", "[study]\nseed = 1\nseed = 2\n[earth]"]
)
def test_syntax_errors_name_the_line(tmp_path: Path, text: str):
    path = tmp_path / "s.toml"
    path.write_text(text)
    assert_load_refused(path, r"not TOML: .*line \d")


def test_invalid_values_in_file_are_refused_with_file_name(tmp_path: Path):
    path = tmp_path / "s.toml"
    path.write_text(
        "[study]\nduration_s = nan\nrate_hz = 100\n[earth]\nlatitude_deg = 32\n"
        "[motion]\nyaw_center_deg = 20\n[alignment]\nmethod = 'inertial'"
    )
    assert_load_refused(path, r"\[study\] duration_s: must be finite, not nan")
    path.write_text(
        '[study]\nduration_s = 60\nrate_hz = 100\n"a\\nb" = 1\n'
        "[earth]\nlatitude_deg = 32\n[motion]\nyaw_center_deg = 20\n"
        "[alignment]\nmethod = 'inertial'"
    )
    assert_load_refused(path, r"\[study\] a b: unknown key")
    path.write_text("[study]\nseed = " + "9" * 5000)
    assert_load_refused(path, "not TOML")


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
        merge_tables(SIMULATED, resets={"reset_count": 1, "reset_first_s": 25}),
        merge_tables(SIMULATED, stop_when={"statistic": "success_rate", "half_width": 0.02}),
        merge_tables(SIMULATED, axes=ZIPPED, cases=[{"case": "a"}]),
        merge_tables(SIMULATED, drawn=DRAWN),
        merge_tables(
            SIMULATED,
            drawn=dict(reversed(DRAWN.items())),
            axes={"phi_n0_deg": [0, 5], "phi_e0_deg": [0, 5]},
        ),
        merge_tables(RECORDED, drawn={"phi_u0_deg": {"normal": [0, 10]}}),
        COMPASS,
        merge_tables(COMPASS, filter={}, resets={}),
        merge_tables(SIMULATED, compass={}, passes={}),
        merge_tables(SIMULATED, passes={"stored_s": 80}),
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
def test_resolved_study_reloads_equal(data: dict[str, Any], tmp_path: Path):
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


@pytest.mark.parametrize(
    "change",
    [
        {"study": {"seed": 2}},
        {"study": {"draws": 9}},
        {"study": {"window_s": [600, 899]}},
        {"earth": {"latitude_deg": 32.000001}},
        {"motion": {"yaw_center_deg": 21}},
        {"sensors": {"gyro_bias_deg_per_h": [0.1, 0, -0.2]}},
        {"alignment": {"method": "kalman5"}},
        {"filter": {"q_scale": 2.0}},
        {"resets": {"reset_kind": "yaw"}},
        {"axes": {"reset_count": [0, 2, 1]}},
        {"cases": [{"case": "small", "phi_u0_deg": 0}, {"case": "large", "phi_u0_deg": 31}]},
    ],
    ids=json.dumps,
)
def test_fingerprint_changes_with_any_value(change: dict[str, Any]):
    data = tomllib.loads(FULL)
    assert fingerprint(study_from_dict(merge_tables(data, **change))) != fingerprint(
        study_from_dict(data)
    )


def test_fingerprint_changes_with_axis_order():
    # It numbers the variants.
    data = tomllib.loads(FULL)
    other = data | {"axes": reversed_keys(data["axes"])}
    assert fingerprint(study_from_dict(other)) != fingerprint(study_from_dict(data))


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


# Unknown names


@pytest.mark.parametrize(
    ("tables", "line"),
    [
        ({"sensor": {}}, "[sensor]: unknown section (did you mean [sensors]?)"),
        (
            {"zzz": {}},
            "[zzz]: unknown section (is it of a method whose package is not installed?)",
        ),
        ({"duration_s": 1.0}, "duration_s: a key of [study] (move it there)"),
        ({"sensors": 3}, "[sensors]: must be a table of keys"),
        ({"axes": [1]}, "[axes]: must be a table of keys"),
        (
            {"study": {"duratoin_s": 1}},
            "[study] duratoin_s: unknown key (did you mean duration_s?)",
        ),
        ({"alignment": {"seed": 1}}, "[alignment] seed: unknown key (it belongs in [study])"),
        (
            {"alignment": {"reset_cuont": 1}},
            "[alignment] reset_cuont: unknown key (did you mean reset_count in [resets]?)",
        ),
        ({"filter": {"zzz": 1}}, "[filter] zzz: unknown key"),
        ({"passes": {"tape_s": 80}}, "[passes] tape_s: was renamed to stored_s"),
        ({"axes": {"tape_s": [80]}}, "[axes] tape_s: was renamed to stored_s"),
        ({"cases": [{"tape_s": 80}]}, "[cases] tape_s: was renamed to stored_s"),
        (
            {"filter": {"p0_yaw_deg": None}},
            "[filter] p0_yaw_deg: None is not a value (leave the key out)",
        ),
        (
            {"axes": {"phi_u_deg": [1]}},
            "[axes] phi_u_deg: unknown key (did you mean phi_u0_deg?)",
        ),
        (
            {"axes": {"level": {"phi_u_deg": [1]}}},
            "[axes.level] phi_u_deg: unknown key (did you mean phi_u0_deg?)",
        ),
        ({"draw": {}}, "[draw]: unknown section (did you mean [drawn]?)"),
        (
            {"axes": {"half_width": [1]}},
            "[axes] half_width: cannot be swept (it is a key of [stop_when])",
        ),
        ({"axes": {"case": ["a"]}}, "[axes] case: unknown key (did you mean passes?)"),
        (
            {"cases": [{"phi_u_deg": 1}]},
            "[cases] phi_u_deg: unknown key (did you mean phi_u0_deg?)",
        ),
        (
            {"axes": {"duration_s": [1, 2]}},
            (
                "[axes] duration_s: cannot be swept (all runs share [study]: use one study per"
                " value)"
            ),
        ),
        (
            {"cases": [{"rate_hz": 1}]},
            "[cases] rate_hz: cannot be swept (all runs share [study]: use one study per value)",
        ),
        (
            {"axes": {"start_s": [0, 30]}},
            "[axes] start_s: cannot be swept (list the start times in [record], one draw each)",
        ),
        (
            {"cases": [{"start_s": 0}]},
            "[cases] start_s: cannot be swept (list the start times in [record], one draw each)",
        ),
    ],
)
def test_unknown_and_misplaced_names_are_refused(tables: dict[str, Any], line: str):
    assert refusal_line(**tables) == line


# Values of single keys


@pytest.mark.parametrize(
    ("section", "key", "value", "text"),
    [
        ("study", "duration_s", True, "must be a number, not True"),
        ("study", "duration_s", "900", "must be a number, not '900'"),
        ("study", "duration_s", [1.0], "must be a number, not [1.0]"),
        ("study", "duration_s", {}, "must be a number, not {}"),
        ("study", "duration_s", 10**400, "must be a number, not 1000"),
        ("study", "duration_s", 0, "must be greater than 0, not 0"),
        ("study", "duration_s", -1.0, "must be greater than 0, not -1.0"),
        ("study", "duration_s", math.inf, "must be finite, not inf"),
        ("study", "rate_hz", 0.0, "must be greater than 0"),
        ("study", "rate_hz", 1e300, "must be less than or equal to 1"),
        ("study", "name", 3, "must be text, not 3"),
        ("study", "name", "", "must not be empty"),
        ("study", "draws", 0, "must be greater than or equal to 1, not 0"),
        ("study", "draws", 2.0, "must be a whole number, not 2.0"),
        ("study", "draws", True, "must be a whole number, not True"),
        ("study", "seed", -1, "must be greater than or equal to 0"),
        ("study", "seed", 2**63, "must be less than"),
        ("study", "curves", 1, "must be true or false, not 1"),
        ("study", "consistency_after_s", -1, "must be greater than or equal to 0"),
        ("study", "settle_bands_arcmin", 10, "must be a list, not 10"),
        ("study", "settle_bands_arcmin", [10, 10.0], "repeats a value (drop one)"),
        ("study", "settle_bands_arcmin", [3, 3.0000001], "repeats a value, to the 6 digits"),
        # 10 arcmin is always a column.
        ("study", "settle_bands_arcmin", [10.0000001], "two bands agree to the 6 digits"),
        ("study", "judged_from", "reference", "'truth' or 'floor'"),
        ("study", "judged_from", "limit", "'limit' was renamed (use 'floor')"),
        ("study", "success_band_arcmin", 10.0000001, "two bands agree to the 6 digits"),
        ("study", "level_band_arcmin", 0, "greater than 0"),
        ("study", "dwell_s", 1e9, "is not shorter than the run"),
        ("study", "diverged_deg", -1, "greater than 0"),
        ("study", "report_times_s", 100, "must be a list, not 100"),
        ("study", "report_times_s", [], "must not be empty"),
        ("study", "report_times_s", [0], "must be greater than 0"),
        ("study", "report_times_s", [200, 100], "must increase"),
        ("study", "report_times_s", [100, 100], "must increase"),
        ("study", "report_times_s", [100, 100.00001], "repeats a value, to the 6 digits"),
        ("study", "window_s", [1], "required"),
        ("study", "window_s", [1, 2, 3], "must have 2 values, not 3"),
        ("study", "window_s", [900, 600], "must be [a, b] with 0 <= a < b <= duration_s = 900"),
        ("study", "window_s", [600, 600], "must be [a, b] with"),
        ("study", "window_s", [600, 901], "must be [a, b] with"),
        ("earth", "earth", "flat", "must be 'constants' or 'wgs84', not 'flat'"),
        ("earth", "latitude_deg", 90, "must be less than 90, not 90"),
        ("earth", "latitude_deg", -90.0, "must be greater than -90"),
        ("earth", "latitude_deg", math.nan, "must be finite, not nan"),
        ("earth", "height_m", True, "must be a number"),
        ("motion", "pitch_center_deg", 90, "must be less than 90"),
        ("motion", "roll_amplitude_deg", -1, "must be greater than or equal to 0"),
        ("motion", "yaw_period_s", 0, "must be greater than 0"),
        ("sensors", "gyro_bias_deg_per_h", "0.1", "must be a number, not '0.1'"),
        ("sensors", "gyro_bias_deg_per_h", False, "must be a number, not False"),
        ("sensors", "gyro_noise_deg_per_h", -1, "must be greater than or equal to 0"),
        ("sensors", "gyro_misalignment_arcsec", [1] * 7, "must have 6 values, not 7"),
        (
            "alignment",
            "method",
            "kalman6",
            f"must be {ONE_OF_METHODS}, not 'kalman6'",
        ),
        ("alignment", "phi_u0_deg", 181, "must be less than or equal to 180"),
        ("alignment", "feedback_interval_s", 0, "must be greater than 0"),
        ("alignment", "feedback_time_constant_s", -0.5, "must be greater than or equal to 0"),
        ("filter", "p0_yaw_deg", 0, "must be greater than 0"),
        ("filter", "q_accel_ug", -1, "must be greater than or equal to 0"),
        ("filter", "r_velocity_m_per_s", 0, "must be greater than 0"),
        ("resets", "reset_count", -1, "must be greater than or equal to 0"),
        ("resets", "reset_count", 1.0, "must be a whole number, not 1.0"),
        ("resets", "reset_cycle_s", 0, "must be greater than 0"),
        ("resets", "reset_times_s", [50, 50], "must increase"),
        ("resets", "reset_times_s", [50, 40], "must increase"),
        ("resets", "reset_scale", 0, "must be greater than 0"),
    ],
)
def test_invalid_values_of_single_keys_are_refused(section: str, key: str, value: Any, text: str):
    line = refusal_line(**{section: {key: value}})
    assert re.match(rf"\[{section}\] {key}(\[\d\])?: ", line)
    assert text in line


def test_invalid_list_entries_are_named_by_index():
    line = refusal_line(study={"settle_bands_arcmin": [60, 10, 0]})
    assert line.startswith("[study] settle_bands_arcmin[2]: must be greater than 0, not 0")
    assert refusal_line(sensors={"accel_bias_ug": [1, 2, "3"]}).startswith(
        "[sensors] accel_bias_ug[2]: "
    )
    assert refusal_line(sensors={"accel_bias_ug": [1, 2]}) == "[sensors] accel_bias_ug[2]: required"


def test_long_values_are_shortened_in_messages():
    assert len(refusal_line(study={"duration_s": "x" * 1000})) < 120


NUMBERS = [
    (section, key)
    for section, model in SECTIONS.items()
    if section not in ("record", "coarse")
    for key, field in model.model_fields.items()
    if "float" in str(field.annotation) and "tuple" not in str(field.annotation)
]


NO_NUMBERS = (math.nan, math.inf, -math.inf, True, "1")


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        pytest.param(
            *place,
            value,
            id=f"{value}-{'.'.join(place)}",
            marks=()
            if (n - k) % len(NO_NUMBERS) == 0
            else pytest.mark.slow,  # one value of each key
        )
        for k, value in enumerate(NO_NUMBERS)
        for n, place in enumerate(NUMBERS)
    ],
)
def test_number_keys_refuse_nan_inf_bool_and_text(section: str, key: str, value: Any):
    given: dict[str, Any] = {}
    if section == "stop_when":
        given = STOP
    elif section == "tune":
        given = {"variables": {"p0_yaw_deg": {"low": 1.0, "high": 80.0}}}
    assert refusal_line(**{section: given | {key: value}}).startswith(
        f"[{section}] {key}: must be "
    )
    if section in SWEEPABLE:
        zipped = refusal_line(axes={"name": {key: [value]}})
        assert zipped.startswith(f"[axes.name] {key}[0]: must be ")
        assert refusal_line(axes={key: [value]}).startswith(f"[axes] {key}[0]: must be ")


@pytest.mark.parametrize("key", ["duration_s", "rate_hz"])
def test_missing_required_study_keys_are_refused(key: str):
    data = copy.deepcopy(SIMULATED)
    del data["study"][key]
    assert refusal_line(data).startswith(f"[study] {key}: required (")
    assert [line.partition(": required")[0] for line in refusal_lines({})] == [
        *("[study] duration_s", "[study] rate_hz"),
        *("[earth] latitude_deg", "[motion] yaw_center_deg"),
    ]


def test_missing_latitude_and_heading_are_refused():
    assert refusal_lines(SIMULATED, earth=3, motion=3) == [
        "[earth]: must be a table of keys",
        "[motion]: must be a table of keys",
    ]
    data = copy.deepcopy(SIMULATED)
    del data["motion"]
    assert refusal_line(data).startswith("[motion] yaw_center_deg: required (mean yaw, deg")
    del data["earth"]
    latitude, _ = refusal_lines(data)
    assert latitude.startswith("[earth] latitude_deg: required (latitude, positive north, deg")


# Axes and cases


@pytest.mark.parametrize(
    ("axes", "start"),
    [
        ({"phi_u0_deg": 30}, "[axes] phi_u0_deg: must be a list of values, not 30"),
        ({"phi_u0_deg": []}, "[axes] phi_u0_deg: must not be empty"),
        ({"phi_u0_deg": [0, 1, 2, "3"]}, "[axes] phi_u0_deg[3]: must be a number, not '3'"),
        ({"phi_u0_deg": [0, None]}, "[axes] phi_u0_deg[1]: None is not a value"),
        ({"reset_cycle_s": [None]}, "[axes] reset_cycle_s[0]: None is not a value"),
        ({"phi_u0_deg": [0, 200]}, "[axes] phi_u0_deg[1]: must be less than or equal to 180"),
        ({"phi_u0_deg": [30, 1, 30.0]}, "[axes] phi_u0_deg[2]: repeats [0] (drop one of them)"),
        (
            {"method": ["kalman5", "x"]},
            f"[axes] method[1]: must be {ONE_OF_METHODS}, not 'x'",
        ),
        ({"reset_times_s": [[50], [60, 50]]}, "[axes] reset_times_s[1]: must increase"),
        ({"accel_bias_ug": [1, [1, 2, "3"]]}, "[axes] accel_bias_ug[1][2]: must be a number"),
        (
            {"phi_u0_deg": {"uniform": [0, 1]}},
            "[axes.phi_u0_deg] uniform: unknown key",
        ),
        ({"level": {}}, "[axes.level]: must not be empty"),
        ({"level": [1]}, "[axes] level: unknown key"),
        ({"level": {"phi_u0_deg": 3}}, "[axes.level] phi_u0_deg: must be a list of values, not 3"),
        ({"level": {"phi_u0_deg": None}}, "[axes.level] phi_u0_deg: must be a list of values"),
        ({"level": {"phi_u0_deg": []}}, "[axes.level] phi_u0_deg: must not be empty"),
        ({"level": {"phi_u0_deg": [1, 181]}}, "[axes.level] phi_u0_deg[1]: must be less than"),
        ({"level": {"rate_hz": [1]}}, "[axes.level] rate_hz: cannot be swept (all runs share"),
        (
            {"level": {"phi_u0_deg": [1, 2], "phi_e0_deg": [1]}},
            "[axes.level] phi_e0_deg: has 1 values, but phi_u0_deg has 2 (give as many",
        ),
        (
            {"level": {"phi_u0_deg": [1, 1, 1], "phi_e0_deg": [1, 2, 1.0]}},
            "[axes.level] phi_u0_deg, phi_e0_deg[2]: repeats [0] (drop one of them)",
        ),
        (
            {"phi_u0_deg": [1], "level": {"phi_u0_deg": [1]}},
            "[axes.level] phi_u0_deg: is an axis already (drop one of them)",
        ),
        (
            {"level": {"phi_u0_deg": [1]}, "heading": {"phi_u0_deg": [1]}},
            "[axes.heading] phi_u0_deg: is an axis already (drop one of them)",
        ),
    ],
)
def test_invalid_axis_values_are_refused(axes: dict[str, Any], start: str):
    assert refusal_line(axes=axes).startswith(start)


@pytest.mark.parametrize(
    ("cases", "start"),
    [
        (3, "[cases]: must be tables"),
        ({"phi_u0_deg": 1}, "[cases]: must be tables"),
        ([1], "[cases]: must be tables"),
        ([], "[cases]: must not be empty"),
        ([{}], "[cases]: must not be empty"),
        ([{"phi_u0_deg": 1}, {"phi_u0_deg": "x"}], "[cases] phi_u0_deg[1]: must be a number"),
        ([{"phi_u0_deg": None}], "[cases] phi_u0_deg[0]: None is not a value"),
        ([{"phi_u0_deg": 1}, {"phi_e0_deg": 1}], "[cases] phi_u0_deg[1]: is not in every case"),
        (
            [{"phi_u0_deg": 1}, {"phi_u0_deg": 2, "case": "b"}],
            "[cases] case[1]: is not in every case",
        ),
        (
            [{"case": "a", "phi_u0_deg": 1}, {"phi_u0_deg": 2}],
            "[cases] case[1]: is not in every case",
        ),
        ([{"case": "", "phi_u0_deg": 1}], "[cases] case[0]: must not be empty"),
        ([{"case": 1, "phi_u0_deg": 1}], "[cases] case[0]: must be text, not 1"),
        (
            [{"case": "a", "phi_u0_deg": 1}, {"case": "a", "phi_u0_deg": 2}],
            "[cases] case[1]: repeats [0] (drop one of them)",
        ),
        (
            [{"case": "a", "phi_u0_deg": 1}, {"case": "b", "phi_u0_deg": 1.0}],
            "[cases] phi_u0_deg[1]: repeats [0] (drop one of them)",
        ),
        ([{"reset_kind": "full"}], "[cases] reset_kind: is an axis already"),
    ],
)
def test_invalid_case_values_are_refused(cases: Any, start: str):
    assert refusal_line(cases=cases, axes={"reset_kind": ["full"]}).startswith(start)
    assert refusal_line(cases=cases, axes={"zip": {"reset_kind": ["full"]}}).startswith(start)


# Rules between keys


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("gyro_noise_deg_per_h", "gyro_arw_deg_per_sqrt_h"),
        ("accel_noise_ug", "accel_vrw_ug_per_sqrt_hz"),
    ],
)
def test_noise_given_in_two_units_is_refused(one: str, other: str):
    expected = f"{one}: conflicts with {other} in [sensors] (give one of them)"
    assert refusal_line(sensors={one: 1, other: 1}) == f"[sensors] {expected}"
    assert refusal_line(sensors={other: 1}, axes={one: [1]}) == f"[axes] {expected}"
    study = build_study(sensors={other: 1})
    assert study.sensors is not None and getattr(study.sensors, one) is None


@pytest.mark.parametrize(
    ("resets", "axes", "line"),
    [
        (
            {"reset_times_s": [1], "reset_count": 0},
            {},
            "[resets] reset_times_s: conflicts with reset_count in [resets] (give one of them)",
        ),
        (
            {"reset_times_s": [1], "reset_cycle_s": 50},
            {},
            "[resets] reset_times_s: conflicts with reset_cycle_s in [resets] (give one of them)",
        ),
        (
            {"reset_count": 1, "reset_cycle_s": 50},
            {"reset_times_s": [[1], [2]]},
            "[axes] reset_times_s: conflicts with reset_count in [resets] (give one of them)",
        ),
        (
            {"reset_times_s": [1]},
            {"reset_count": [0, 1]},
            "[resets] reset_times_s: conflicts with reset_count in [axes] (give one of them)",
        ),
        (
            {"reset_count": 1},
            {},
            "[resets] reset_cycle_s: required with reset_count > 0 (it is 1)",
        ),
        (
            {},
            {"reset_count": [0, 2]},
            "[resets] reset_cycle_s: required with reset_count > 0 (it is 2)",
        ),
        (
            {"reset_count": 3, "reset_cycle_s": 301},
            {},
            "[resets] reset_cycle_s: 3 resets every 301 s take 903 s,"
            " longer than the run (duration_s = 900)",
        ),
        (
            {"reset_cycle_s": 50},
            {"reset_count": [0, 19]},
            "[axes] reset_count: 19 resets every 50 s take 950 s,"
            " longer than the run (duration_s = 900)",
        ),
        (
            {"reset_count": 2},
            {"reset_cycle_s": [50, 451]},
            "[axes] reset_cycle_s: 2 resets every 451 s take 902 s,"
            " longer than the run (duration_s = 900)",
        ),
        (
            {"reset_count": 2, "reset_cycle_s": 0.006},
            {},
            "[resets] reset_cycle_s: 0.006 s is shorter than a sample of 0.01 s",
        ),
        (
            {"reset_times_s": [50, 901]},
            {},
            "[resets] reset_times_s: 901 s is after the end of the run (duration_s = 900)",
        ),
        (
            {"reset_times_s": [0.004]},
            {},
            "[resets] reset_times_s: 0.004 s is at the sample of the start (a sample is 0.01 s)",
        ),
        (
            {},
            {"reset_times_s": [[], [50.0, 50.004]]},
            "[axes] reset_times_s: 50.004 s is at the sample of the reset at 50 s (a sample is"
            " 0.01 s)",
        ),
        (
            {"reset_times_s": [1], "reset_first_s": 50},
            {},
            "[resets] reset_times_s: conflicts with reset_first_s in [resets] (give one of them)",
        ),
        (
            {"reset_first_s": 25},
            {"reset_count": [0, 1, 2]},
            "[resets] reset_cycle_s: required with reset_count > 1 (it is 2)",
        ),
        (
            {"reset_count": 1},
            {"reset_first_s": [25, 901]},
            "[axes] reset_first_s: 901 s is after the end of the run (duration_s = 900)",
        ),
        (
            {"reset_count": 2, "reset_first_s": 0.004, "reset_cycle_s": 50},
            {},
            "[resets] reset_first_s: 0.004 s is at the sample of the start (a sample is 0.01 s)",
        ),
        (
            {"reset_count": 3, "reset_first_s": 101, "reset_cycle_s": 400},
            {},
            "[resets] reset_cycle_s: 3 resets from 101 s every 400 s take 901 s,"
            " longer than the run (duration_s = 900)",
        ),
        (
            {"reset_count": 2, "reset_first_s": 25, "reset_cycle_s": 0.006},
            {},
            "[resets] reset_cycle_s: 0.006 s is shorter than a sample of 0.01 s",
        ),
        (
            {"reset_count": 2, "reset_first_s": 0.015, "reset_cycle_s": 0.01},
            {},
            "[resets] reset_first_s: 0.015 s and a cycle of 0.01 s put two resets at one sample"
            " (a sample is 0.01 s)",
        ),
    ],
)
def test_invalid_resets_are_refused(resets: dict[str, Any], axes: dict[str, Any], line: str):
    assert refusal_line(resets=resets, axes=axes) == line


def test_valid_resets_are_accepted():
    build_study(resets={"reset_count": 3, "reset_cycle_s": 300})  # the last one exactly at the end
    build_study(resets={"reset_times_s": [0.01, 0.02, 900]})
    build_study(resets={"reset_count": 0, "reset_cycle_s": 1e6})
    build_study(resets={"reset_count": 0, "reset_first_s": 1e6})
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


# A rule for stopping


@pytest.mark.parametrize("statistic", ["success_rate", "settle_60_s_mean", "settle_10_s_mean"])
def test_supported_stop_statistics_are_accepted(statistic: str):
    stop = build_study(
        study={"settle_bands_arcmin": [60]}, stop_when=STOP | {"statistic": statistic}
    ).stop_when
    assert stop is not None and (stop.statistic, stop.half_width) == (statistic, 0.02)
    assert build_study().stop_when is None


@pytest.mark.parametrize(
    ("stop", "line"),
    [
        (
            STOP | {"statistic": "settle_3_s_mean"},
            "[stop_when] statistic: 'settle_3_s_mean' is not one of success_rate,"
            " settle_60_s_mean, settle_10_s_mean",
        ),
        (STOP | {"statistic": 3}, "[stop_when] statistic: must be text, not 3"),
        ({"half_width": 1}, "[stop_when] statistic: required ("),
        ({"statistic": "success_rate"}, "[stop_when] half_width: required ("),
        ({}, "[stop_when] statistic: required ("),
        (STOP | {"half_width": 0}, "[stop_when] half_width: must be greater than 0, not 0"),
        (STOP | {"half_width": 1}, "[stop_when] half_width: must be less than 1, a share, not 1"),
        (STOP | {"until": 3}, "[stop_when] until: unknown key"),
    ],
)
def test_invalid_stop_rules_are_refused(stop: dict[str, Any], line: str):
    assert refusal_lines(study={"settle_bands_arcmin": [60]}, stop_when=stop)[0].startswith(line)


def test_stop_half_width_of_mean_time_may_exceed_one_second():
    build_study(stop_when={"statistic": "settle_10_s_mean", "half_width": 5})


@pytest.mark.parametrize(
    ("tables", "line"),
    [
        (
            {"study": {"record_interval_s": 0.015}},
            "[study] record_interval_s: 0.015 s is not a whole number of samples of 0.01 s"
            " (nearest: 0.01 or 0.02)",
        ),
        (
            {"alignment": {"feedback_interval_s": 0.001}},
            "[alignment] feedback_interval_s: 0.001 s is not a whole number of samples of 0.01 s"
            " (nearest: 0.01)",
        ),
        (
            {"axes": {"feedback_interval_s": [1, 1.005]}},
            "[axes] feedback_interval_s: 1.005 s is not a whole number of samples of 0.01 s"
            " (nearest: 1 or 1.01)",
        ),
        (
            {"cases": [{"feedback_interval_s": 1e-300}]},
            "[cases] feedback_interval_s: 1e-300 s is not a whole number of samples of 0.01 s"
            " (nearest: 0.01)",
        ),
        (
            {"study": {"record_interval_s": 901, "window_s": [0, 900]}},
            "[study] record_interval_s: 901 s is longer than a run, duration_s = 900",
        ),
    ],
)
def test_invalid_intervals_are_refused(tables: dict[str, Any], line: str):
    assert refusal_line(**tables) == line


@pytest.mark.parametrize(
    ("record", "coarse", "line"),
    [
        (
            {"start_s": [30, 30.000000001]},
            {},
            "[record] start_s: 30.000000001 s is the sample of another start time (drop one)",
        ),
        (
            {"from_s": 30, "start_s": [20, 40]},
            {},
            "[record] start_s: 20 s is before from_s = 30 (start later)",
        ),
        ({"from_s": 30, "to_s": 30}, {}, "[record] to_s: must be after from_s = 30, not 30"),
        (
            {"time_unit": "ms"},
            {},
            ("[record] time_unit: requires a time_column (give it, or drop this)"),
        ),
        (
            {"max_gap_s": 1},
            {},
            "[record] max_gap_s: does not apply to format 'psins', which fixes it (drop it)",
        ),
        (
            {},
            {"coarse_duration_s": 0.01},
            "[coarse] coarse_duration_s: 0.01 s is not a whole number of samples of 0.01 s,"
            " 2 or more (nearest: 0.02)",
        ),
    ],
)
def test_invalid_record_times_are_refused(
    record: dict[str, Any], coarse: dict[str, Any], line: str
):
    assert refusal_line(RECORDED, record=record, coarse=coarse) == line
    build_study(RECORDED, record={"start_s": [0, 0.01]}, coarse={"coarse_duration_s": 0.02})
    assert build_study(RECORDED, record={"from_s": 30}).record.start_s == (30.0,)


@pytest.mark.parametrize(("written", "meant"), [("deg/s", "deg_per_s"), ("rad/s", "rad_per_s")])
def test_unit_with_a_slash_suggests_the_rate(written: str, meant: str):
    record = {"format": "csv", "gyro_unit": written}
    lines = refusal_lines(RECORDED, record=record)
    assert any(line.endswith(f"not '{written}' (did you mean {meant}?)") for line in lines)


def test_record_intervals_round_to_nearest_samples():
    """In a simulation, whose rate is given, such an interval is an error."""
    study = build_study(RECORDED, study={"rate_hz": 199.8}, record={"start_s": [0, 0.004]})
    assert study.record_every == 200
    line = "[study] record_interval_s: 1 s is not a whole number of samples of 0.005005005005"
    assert refusal_lines(study={"rate_hz": 199.8})[0].startswith(line)


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
    csv = {"format": "csv", "quantity": "rates", "gyro_unit": "deg_per_s", "accel_unit": "g"}
    csv |= {"gyro_columns": ["a", "b", "c"], "accel_columns": ["d", "e", "f"]}
    with pytest.raises(InputError, match=r"\[study\] rate_hz: required \(without a time_col"):
        study_from_dict({"study": {"duration_s": 300.0}, "record": csv})
    timed = {"study": {"duration_s": 300.0}, "record": csv | {"time_column": "t"}}
    study_from_dict(with_paper_values(timed))


# Compass loops and passes


@pytest.mark.parametrize(
    ("tables", "key", "method"),
    [
        ({"compass": {"level_time_s": 1}}, "[compass] level_time_s", "kalman5"),
        ({"axes": {"sigma_factors": [[1.0]]}}, "[axes] sigma_factors", "kalman5"),
        ({"passes": {"stored_s": 80, "turn": "keep"}}, "[passes] turn", "kalman5"),
        (
            {"axes": {"turn_smoothing_s": [1], "method": ["kalman5", "kalman10"]}},
            "[axes] turn_smoothing_s",
            "kalman10 or kalman5",
        ),
        (
            {"alignment": {"method": "compass"}, "filter": {"p0_yaw_deg": 1}},
            "[filter] p0_yaw_deg",
            "compass",
        ),
        (
            {"alignment": {"method": "compass"}, "resets": {"reset_count": 0}},
            "[resets] reset_count",
            "compass",
        ),
        (
            {"alignment": {"method": "compass", "feedback_interval_s": 1}},
            "[alignment] feedback_interval_s",
            "compass",
        ),
        (
            {"axes": {"method": ["compass"], "specific_force": ["measured"]}},
            "[axes] specific_force",
            "compass",
        ),
        (
            {"alignment": {"method": "compass"}, "passes": {"turn_covariance": "reset"}},
            "[passes] turn_covariance",
            "compass",
        ),
        (
            {"alignment": {"method": "compass"}, "cases": [{"turn_inflation": 3.0}]},
            "[cases] turn_inflation",
            "compass",
        ),
    ],
)
def test_keys_read_by_no_method_are_refused(tables: dict[str, Any], key: str, method: str):
    place, _, name = key.partition(" ")
    drop = f": --set axes.{name}={{}}" if place == "[axes]" else ""
    assert refusal_line(**tables) == f"{key}: does not apply to method {method} (drop it{drop})"
    build_study(merge_tables(SIMULATED, **tables), axes={"method": ["kalman5", "compass"]})


def test_section_read_by_no_method_is_refused_in_one_line():
    tables = {"alignment": {"method": "inertial"}, "filter": {"p0_yaw_deg": 9.0, "p0_level_deg": 9}}
    assert refusal_line(**tables) == (
        "[filter]: does not apply to method inertial: p0_yaw_deg, p0_level_deg"
        " (drop the section: --set filter={})"
    )


def test_unknown_method_has_no_second_error_for_its_section():
    tables = {
        "alignment": {"method": "compas"},
        "compass": {"level_time_s": 9, "level_damping": 0.7},
    }
    assert "(did you mean compass?)" in refusal_line(**tables)


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
    ("one", "others"),
    [
        ("level_gains", ("level_sigma_per_s", "level_adjustment_s")),
        ("level_adjustment_s", ("level_sigma_per_s",)),
        ("level_passes", ("level_time_s",)),
        ("azimuth_gains", ("azimuth_sigma_per_s", "azimuth_adjustment_s")),
        ("azimuth_adjustment_s", ("azimuth_sigma_per_s",)),
        ("sigma_passes", ("sigma_times_s",)),
    ],
)
def test_loop_settings_given_in_two_ways_are_refused(one: str, others: tuple[str, ...]):
    values = {"level_gains": [1.0, 2.0, 3.0], "azimuth_gains": [1.0, 2.0, 3.0, 4.0]}
    values |= {"level_passes": 1, "sigma_passes": [1], "sigma_times_s": [80.0]}
    values["sigma_factors"] = [2.0, 1.0]
    given = {key: values.get(key, 1.0) for key in (one, *others)}
    extra = {"passes": {"stored_s": 80.0}}
    for other in others:
        pair = {key: given[key] for key in (one, other)}
        line = refusal_line(COMPASS, compass=pair, **extra)
        assert line == f"[compass] {one}: conflicts with {other} in [compass] (give one of them)"
    more = {"sigma_factors": [2.0, 1.0]} if one == "sigma_passes" else {}
    alone = build_study(COMPASS, compass={one: given[one]} | more, **extra).compass
    assert alone is not None and all(getattr(alone, other) is None for other in others)


@pytest.mark.parametrize(
    ("passes", "line"),
    [
        ({"stored_s": 901}, "stored_s: 901 s is longer than a run (duration_s = 900)"),
        (
            {"stored_s": 80.5},
            "stored_s: 80.5 s is not a whole number of record intervals of 1 s (nearest: 80 or 81)",
        ),
        (
            {"stored_s": 0.4},
            "stored_s: 0.4 s is not a whole number of record intervals of 1 s (nearest: 1)",
        ),
        ({"stored_s": 0}, "stored_s: must be greater than 0, not 0"),
        ({"stored_s": 80, "passes": 0}, "passes: must be greater than or equal to 1, not 0"),
        (
            {"stored_s": 80, "passes": 12},
            "passes: 12 passes of 80 s take 960 s, longer than a run (duration_s = 900)",
        ),
        (
            {"stored_s": 80, "passes": 4, "ending": "forward"},
            (
                "passes: 4 passes end backward, which ending = 'forward' excludes (give an odd"
                " number)"
            ),
        ),
        ({"passes": 2}, "passes: 2 passes need a stored record (give stored_s)"),
        (
            {"stored_s": 80, "turn": "flip"},
            "turn: must be 'reflect', 'velocity', 'velocity_and_rate', 'velocity_drop_rate',"
            " 'restart' or 'keep', not 'flip'",
        ),
    ],
)
def test_invalid_passes_are_refused(passes: dict[str, Any], line: str):
    assert refusal_line(COMPASS, passes=passes, study={"window_s": [0, 100]}) == f"[passes] {line}"


def test_passes_are_checked_per_variant():
    axes = {"stored_s": [80, 100], "passes": [3, 10]}
    line = "[axes] passes: 10 passes of 100 s take 1000 s, longer than a run"
    assert refusal_line(axes=axes).startswith(line)
    build_study(cases=[{"stored_s": 80, "passes": 10}, {"stored_s": 100, "passes": 3}])


@pytest.mark.parametrize(
    ("passes", "spans"),
    [
        # Record intervals in the run and in a pass, of 900.
        ({}, (900, 900)),
        ({"passes": 1}, (900, 900)),
        ({"ending": "forward"}, (900, 900)),
        ({"stored_s": 80}, (900, 80)),
        ({"stored_s": 80, "passes": 3}, (240, 80)),
        ({"stored_s": 80, "passes": 11}, (880, 80)),
        ({"stored_s": 80, "ending": "forward"}, (880, 80)),
        ({"stored_s": 100, "ending": "forward"}, (900, 100)),
        ({"stored_s": 90, "ending": "forward"}, (810, 90)),
        ({"stored_s": 450, "ending": "forward"}, (450, 450)),
        ({"stored_s": 900}, (900, 900)),
        ({"stored_s": 90, "ending": "forward", "direction": "rewind"}, (900, 90)),
        ({"stored_s": 80, "passes": 4, "ending": "forward", "direction": "rewind"}, (320, 80)),
    ],
)
def test_run_and_pass_lengths_follow_passes_settings(
    passes: dict[str, Any], spans: tuple[int, int]
):
    (span,) = build_study(study={"window_s": [0, 200]}, passes=passes).spans
    assert (span.records, span.pass_records, span.rewinds) == (*spans, "direction" in passes)


@pytest.mark.parametrize(
    ("compass", "line"),
    [
        (
            {"sigma_factors": [2, 1]},
            "sigma_times_s: needs 1 entries for 2 sigma_factors, not 0",
        ),
        (
            {"sigma_factors": [2, 1], "sigma_times_s": [1, 2]},
            "sigma_times_s: needs 1 entries for 2 sigma_factors, not 2",
        ),
        ({"sigma_times_s": [3]}, "sigma_times_s: needs 0 entries for 1 sigma_factors, not 1"),
        ({"sigma_factors": [3, 2, 1], "sigma_times_s": [3, 2]}, "sigma_times_s: must increase"),
        (
            {"sigma_factors": [2, 1], "sigma_passes": [2]},
            "sigma_passes: needs passes over a stored record (give [passes] stored_s)",
        ),
        (
            {"level_passes": 1},
            "level_passes: needs passes over a stored record (give [passes] stored_s)",
        ),
        ({"level_passes": 0}, "level_passes: must be greater than or equal to 1, not 0"),
        ({"sigma_factors": []}, "sigma_factors: must not be empty, not []"),
        ({"sigma_factors": [2, 0]}, "sigma_factors[1]: must be greater than 0, not 0"),
        ({"level_gains": [1, 2]}, "level_gains[2]: required"),
        (
            {"azimuth_gains": [1, 2, 3, 4, 5]},
            "azimuth_gains: must have 4 values, not 5",
        ),
        ({"level_damping": 1.0}, "level_damping: must be less than 1, not 1.0"),
        ({"azimuth_damping": 0}, "azimuth_damping: must be greater than or equal to 0.01, not 0"),
        ({"adjustment_remainder": 1.0}, "adjustment_remainder: must be less than 1, not 1.0"),
        ({"azimuth_sigma_per_s": 0}, "azimuth_sigma_per_s: must be greater than 0, not 0"),
        ({"allow_unstable": 1}, "allow_unstable: must be true or false, not 1"),
    ],
)
def test_invalid_compass_loops_are_refused(compass: dict[str, Any], line: str):
    assert refusal_line(COMPASS, compass=compass) == f"[compass] {line}"


def test_sigma_times_must_match_sigma_factors_in_every_variant():
    factors, times = [[1.0], [2.0, 1.0]], [[], [100.0]]
    line = "[axes] sigma_times_s: needs 0 entries for 1 sigma_factors, not 1"
    assert refusal_line(COMPASS, axes={"sigma_factors": factors, "sigma_times_s": times}) == line
    pairs = zip(factors, times, strict=True)
    build_study(COMPASS, cases=[{"sigma_factors": f, "sigma_times_s": t} for f, t in pairs])
    counted = [{"sigma_factors": [2.0, 1.0], "sigma_passes": [2]}]
    assert refusal_line(COMPASS, cases=counted).startswith("[cases] sigma_passes: needs passes")
    build_study(COMPASS, cases=counted, passes={"stored_s": 80})


PARTIAL = {"duration_s": 900.5, "window_s": [600, 900]}


@pytest.mark.parametrize(
    ("tables", "start"),
    [
        (
            {"resets": {"reset_times_s": [900.2]}},
            "[resets] reset_times_s: 900.2 s is after the end of the run (",
        ),
        (
            {"resets": {"reset_count": 1, "reset_cycle_s": 900.2}},
            "[resets] reset_cycle_s: 1 resets every 900.2 s take 900.2 s, longer than the run (",
        ),
        (
            {"study": {"window_s": [899, 900.5]}},
            (
                "[study] window_s: fewer than 2 record times are after 899 s and up to 900.5 s"
                " (widen it; "
            ),
        ),
    ],
)
def test_events_in_last_partial_record_interval_are_refused(tables: dict[str, Any], start: str):
    end = "duration_s = 900.5; the last partial record interval, after 900 s, is not run)"
    assert refusal_line(merge_tables(SIMULATED, study=PARTIAL), **tables) == start + end


def test_run_ends_at_last_whole_record_interval():
    study = build_study(study=PARTIAL, resets={"reset_times_s": [900]})
    assert (study.run_s, study.dropped_s) == (900.0, 0.5)
    build_study(study=PARTIAL | {"window_s": [898, 900.5]})
    line = "[study] window_s: fewer than 2 record times are after 10 s and up to 11.9 s"
    assert refusal_line(study={"window_s": [10, 11.9]}) == f"{line} (widen it; duration_s = 900)"
    assert refusal_line(study={"window_s": [0, 0.5]}).startswith("[study] window_s: fewer than 2")


@given(
    every=st.integers(1, 50),
    rate=st.sampled_from([3.0, 7.0, 100.0, 333.3]),
    ends=st.tuples(st.integers(0, 400), st.integers(1, 400)).filter(lambda ab: ab[0] < ab[1]),
)
def test_window_must_contain_two_record_times(every: int, rate: float, ends: tuple[int, int]):
    start, end = (n / rate for n in ends)
    study = {"rate_hz": rate, "duration_s": 400 / rate, "record_interval_s": every / rate}
    times = [k * every / rate for k in range(1, 400 // every + 1)]
    tables = {"study": study | {"window_s": [start, end]}}
    tables["alignment"] = {"feedback_interval_s": 1 / rate}
    if sum(start < time <= end for time in times) < 2:
        assert refusal_line(**tables).startswith("[study] window_s: fewer than 2")
    else:
        build_study(**tables)


def test_oversized_studies_are_refused():
    line = (
        "[study] duration_s: 1000010 s at rate_hz = 100 is more than 100000000 samples per"
        " run (shorten the run)"
    )
    assert refusal_line(study={"duration_s": 1000010}) == line
    build_study(study={"duration_s": 1000000})
    axes = {key: [i / 100 for i in range(1000)] for key in ("phi_e0_deg", "phi_n0_deg")}
    line = (
        "draws x 1000000 variants of [axes] and [[cases]] are more than 1000000000 runs"
        " (reduce one of them)"
    )
    assert refusal_line(study={"draws": 1001}, axes=axes) == f"[study] draws: 1001 {line}"
    build_study(study={"draws": 1000}, axes=axes)
    starts = [float(i) for i in range(1001)]
    assert refusal_line(RECORDED, record={"start_s": starts}, axes=axes) == (
        f"[record] start_s: 1001 {line}"
    )


@pytest.mark.parametrize("name", ["report", "statements"])
def test_dropped_section_is_refused_with_reason(name: str):
    line = rf"\[{name}\]: was dropped, .* \(remove the section\)"
    assert re.fullmatch(line, refusal_line(**{name: {"layout": "auto"}}))


@given(samples=st.integers(1, 100_000), rate=st.floats(1, 1e4))
def test_whole_numbers_of_samples_are_accepted(samples: int, rate: float):
    study = {"rate_hz": rate, "duration_s": 1e3, "record_interval_s": 1 / rate, "unchecked": True}
    build_study(study=study, alignment={"feedback_interval_s": samples / rate})


@given(samples=st.floats(0.01, 1e5).filter(lambda x: 0.01 < x % 1 < 0.99), rate=st.floats(1, 1e4))
def test_suggested_nearest_intervals_are_accepted(samples: float, rate: float):
    study = {"rate_hz": rate, "duration_s": 1e3, "record_interval_s": 1 / rate, "unchecked": True}
    line = refusal_line(study=study, alignment={"feedback_interval_s": samples / rate})
    for near in line.rsplit("nearest: ")[1].rstrip(")").split(" or "):
        build_study(study=study, alignment={"feedback_interval_s": float(near)})


@pytest.mark.parametrize("key", ["gravity_m_per_s2", "radius_m", "earth_rate_deg_per_h"])
def test_earth_constants_are_refused_with_wgs84(key: str):
    text = f"{key}: requires earth = 'constants' (drop it with 'wgs84')"
    assert refusal_line(earth={"earth": "wgs84", key: 1}) == f"[earth] {text}"
    assert refusal_line(earth={"earth": "wgs84"}, axes={key: [1, 2]}) == f"[axes] {text}"
    assert refusal_line(earth={key: 1}, cases=[{"earth": "wgs84"}]) == f"[earth] {text}"
    assert getattr(build_study(earth={"earth": "wgs84"}).earth, key) is None
    study = {"unchecked": True}
    both = build_study(study=study, earth={key: 1}, axes={"earth": ["wgs84", "constants"]})
    assert both.values(key) == [1.0, 1.0]


def test_sway_amplitude_requires_period():
    line = "[motion] roll_period_s: required with roll_amplitude_deg > 0"
    assert refusal_line(motion={"roll_amplitude_deg": 1}) == line
    assert refusal_line(axes={"roll_amplitude_deg": [0, 1]}) == line
    build_study(motion={"roll_amplitude_deg": 0})
    build_study(motion={"roll_amplitude_deg": 1}, axes={"roll_period_s": [5, 6]})


# Recorded studies


@pytest.mark.parametrize(
    ("tables", "line"),
    [
        ({"motion": {}}, "[motion]: does not apply to a recorded study (drop it or [record])"),
        ({"sensors": {}}, "[sensors]: does not apply to a recorded study (drop it or [record])"),
        (
            {"study": {"draws": 1}},
            (
                "[study] draws: does not apply to a recorded study (drop it: there is one draw per"
                " start time)"
            ),
        ),
        (
            {"axes": {"accel_bias_ug": [1]}},
            "[axes] accel_bias_ug: does not apply to a recorded study (drop it, [sensors] is"
            " for simulations)",
        ),
        (
            {"axes": {"coarse_duration_s": [0.01]}},
            "[axes] coarse_duration_s: 0.01 s is not a whole number of samples of 0.01 s, 2 or"
            " more",
        ),
        ({"axes": {"to_s": [1]}}, "[axes] to_s: cannot be swept (it is a key of [record])"),
        (
            {"coarse": {"coarse_method": "none"}},
            (
                "[coarse] coarse_method: 'none' needs an initial attitude, which a record does not"
                " give (use 'inertial')"
            ),
        ),
        ({"record": {"start_s": [0, -1]}}, "[record] start_s[1]: must be greater than or equal to"),
        ({"record": {"start_s": [0, 30, 0.0]}}, "[record] start_s: repeats a value (drop one)"),
        ({"record": {"start_s": []}}, "[record] start_s: must not be empty"),
        ({"record": {"start_s": "0"}}, "[record] start_s[0]: must be a number, not '0'"),
        (
            {"record": {"axes_order": "xyy"}},
            "[record] axes_order: 'xyy' is not a signed permutation",
        ),
        ({"record": {"axes_order": "x-yz-"}}, "[record] axes_order: 'x-yz-' is not a signed"),
        ({"record": {"axes_order": "yxz"}}, "[record] axes_order: 'yxz' is left-handed"),
        ({"record": {"axes_order": "xy-z"}}, "[record] axes_order: 'xy-z' is left-handed"),
        ({"record": {"axes_order": 3}}, "[record] axes_order: must be text, not 3"),
        (
            {"record": {"format": "mat"}},
            "[record] format: must be 'psins', 'csv', 'parquet' or 'arrays'",
        ),
        (
            {"coarse": {"coarse_duration_s": 0}},
            "[coarse] coarse_duration_s: must be greater than 0",
        ),
        (
            {"coarse": {"coarse_method": "x"}},
            "[coarse] coarse_method: must be 'inertial', 'analytic'",
        ),
    ],
)
def test_invalid_recorded_studies_are_refused(tables: dict[str, Any], line: str):
    assert refusal_line(RECORDED, **tables).startswith(line)


def test_record_keys_depend_on_format():
    for key in (*TABULAR, "time_column"):
        if key != "format":
            value = TABULAR.get(key, "t")
            expected = f"[record] {key}: does not apply to format 'psins', which fixes it (drop it)"
            assert refusal_line(RECORDED, record={key: value}) == expected
    for format_ in ("csv", "parquet"):
        for key in TABULAR:
            if key not in ("format", "quantity"):
                table = {k: v for k, v in TABULAR.items() if k != key} | {"format": format_}
                expected = f"[record] {key}: required with format '{format_}'"
                assert refusal_line(RECORDED, record=table) == expected
    data = merge_tables(RECORDED, record={"start_s": 0})
    del data["record"]["format"]
    assert refusal_line(data) == "[record] format: required (format of the record)"


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (
            {"gyro_unit": "rad"},
            "gyro_unit: 'rad' is not one of rad_per_s, deg_per_s",
        ),
        (
            {"quantity": "increments"},
            "gyro_unit: 'deg_per_h' is not one of rad, deg, arcsec",
        ),
        ({"accel_unit": "g_s"}, "accel_unit: 'g_s' is not one of m_per_s2, g, mg, ug for rates"),
        ({"accel_unit": "ft"}, "accel_unit: must be 'm_per_s', "),
        ({"gyro_columns": ["a", "b"]}, "gyro_columns[2]: required"),
        ({"gyro_columns": ["a", "b", ""]}, "gyro_columns[2]: must not be empty"),
        (
            {"accel_columns": ["ax", "ay", "gx"]},
            "accel_columns: column 'gx' is already used",
        ),
        ({"time_column": "gx"}, "gyro_columns: column 'gx' is already used in time_column"),
    ],
)
def test_invalid_tabular_record_keys_are_refused(change: dict[str, Any], line: str):
    assert refusal_line(RECORDED, record=TABULAR | change).startswith(f"[record] {line}")


def test_stop_when_is_refused_for_recorded_study():
    line = "[stop_when]: does not apply to a recorded study (drop it or [record])"
    assert refusal_line(RECORDED, stop_when=STOP) == line

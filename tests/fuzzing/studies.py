"""Study files: valid ones of every kind with some keys changed, according to the schema."""

import copy
import functools
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import tomli_w
from hypothesis import strategies as st

from fuzzing.edits import HiddenValue, edit_tables, mangle_bytes
from fuzzing.values import TEXTS, draw_table, misfit_values, values_of_field
from sinsjax.methods.registry import METHODS
from sinsjax.study.keys import SECTIONS, SWEEPABLE, TUNABLE, alternative_keys
from sinsjax.study.schema import NUMBERS_DRAWN

CONFIGS = Path(__file__).parents[2] / "configs"

BASE: dict[str, dict[str, Any]] = {
    "study": {"duration_s": 6.0, "rate_hz": 100.0, "draws": 3},
    "earth": {"latitude_deg": 32.0},
    "motion": {"yaw_center_deg": 10.0},
    "sensors": {"gyro_noise_deg_per_h": 0.1, "accel_noise_ug": 500.0},
}
RECORDED: dict[str, dict[str, Any]] = {
    "study": {"duration_s": 2.0, "rate_hz": 10.0, "record_interval_s": 0.5},
    "earth": {"latitude_deg": 32.0},
    "record": {"format": "psins", "start_s": [0, 1]},
    "filter": {"q_accel_ug": 500.0, "q_gyro_deg_per_h": 0.1, "q_reading": "per_sample"},
    "coarse": {"coarse_duration_s": 2.0},
}
_ADDED = tomllib.loads("""
plain = {}
coarse.coarse = {coarse_duration_s = 2.0, coarse_then = "replay"}
passes = {passes = {stored_s = 2.0}, axes = {method = ["kalman10", "compass"]}}
trigger.resets = {reset_trigger = "innovation", trigger_threshold = 9.0}
cases.cases = [{case = "a", p0_yaw_deg = 10.0}, {case = "b", p0_yaw_deg = 20.0}]
zips.axes = {p0_yaw_deg = [1.0, 2.0], start = {phi_u0_deg = [1, 2], phi_e0_deg = [0, 1]}}
[drawn]
drawn = {phi_u0_deg = {uniform = [-10, 10]}, gyro_bias_deg_per_h = {normal = [0, 0.1]}}
stop_when = {statistic = "success_rate", half_width = 0.1}
[tuned.tune]
searches = ["grid"]
variables.p0_yaw_deg = {low = 1.0, high = 80.0}
baseline.p0_yaw_deg = 5.0
""")
_OF_METHODS = {name: {"alignment": {"method": name, "phi_u0_deg": 30.0}} for name in METHODS}
BASES = {name: BASE | more for name, more in (_ADDED | _OF_METHODS).items()}
BASES["recorded"] = RECORDED


@functools.cache
def _shipped_tables() -> tuple[dict[str, Any], ...]:
    paths = sorted(CONFIGS.glob("*.toml"))
    return tuple(tomllib.loads(path.read_text(encoding="utf-8")) for path in paths)


KEYS = [(name, key) for name, model in SECTIONS.items() for key in model.model_fields]
_SWEPT = [(name, key) for name, key in KEYS if name in SWEEPABLE]
_TUNED = [(name, key) for name, key in KEYS if name in TUNABLE]


@functools.cache
def value_strategy(place: tuple[str, str]) -> st.SearchStrategy[Any]:
    """Return a strategy for values of a key, three of four of its type."""
    fitting = values_of_field(SECTIONS[place[0]].model_fields[place[1]])
    return st.one_of(fitting, fitting, fitting, misfit_values())


def _draw_law(draw: st.DrawFn, place: tuple[str, str]) -> Any:
    """Draw a distribution of a drawn key, or a range of a tuned one."""
    kinds = ["uniform", "normal", "values", "fixed", "candidates", "low", "list"]
    kind = draw(st.sampled_from(kinds))
    number = st.floats(-10, 400) | st.sampled_from([0, 1, 1e12, -1e12, 1e300])
    low, high = sorted([draw(number), draw(number)])
    if kind in ("uniform", "normal"):
        return {kind: [low, high]}
    if kind in ("low", "list"):
        ends = {"low": low, "high": high}
        return [ends] * draw(st.integers(0, 2)) if kind == "list" else ends | {"scale": "log"}
    return {kind: draw(value_strategy(place) | st.lists(value_strategy(place), max_size=4))}


def _get_table(data: dict[str, Any], section: str) -> dict[str, Any]:
    """Return a table to be changed, which replaces any other value."""
    if not isinstance(data.get(section), dict):
        data[section] = {}
    return data[section]


def _remove_key(data: dict[str, Any], place: tuple[str, str]) -> None:
    """Remove a key and its alternatives from its section, to vary it elsewhere."""
    for key in {place[1], *alternative_keys(place[1])}:
        if isinstance(data.get(place[0]), dict):
            data[place[0]].pop(key, None)


_EDITS = ["key"] * 6 + ["axis", "axis", "zip", "case", "drawn", "drawn", "tuned", "tuned"]
_EDITS += ["section", "unknown"]


def _edit_study(draw: st.DrawFn, data: dict[str, Any]) -> None:
    kind = draw(st.sampled_from(_EDITS))
    if kind in ("key", "unknown"):
        place = draw(st.sampled_from(KEYS))
        name = place[1] if kind == "key" else draw(st.sampled_from([*TEXTS, place[1][:-1]]))
        _get_table(data, place[0])[name] = draw(value_strategy(place))
    elif kind == "section":
        section = draw(st.sampled_from(list(SECTIONS)))
        data[section] = draw(draw_table(SECTIONS[section].model_fields))
    elif kind == "drawn":
        place = draw(st.sampled_from([p for p in _SWEPT if p[1] in NUMBERS_DRAWN]))
        _remove_key(data, place)
        _get_table(data, "drawn")[place[1]] = _draw_law(draw, place)
    elif kind == "tuned":
        place = draw(st.sampled_from(_TUNED))
        tune = _get_table(data, "tune")
        tune.setdefault("searches", ["sobol"])
        table = _get_table(tune, draw(st.sampled_from(["variables", "variables", "baseline"])))
        table[place[1]] = _draw_law(draw, place)
    else:
        place = draw(st.sampled_from(_SWEPT))
        _remove_key(data, place)
        values = draw(st.lists(value_strategy(place), min_size=1, max_size=4))
        if kind == "case":
            data["cases"] = [{"case": str(i), place[1]: value} for i, value in enumerate(values)]
        elif kind == "zip":
            _get_table(_get_table(data, "axes"), "joint")[place[1]] = values
        else:
            _get_table(data, "axes")[place[1]] = values


@st.composite
def study_tables(draw: st.DrawFn) -> dict[str, Any]:
    """Draw the tables of a valid study with some of its keys changed."""
    kind = draw(st.sampled_from([*BASES, *BASES, "shipped", "made"]))
    if kind == "made":  # of nothing but the schema
        names = draw(st.lists(st.sampled_from(list(SECTIONS)), unique=True, max_size=4))
        data = {name: draw(draw_table(SECTIONS[name].model_fields)) for name in names}
    else:
        base = draw(st.sampled_from(_shipped_tables())) if kind == "shipped" else BASES[kind]
        data = copy.deepcopy(base)
    for _ in range(draw(st.sampled_from([0, 1, 1, 1, 1, 2, 2, 3]))):
        _edit_study(draw, data)
    return data


def studies_with_value(value: Any) -> Iterator[dict[str, Any]]:
    """Yield studies with a value for every key, also swept, drawn or tuned."""
    for section, key in KEYS:
        base = RECORDED if section in ("record", "coarse") else BASE
        yield base | {section: base.get(section, {}) | {key: value}}
        if section in SWEEPABLE:
            plain = copy.deepcopy(BASE)
            _remove_key(plain, (section, key))
            for axis in (value, [value, value]):
                yield plain | {"axes": {key: axis}}
            yield plain | {"cases": [{key: value}]}
            for law in (value, {"values": [value]}):
                yield plain | {"drawn": {key: law}}
        if section in TUNABLE:
            for kind in (value, {"fixed": value}, [{"low": value, "high": value}]):
                yield BASE | {"tune": {"variables": {key: kind}}}


def to_toml_bytes(data: Any) -> bytes:
    """Return tables as TOML, without None."""

    def remove_none(value: Any) -> Any:
        if isinstance(value, dict):
            return {str(k): remove_none(v) for k, v in value.items() if v is not None}
        if isinstance(value, list | tuple):
            return [remove_none(v) for v in value if v is not None]
        return value

    return tomli_w.dumps(remove_none(data)).encode("utf-8", "replace")


@st.composite
def study_files(draw: st.DrawFn) -> bytes:
    """Draw the content of a study file."""
    kind = draw(st.sampled_from(["tables"] * 8 + ["edited", "mangled"]))
    data = draw(study_tables())
    if kind == "edited" and data:
        data = draw(edit_tables(HiddenValue(data)))
    content = to_toml_bytes(data)
    return draw(mangle_bytes(HiddenValue(content))) if kind == "mangled" else content

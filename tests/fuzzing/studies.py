"""Study files: valid ones of every kind with some keys changed, according to the schema."""

import copy
import functools
import tomllib
from pathlib import Path
from typing import Any

import tomli_w
from hypothesis import strategies as st
from support.studies import small_tables

from fuzzing.edits import HiddenValue, edit_tables, mangle_bytes
from fuzzing.values import TEXTS, draw_table, misfit_values, values_of_field
from sinsjax.methods.registry import METHODS
from sinsjax.study.keys import SECTIONS, SWEEPABLE, TUNABLE, alternative_keys
from sinsjax.study.schema import NUMBERS_DRAWN

CONFIGS = Path(__file__).parents[2] / "configs"

_ADDED = tomllib.loads("""
plain = {}
coarse.coarse = {coarse_duration_s = 2.0, coarse_then = "replay"}
passes = {passes = {stored_s = 2.0}, axes = {method = ["kalman10", "compass"]}}
trigger.resets = {reset_trigger = "innovation", trigger_threshold = 9.0}
cases.cases = [{case = "a", p0_yaw_deg = 10.0}, {case = "b", p0_yaw_deg = 20.0}]
zips.axes = {p0_yaw_deg = [1.0, 2.0], start = {phi_u0_deg = [1, 2], phi_e0_deg = [0, 1]}}
recorded = {record = {format = "psins", start_s = [0, 1]}, coarse = {coarse_duration_s = 2.0}}
[drawn]
drawn = {phi_u0_deg = {uniform = [-10, 10]}, gyro_bias_deg_per_h = {normal = [0, 0.1]}}
stop_when = {statistic = "success_rate", half_width = 0.1}
[tuned.tune]
searches = ["grid"]
variables.p0_yaw_deg = {low = 1.0, high = 80.0}
baseline.p0_yaw_deg = 5.0
""")
BASES = {name: small_tables(**more) for name, more in _ADDED.items()}
BASES |= {name: small_tables(alignment={"method": name}) for name in METHODS}
for name in ("motion", "sensors", "alignment"):
    del BASES["recorded"][name]
del BASES["recorded"]["study"]["draws"], BASES["recorded"]["study"]["window_s"]
del BASES["drawn"]["sensors"]["gyro_bias_deg_per_h"], BASES["drawn"]["alignment"]["phi_u0_deg"]


@functools.cache
def _shipped_tables() -> tuple[dict[str, Any], ...]:
    paths = sorted(CONFIGS.glob("*.toml"))
    return tuple(tomllib.loads(path.read_text(encoding="utf-8")) for path in paths)


KEYS = [(name, key) for name, model in SECTIONS.items() for key in model.model_fields]
_SWEPT = [(name, key) for name, key in KEYS if name in SWEEPABLE]
_DRAWN = [place for place in _SWEPT if place[1] in NUMBERS_DRAWN]
_TUNED = [(name, key) for name, key in KEYS if name in TUNABLE]


@functools.cache
def value_strategy(place: tuple[str, str]) -> st.SearchStrategy[Any]:
    """Return a strategy for values of a key, three of four of its type."""
    fitting = values_of_field(SECTIONS[place[0]].model_fields[place[1]])
    return st.one_of(fitting, fitting, fitting, misfit_values())


def _draw_law(draw: st.DrawFn, place: tuple[str, str]) -> Any:
    """Draw a distribution of a drawn key, or a range of a tuned one."""
    kind = draw(st.sampled_from(["uniform", "normal", "values", "fixed", "candidates", "low"]))
    number = st.floats(-10, 400) | st.sampled_from([0, 1, 1e12, -1e12, 1e300])
    low, high = sorted([draw(number), draw(number)])
    if kind in ("uniform", "normal"):
        return {kind: [low, high]}
    if kind == "low":
        return {"low": low, "high": high, "scale": "log"}
    return {kind: draw(value_strategy(place) | st.lists(value_strategy(place), max_size=4))}


def _remove_key(data: dict[str, Any], place: tuple[str, str]) -> None:
    """Remove a key and its alternatives from its section, to vary it elsewhere."""
    for key in {place[1], *alternative_keys(place[1])}:
        data.get(place[0], {}).pop(key, None)


_EDITS = [*["key"] * 6, *["axis", "drawn", "tuned"] * 2, "zip", "case", "section", "unknown"]


def _edit_study(draw: st.DrawFn, data: dict[str, Any]) -> None:
    """Change a key in its section, or where it is swept, drawn or tuned."""
    kind = draw(st.sampled_from(_EDITS))
    places = {"drawn": _DRAWN, "tuned": _TUNED, "axis": _SWEPT, "zip": _SWEPT, "case": _SWEPT}
    place = section, key = draw(st.sampled_from(places.get(kind, KEYS)))
    if kind in ("key", "unknown"):
        name = key if kind == "key" else draw(st.sampled_from([*TEXTS, key[:-1]]))
        data.setdefault(section, {})[name] = draw(value_strategy(place))
    elif kind == "section":
        data[section] = draw(draw_table(SECTIONS[section].model_fields))
    elif kind == "drawn":
        _remove_key(data, place)
        data.setdefault("drawn", {})[key] = _draw_law(draw, place)
    elif kind == "tuned":
        tune = data.setdefault("tune", {"searches": ["sobol"]})
        name = draw(st.sampled_from(["variables", "variables", "baseline"]))
        table = tune.get(name)  # what a mistake put there has no keys
        tune[name] = (table if isinstance(table, dict) else {}) | {key: _draw_law(draw, place)}
    else:
        _remove_key(data, place)
        values = draw(st.lists(value_strategy(place), min_size=1, max_size=4))
        if kind == "case":
            data["cases"] = [{"case": str(i), key: value} for i, value in enumerate(values)]
        else:
            axis = {key: values} if kind == "axis" else {"joint": {key: values}}
            data.setdefault("axes", {}).update(axis)


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
    """Draw the content of a valid study file with some keys, entries or bytes changed."""
    data = copy.deepcopy(draw(st.sampled_from([*BASES.values(), *_shipped_tables()])))
    for _ in range(draw(st.sampled_from([0, 1, 1, 1, 1, 2, 2, 3]))):
        _edit_study(draw, data)
    kind = draw(st.sampled_from(["tables"] * 8 + ["edited", "mangled"]))
    content = to_toml_bytes(draw(edit_tables(HiddenValue(data))) if kind == "edited" else data)
    return draw(mangle_bytes(HiddenValue(content))) if kind == "mangled" else content

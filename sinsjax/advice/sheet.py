"""The sheet of an IMU: a study without an alignment, read, checked and completed."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from sinsjax.bounds.turn_planner import LONGEST_S, SHORTEST_S
from sinsjax.errors import InputError
from sinsjax.messages import describe_broken_rule, suggest_closest
from sinsjax.platform.assets import asset_path
from sinsjax.study import files
from sinsjax.study.changes import apply_changes
from sinsjax.study.keys import SECTION_OF, TomlTable
from sinsjax.study.load import SHEET_TABLES, study_from_dict
from sinsjax.study.schema import AdviseSection
from sinsjax.study.study import Study
from sinsjax.study.sweep import correctable_errors
from sinsjax.units import DEG_PER_H, DEG_PER_SQRT_H, micro_g

_SHEETS = "configs/imu"
TIMES_S = (60.0, 120.0, 300.0, 600.0, 1800.0)
"""Times at which the heading is always given, s."""

_DRAWS, _RATE_HZ = 1024, 100.0
_ROCKING = {
    **{"pitch_amplitude_deg": 1.8, "roll_amplitude_deg": 2.4, "yaw_amplitude_deg": 2.8},
    **{"pitch_period_s": 6.0, "roll_period_s": 8.0, "yaw_period_s": 10.0},
}
MOTIONS: dict[str, dict[str, Any]] = {
    "still": {},
    "rocking": _ROCKING,
    "surging": _ROCKING | {"surge_m_per_s": 0.1, "surge_time_s": 5.0, "lever_arm_m": 1.0},
}
"""Motions by name: at rest, rotating as paper 1's base, and the same translating as well."""

CONSTANT_KEYS = (
    *("gyro_bias_deg_per_h", "accel_bias_ug", "gyro_scale_ppm", "gyro_misalignment_arcsec"),
    *("accel_scale_ppm", "accel_misalignment_arcsec"),
)
"""Keys of errors that stay constant; advice takes a fixed value for 1 sigma."""

_USUAL = {
    "gyro_instability_deg_per_h": (1e-4, 100.0, "deg/h"),
    "gyro_rrw_deg_per_h_per_sqrt_h": (1e-4, 1e3, "deg/h/sqrt(h)"),
    "gyro_arw_deg_per_sqrt_h": (1e-4, 2.0, "deg/sqrt(h)"),
    "gyro_bias_deg_per_h": (5e-4, 2e4, "deg/h"),
    "accel_instability_ug": (0.5, 2e3, "ug"),
    "accel_rrw_ug_per_sqrt_h": (0.1, 1e5, "ug/sqrt(h)"),
    "accel_vrw_ug_per_sqrt_hz": (1.0, 1e3, "ug/sqrt(Hz)"),
    "accel_bias_ug": (5.0, 1e5, "ug"),
}
"""Usual values from laser gyros to telephones, and their unit."""

_NAMES = {
    "instability": ("instability",),
    "rrw": ("rrw", "rate_random_walk", "acceleration_random_walk"),
    "arw": ("arw", "vrw", "random_walk", "noise"),
    "bias": ("bias", "turn_on", "repeatability", "offset"),
}
"""What data sheets call each quantity; the first that fits decides."""

_OTHER_UNITS = {
    "gyro": {
        "rad_per_s_per_sqrt_hz": ("arw", 1 / DEG_PER_SQRT_H),
        "rad_per_sqrt_s": ("arw", 1 / DEG_PER_SQRT_H),
        "deg_per_s_per_sqrt_hz": ("arw", 60.0),
        "deg_per_h_per_sqrt_hz": ("arw", 1 / 60),
        "deg_per_sqrt_s": ("arw", 60.0),
        "rad_per_s": (None, 1 / DEG_PER_H),
        "deg_per_s": (None, 3600.0),
    },
    "accel": {
        "m_per_s2_per_sqrt_hz": ("arw", 1 / micro_g()),
        "m_per_s_per_sqrt_h": ("arw", 1 / (60 * micro_g())),
        "mg_per_sqrt_hz": ("arw", 1e3),
        "m_per_s2": (None, 1 / micro_g()),
        "mg": (None, 1e3),
    },
}
"""Units of data sheets by sensor: the quantity that has them, if just one, and the factor."""

_NOISE = {
    "gyro_arw_deg_per_sqrt_h": ("gyro_noise_deg_per_h", "the angle random walk of the data sheet"),
    "accel_vrw_ug_per_sqrt_hz": ("accel_noise_ug", "the velocity random walk of the data sheet"),
}


@dataclass(frozen=True)
class Sheet:
    """An IMU, its place and motion, and what is asked.

    Attributes:
        name: of the sheet.
        tables: of a study, without a method; constant errors are drawn.
        asked: what is asked.
        doubts: values of the sheet that may be mistaken, a line each.
    """

    name: str
    tables: TomlTable
    asked: AdviseSection
    doubts: tuple[str, ...]

    @property
    def times_s(self) -> tuple[float, ...]:
        """Times to report, s, the time asked for among them.

        A file of the attitude ends them, and so do turns that come later than the time asked for.
        """
        asked = self.asked.time_s
        usual = (time for time in TIMES_S if time < asked or not self.is_turned)
        return tuple(sorted({asked, *usual}))

    @property
    def is_turned(self) -> bool:
        """Whether the sheet turns the base, or has its attitude in a file."""
        return bool(self.tables["motion"].keys() & {"turn_times_s", "attitude_file"})

    def study(self, sections: Mapping[str, Any], **settings: Any) -> Study:
        """Return a study of the sheet with a method.

        Args:
            sections: further sections, by name.
            settings: keys of [study] that replace those of the sheet.
        """
        tables = self.tables | dict(sections)
        tables["study"] = self.tables["study"] | settings
        return study_from_dict(without_empty(tables), self.name)

    def sigma(self, key: str) -> float:
        """Return the size of a sensor error: 1 sigma if it is constant, else its density or rms."""
        if key in (drawn := self.tables["drawn"]):
            return float(drawn[key]["normal"][1])
        return rms(self.tables["sensors"].get(key, 0.0))


def without_empty(tables: TomlTable) -> TomlTable:
    """Return the tables of a study without empty ones, and without an empty list of times."""
    out = {name: table for name, table in tables.items() if table}
    if not out["study"].get("report_times_s", True):
        out["study"] = {k: v for k, v in out["study"].items() if k != "report_times_s"}
    return out


def shipped_sheets() -> dict[str, Path]:
    """Return the sheets that come with the package, by name."""
    return {path.stem: path for path in sorted(asset_path(_SHEETS).glob("*.toml"))}


def describe_sheets() -> list[str]:
    """Return a line for each shipped sheet: its name and its first comment."""
    lines = {}
    for name, path in shipped_sheets().items():
        lines[name] = path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
    return [f"{name:<12} {words}" for name, words in lines.items()]


def read_sheet(
    source: str | Path | Mapping[str, Any] | None,
    *,
    imu: str | None = None,
    latitude_deg: float | None = None,
    time_s: float | None = None,
    motion: str | None = None,
    changes: Mapping[str, Any] | None = None,
) -> Sheet:
    """Read and check a sheet, see `sinsjax.advise`."""
    name, data = _read_tables(source, imu)
    try:
        return _complete(name, _changed(data, latitude_deg, time_s, motion, changes or {}))
    except InputError as error:
        if error.lines[0].startswith(f"{name}: "):
            raise
        raise error.with_source(name) from None


def _read_tables(source: str | Path | Mapping[str, Any] | None, imu: str | None) -> tuple[str, Any]:
    if (source is None) == (imu is None):
        raise InputError("give a sheet or --imu NAME, one of the two (`sinsjax advise --imu list`)")
    if isinstance(source, Mapping):
        return "sheet", source
    if source is not None:
        path = Path(source)
        return files.source_name(path), files.read_tables(path)
    sheets = shipped_sheets()
    if imu not in sheets:
        hint = suggest_closest(str(imu), sheets)
        raise InputError(f"--imu {imu}: is none of {', '.join(sheets)}{hint}")
    return str(imu), files.read_tables(sheets[str(imu)])


def _changed(
    data: Mapping[str, Any],
    latitude_deg: float | None,
    time_s: float | None,
    motion: str | None,
    changes: Mapping[str, Any],
) -> TomlTable:
    """Return the tables with what options replace."""
    options: dict[str, Any] = {}
    if motion is not None:
        if motion not in MOTIONS:
            raise InputError(f"--motion {motion}: is none of {', '.join(MOTIONS)}")
        data = {key: table for key, table in data.items() if key != "motion"}
        options |= {f"motion.{key}": value for key, value in MOTIONS[motion].items()}
    if latitude_deg is not None:
        options["earth.latitude_deg"] = latitude_deg
    if time_s is not None:
        options["advise.time_s"] = time_s
    _check_tables(data)
    changed = apply_changes(apply_changes(data, options), changes)
    _check_tables(changed)
    return changed


def _check_tables(data: Mapping[str, Any]) -> None:
    """Refuse other sections than those of a sheet, and names without the unit of their key."""
    for name, table in data.items():
        if name not in SHEET_TABLES:
            text = (
                "does not belong in a sheet (`sinsjax advise` chooses the method and its settings)"
            )
            raise InputError(f"[{name}]: {text}{suggest_closest(name, SHEET_TABLES, '[{}]')}")
        if not isinstance(table, Mapping):
            raise InputError(f"[{name}]: must be a table of keys")
    given = ((name, key) for name in ("sensors", "drawn") for key in data.get(name, {}))
    unknown = [(name, key) for name, key in given if key not in SECTION_OF]
    hints = {key: _describe_unknown_key(key) for _, key in unknown}
    if any(hints.values()):
        raise InputError(
            *(
                f"[{name}] {key}: unknown key{hints[key] or suggest_closest(key, SECTION_OF)}"
                for name, key in unknown
            )
        )


def _describe_unknown_key(key: str) -> str:
    """Return the key of a quantity, and the factor to its unit, from a name of a data sheet."""
    sensor = key.partition("_")[0]
    units = _OTHER_UNITS.get(sensor, {})
    only, factor = next((units[unit] for unit in units if key.endswith(unit)), (None, None))
    words = (name for name, words in _NAMES.items() if any(word in key for word in words))
    quantity = next(words, only)
    if only == "arw" and quantity != "rrw":
        quantity = only
    for known, (low, high, unit) in _USUAL.items():
        if quantity and known.startswith((f"{sensor}_{quantity}", f"{sensor}_v{quantity[1:]}")):
            convert = f"multiply by {factor:.6g}, " if factor else ""
            return f" (did you mean {known}? {convert}usually {low:g} to {high:g} {unit})"
    return ""


def _complete(name: str, data: TomlTable) -> Sheet:
    """Check the tables and fill in what a study needs."""
    given = data.get("study", {})
    asked = _read_asked({"time_s": given.get("duration_s", 300.0)} | data.get("advise", {}))
    if not SHORTEST_S <= asked.time_s <= LONGEST_S or asked.time_s % 1:
        text = f"must be whole seconds from {SHORTEST_S:g} to {LONGEST_S:g}, not {asked.time_s:g}"
        raise InputError(f"[advise] time_s: {text}")
    if not data.get("earth"):
        raise InputError("[earth] latitude_deg: required, deg (--latitude)")
    study = {"draws": _DRAWS, "rate_hz": _RATE_HZ} | given
    study |= {"duration_s": asked.time_s, "record_interval_s": 1.0}
    study["report_times_s"] = [time for time in TIMES_S if time < asked.time_s]
    study.setdefault("name", name.rpartition("/")[2].removesuffix(".toml"))
    if isinstance(study["rate_hz"], float) and study["rate_hz"] % 1:
        text = f"must be whole in a sheet, not {study['rate_hz']:g} (no number depends on it)"
        raise InputError(f"[study] rate_hz: {text}")
    sensors, drawn = dict(data.get("sensors", {})), dict(data.get("drawn", {}))
    motion = dict(data.get("motion", {}))
    tables = {"study": study, "earth": data["earth"], "motion": motion, "sensors": sensors}
    checked = tables | _with_heading(motion, drawn) | {"alignment": {"method": "inertial"}}
    checked["study"] = study | {"unchecked": True}  # `_check_noise` knows sheets better
    study_from_dict(without_empty(checked), name)
    for key, law in drawn.items():
        if key not in (*CONSTANT_KEYS, "yaw_center_deg"):
            raise InputError(f"[drawn] {key}: must have a fixed value in a sheet")
        if key in CONSTANT_KEYS and (law.get("normal") or [1.0])[0] != 0:
            raise InputError(f"[drawn] {key}: must be normal = [0.0, SIGMA] in a sheet")
    for key in CONSTANT_KEYS:
        if np.any(fixed := sensors.pop(key, 0.0)) and key not in drawn:
            drawn[key] = {"normal": [0.0, rms(fixed)]}
    sheet = Sheet(name, tables | _with_heading(motion, drawn), asked, ())
    _check_noise(sheet)
    return Sheet(name, sheet.tables, asked, tuple(_iter_doubts(sheet)))


def _with_heading(motion: TomlTable, drawn: TomlTable) -> TomlTable:
    """Return [drawn] with headings all round unless the sheet has one."""
    if "yaw_center_deg" in motion or "yaw_center_deg" in drawn or "attitude_file" in motion:
        return {"drawn": drawn}
    return {"drawn": drawn | {"yaw_center_deg": {"uniform": [-180.0, 180.0]}}}


def _read_asked(table: Any) -> AdviseSection:
    try:
        return AdviseSection.model_validate(table)
    except ValidationError as error:
        lines = []
        for one in correctable_errors(error):
            key = str(one["loc"][0]) if one["loc"] else ""
            hint = suggest_closest(key, AdviseSection.model_fields)
            known = key in AdviseSection.model_fields
            text = describe_broken_rule(one) if known else f"unknown key{hint}"
            lines.append(f"[advise] {key}: {text}")
        raise InputError(*lines) from None


def _check_noise(sheet: Sheet) -> None:
    """Refuse a sheet without white noise, and values far from those of any IMU."""
    lines = []
    for key, (other, words) in _NOISE.items():
        if not sheet.sigma(key) and not sheet.sigma(other):
            low, high, unit = _USUAL[key]
            lines.append(f"[sensors] {key}: required, {words}, usually {low:g} to {high:g} {unit}")
    is_unchecked = sheet.tables["study"].get("unchecked", False)
    for key, (low, high, unit) in _USUAL.items():
        value = sheet.sigma(key)
        if value and not low <= value <= high and not is_unchecked:
            table = "drawn" if key in sheet.tables["drawn"] else "sensors"
            text = f"{value:g} is not in the usual {low:g} to {high:g} {unit}"
            lines.append(f"[{table}] {key}: {text} (if it is right: [study] unchecked = true)")
    if lines:
        raise InputError(*lines)


def _iter_doubts(sheet: Sheet) -> Iterator[str]:
    """Yield values that do not fit each other."""
    bias = sheet.sigma("gyro_bias_deg_per_h")
    drift = sheet.sigma("gyro_instability_deg_per_h")
    walk = sheet.sigma("gyro_arw_deg_per_sqrt_h")
    if not bias:
        yield (
            "no turn-on bias of the gyros (gyro_bias_deg_per_h in [drawn]): the heading is that of"
            " perfectly calibrated ones"
        )
    elif bias < 0.5 * drift:
        yield (
            f"the turn-on bias of the gyros, {bias:g} deg/h, is below their instability, {drift:g}"
            f" deg/h; it is usually 1 to 100 times as large ({bias:g} deg/s are {3600 * bias:g}"
            " deg/h)"
        )
    if not sheet.sigma("accel_bias_ug"):
        yield "no turn-on bias of the accelerometers (accel_bias_ug in [drawn])"
    if walk > 3 * (scale := drift or bias) > 0:
        yield (
            f"the angle random walk, {walk:g} deg/sqrt(h), is {walk / scale:.3g} times the"
            f" {'instability' if drift else 'bias'} of the gyros in deg/h, usually 0.02 to 1 times"
            " (deg/h/sqrt(Hz) are divided by 60)"
        )


def rms(value: Any) -> float:
    """Return the root mean square of a number, or of one per axis."""
    return float(np.sqrt(np.mean(np.square(np.asarray(value, float)))))

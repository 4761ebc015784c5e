"""The sheet of an IMU: a study without an alignment, read, checked and completed."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from sinsjax.errors import InputError
from sinsjax.messages import explain_error, suggest_closest
from sinsjax.platform.files import asset_path
from sinsjax.study import files
from sinsjax.study.changes import apply_changes
from sinsjax.study.keys import SECTION_OF, TomlTable, unknown_key_error
from sinsjax.study.load import SHEET_TABLES, study_from_dict
from sinsjax.study.schema import AdviseSection, MotionSection
from sinsjax.study.sweep import correctable_errors
from sinsjax.units import DEG_PER_H, DEG_PER_SQRT_H, micro_g

TIMES_S = (60.0, 120.0, 300.0, 600.0, 1800.0)
"""Times at which the heading is always given, s."""

AXES = ("pitch", "roll", "yaw")
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
"""Keys of errors that stay constant; a fixed value counts as 1 sigma."""

_BIAS = ("bias", "turn_on", "repeatability", "offset")
_WHITE = ("arw", "vrw", "random_walk", "noise", "sqrt_")
_RATE = {"rad_per_s": 1 / DEG_PER_H, "deg_per_s": 3600.0}
_RATE_NOISE = {
    **dict.fromkeys(("rad_per_s_per_sqrt_hz", "rad_per_sqrt_s"), 1 / DEG_PER_SQRT_H),
    **dict.fromkeys(("deg_per_s_per_sqrt_hz", "deg_per_sqrt_s"), 60.0),
    "deg_per_h_per_sqrt_hz": 1 / 60,
}
_ACCELERATION = {"m_per_s2": 1 / micro_g(), "mg": 1e3}
_ACCELERATION_NOISE = {
    **{"m_per_s2_per_sqrt_hz": 1 / micro_g(), "mg_per_sqrt_hz": 1e3},
    "m_per_s_per_sqrt_h": 1 / (60 * micro_g()),
}
_QUANTITIES: dict[str, tuple[tuple[str, ...], dict[str, float]]] = {
    "gyro_instability_deg_per_h": (("instability",), _RATE),
    "gyro_rrw_deg_per_h_per_sqrt_h": (("rrw", "rate_random_walk"), {}),
    "gyro_arw_deg_per_sqrt_h": (_WHITE, _RATE_NOISE),
    "gyro_bias_deg_per_h": (_BIAS, _RATE),
    "accel_instability_ug": (("instability",), _ACCELERATION),
    "accel_rrw_ug_per_sqrt_h": (("rrw", "acceleration_random_walk"), {}),
    "accel_vrw_ug_per_sqrt_hz": (_WHITE, _ACCELERATION_NOISE),
    "accel_bias_ug": (_BIAS, _ACCELERATION),
}
"""What data sheets call a quantity, and factors to the unit of its key; the first fit decides."""


@dataclass(frozen=True)
class Sheet:
    """An IMU, its place and motion, and what is asked.

    Attributes:
        tables: of a study, without a method; constant errors are drawn.
        asked: what is asked.
        replaced: name of the motion that replaces the sheet's own, if any.
    """

    tables: TomlTable
    asked: AdviseSection
    replaced: str = ""

    @property
    def name(self) -> str:
        """Name of the sheet and of its study."""
        return str(self.tables["study"]["name"])

    @property
    def latitude_deg(self) -> float:
        """Latitude, deg."""
        return float(self.tables["earth"]["latitude_deg"])

    @property
    def motion(self) -> dict[str, Any]:
        """The keys of [motion]."""
        return dict(self.tables["motion"])

    @property
    def times_s(self) -> tuple[float, ...]:
        """Times to report, s, the time asked for among them, which ends a base that turns."""
        asked = self.asked.time_s
        usual = (time for time in TIMES_S if time < asked or not self.is_turned)
        return tuple(sorted({asked, *usual}))

    @property
    def is_turned(self) -> bool:
        """Whether the sheet turns the base, or has its attitude in a file."""
        return bool(self.motion.keys() & {"turn_times_s", "attitude_file"})

    @property
    def doubts(self) -> tuple[str, ...]:
        """Values of the sheet that do not fit each other, a line each."""
        keys = "gyro_bias_deg_per_h", "gyro_instability_deg_per_h", "gyro_arw_deg_per_sqrt_h"
        bias, drift, walk = map(self.sigma, keys)
        scale, name = (drift, "instability") if drift else (bias, "bias")
        lines = [f"{self.replaced} motion replaces [motion] of the sheet"] * bool(self.replaced)
        if missing := [key for key in CONSTANT_KEYS[:2] if not self.sigma(key)]:
            lines.append(
                f"no turn-on bias ({' and '.join(missing)} in [drawn]): the heading is that of"
                " perfectly calibrated sensors"
            )
        if 0 < bias < 0.5 * drift:
            lines.append(
                f"the turn-on bias of the gyros, {bias:g} deg/h, is below their instability,"
                f" {drift:g} deg/h; it is usually 1 to 100 times as large ({bias:g} deg/s are"
                f" {3600 * bias:g} deg/h)"
            )
        if walk > 3 * scale > 0:
            lines.append(
                f"the angle random walk, {walk:g} deg/sqrt(h), is {walk / scale:.3g} times the"
                f" {name} of the gyros in deg/h, usually 0.02 to 1 times (deg/h/sqrt(Hz) are"
                " divided by 60)"
            )
        return tuple(lines)

    def study_tables(self, sections: Mapping[str, Any], **settings: Any) -> TomlTable:
        """Return the tables of a study with more sections, by name, and other keys of [study]."""
        tables = self.tables | dict(sections) | {"study": self.tables["study"] | settings}
        return {name: table for name, table in tables.items() if table}

    def sigma(self, key: str) -> float:
        """Return the size of a sensor error: 1 sigma if it is constant, else its density or rms."""
        if key in (drawn := self.tables["drawn"]):
            return float(drawn[key]["normal"][1])
        return rms(self.tables["sensors"].get(key, 0.0))


def shipped_sheets() -> dict[str, Path]:
    """Return the sheets that come with the package, by name."""
    return {path.stem: path for path in sorted(asset_path("configs/imu").glob("*.toml"))}


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
    if (source is None) == (imu is None):
        raise InputError("give a sheet or --imu NAME, one of the two (`sinsjax advise --imu list`)")
    sheets = shipped_sheets()
    for option, value, known in (("imu", imu, sheets), ("motion", motion, MOTIONS)):
        if value is not None and value not in known:
            hint = suggest_closest(value, known)
            raise InputError(f"--{option} {value}: is none of {', '.join(known)}{hint}")
    if isinstance(source, Mapping):
        name, data = "sheet", dict(source)
    else:
        path = sheets[str(imu)] if source is None else Path(source)
        name, data = imu or files.source_name(path), files.read_tables(path)
    options = {"earth.latitude_deg": latitude_deg, "advise.time_s": time_s}
    given = {key: value for key, value in options.items() if value is not None}
    try:
        replaced = motion if motion and data.get("motion") else ""
        data |= {"motion": MOTIONS[motion]} if motion else {}
        data = apply_changes(apply_changes(data, given), changes or {})
        _check_sections_and_units(data)
        return replace(_validate_and_fill(name, data), replaced=replaced)
    except InputError as error:
        if error.lines[0].startswith(f"{name}: "):
            raise
        raise error.with_source(name) from None


def _check_sections_and_units(data: TomlTable) -> None:
    """Refuse other sections than those of a sheet, and keys in the units of other makers."""
    for name, table in data.items():
        if name not in SHEET_TABLES:
            text = "does not belong in a sheet (`sinsjax advise` chooses the method and its keys)"
            raise InputError(f"[{name}]: {text}{suggest_closest(name, SHEET_TABLES, '[{}]')}")
        if not isinstance(table, Mapping):
            raise InputError(f"[{name}]: must be a table of keys")
    unknown = [
        f"[{name}] {key}: {_convert_key(key) or unknown_key_error(key, SECTION_OF)}"
        for name in ("sensors", "drawn")
        for key in data.get(name, {})
        if key not in SECTION_OF
    ]
    if unknown:
        raise InputError(*unknown)


def _convert_key(key: str) -> str:
    """Return the key and the factor to use for a quantity in another maker's words and unit."""
    sensor = key.partition("_")[0]
    for known, (names, factors) in _QUANTITIES.items():
        if known.startswith(sensor) and any(name in key for name in names):
            fits = (factor for unit, factor in factors.items() if key.endswith(unit))
            factor = next((f", multiply by {factor:.6g}" for factor in fits), "")
            return f"unknown key (did you mean {known}?{factor})"
    return ""


def _validate_and_fill(name: str, data: TomlTable) -> Sheet:
    """Check the tables and fill in what a study needs."""
    given, fields = data.get("study", {}), AdviseSection.model_fields
    try:
        wishes = {"time_s": given.get("duration_s", 300.0)} | data.get("advise", {})
        asked = AdviseSection.model_validate(wishes)
    except ValidationError as error:
        lines = {str(one["loc"][0]): explain_error(one) for one in correctable_errors(error)}
        lines |= {key: unknown_key_error(key, fields) for key in lines if key not in fields}
        raise InputError(*(f"[advise] {key}: {text}" for key, text in lines.items())) from None
    if not data.get("earth"):
        raise InputError("[earth] latitude_deg: required, deg (--latitude)")
    study = {"name": name.rpartition("/")[2].removesuffix(".toml"), "draws": 1024, "rate_hz": 100.0}
    study |= given | {"duration_s": asked.time_s, "record_interval_s": 1.0}
    if times_s := [time for time in TIMES_S if time < asked.time_s]:
        study["report_times_s"] = times_s
    if isinstance(study["rate_hz"], float) and study["rate_hz"] % 1:
        text = f"must be whole in a sheet, not {study['rate_hz']:g} (no number depends on it)"
        raise InputError(f"[study] rate_hz: {text}")
    motion, sensors, drawn = (dict(data.get(key, {})) for key in ("motion", "sensors", "drawn"))
    if not {*motion, *drawn} & {"yaw_center_deg", "attitude_file"}:
        drawn["yaw_center_deg"] = {"uniform": [-180.0, 180.0]}
    tables = {"study": study, "earth": data["earth"], "motion": motion, "sensors": sensors}
    sheet = Sheet(tables | {"drawn": drawn}, asked)
    study_from_dict(sheet.study_tables({"alignment": {"method": "inertial"}}), name)
    for key, law in drawn.items():
        if key not in (*CONSTANT_KEYS, "yaw_center_deg"):
            raise InputError(f"[drawn] {key}: must have a fixed value in a sheet")
        if key in CONSTANT_KEYS and (law.get("normal") or [1.0])[0] != 0:
            raise InputError(f"[drawn] {key}: must be normal = [0.0, SIGMA] in a sheet")
    if np.any(motion.get("surge_m_per_s")):
        motion.setdefault("surge_time_s", MotionSection.model_fields["surge_time_s"].default)
    for key in CONSTANT_KEYS:
        if np.any(fixed := sensors.pop(key, 0.0)) and key not in drawn:
            drawn[key] = {"normal": [0.0, rms(fixed)]}
    for key in ("gyro_arw_deg_per_sqrt_h", "accel_vrw_ug_per_sqrt_hz"):
        if not sheet.sigma(key):
            raise InputError(f"[sensors] {key}: required, the random walk of the data sheet")
    if np.any(motion.get("vibration_deg_per_h_rms")) and np.any(motion.get("lever_arm_m")):
        text = "swings the lever arm, which no method here knows (lever_arm_m = 0 leaves it out)"
        raise InputError(f"[motion] vibration_deg_per_h_rms: {text}")
    return sheet


def rms(value: Any) -> float:
    """Return the root mean square of a number, or of one per axis."""
    return float(np.sqrt(np.mean(np.square(np.asarray(value, float)))))

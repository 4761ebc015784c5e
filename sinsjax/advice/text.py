"""Advice in one screen of text."""

import math
from collections.abc import Iterator
from typing import Any

from sinsjax.advice import method as methods
from sinsjax.advice.advise import Advice, format_angle
from sinsjax.advice.heading import SOURCES, TURN_ON, wrapped_rms
from sinsjax.bounds.turn_planner import TurnOption
from sinsjax.methods.filters.keys import level_surge
from sinsjax.units import ARCMIN, DEG

_LEAST_SHARE = 0.005
_PAYS = 0.8
_AXES = ("pitch", "roll", "yaw")


def describe_advice(advice: Advice) -> Iterator[str]:
    """Yield the lines of an advice."""
    place = f"{advice.latitude_deg:g} deg of latitude"
    yield f"{advice.name}, {_name_motion(advice)} base, {advice.time_s:g} s at {place}"
    yield ""
    if assumed := ", ".join(_iter_motion(advice.sheet.tables["motion"])):
        yield _fact("motion", assumed)
    for doubt in advice.sheet.doubts:
        yield _fact("doubt", doubt)
    yield from _describe_heading(advice)
    yield _fact("budget", ", ".join(_iter_shares(advice)))
    here = advice.heading
    yield _fact(
        "dominant",
        f"{SOURCES[advice.dominant]}: halving it gives {format_angle(advice.halved_rms_arcmin)}"
        f" instead of {format_angle(here.rms_arcmin)}",
    )
    yield _fact(
        "method",
        f"{advice.choice.method}: {advice.choice.reason}; its error is {advice.loss:.2f} times the"
        f" information bound{' of linear theory' * advice.is_coarse},"
        f" {format_angle(advice.bound_arcmin)}",
    )
    yield ""
    yield from (f"    {line}".rstrip() for line in advice.choice.toml.splitlines())
    yield ""
    yield _fact("filter", _describe_filter(advice))
    yield _fact("turning", _describe_turns(advice))
    for warning in advice.warnings:
        yield _fact("warning", warning)


def _fact(name: str, text: str) -> str:
    return f"  {name:<9} {text}"


def _describe_heading(advice: Advice) -> Iterator[str]:
    here, cosine = advice.heading, math.cos(advice.latitude_deg * DEG)
    reported = [one for one in advice.headings if one.time_s in advice.sheet.times_s]
    yield _fact(
        "heading",
        f"{format_angle(here.rms_arcmin)} rms from true north"
        f"{'' if advice.is_coarse else f' ({format_angle(here.rms_arcmin * cosine)} sec L)'},"
        f" 95 % within {format_angle(here.within_95_arcmin)}",
    )
    columns: list[tuple[str, list[str]]] = [
        ("after", [f"{one.time_s:g} s" for one in reported]),
        ("rms", [format_angle(one.rms_arcmin) for one in reported]),
        ("95 %", [format_angle(one.within_95_arcmin) for one in reported]),
    ]
    if not advice.is_coarse:
        columns.append(("/ sec L", [format_angle(one.rms_arcmin * cosine) for one in reported]))
    for name, cells in columns:
        yield _fact(name, " ".join(f"{cell:>9}" for cell in cells))
    band, settled = advice.settles
    when = f"from {settled:.0f} s" if settled is not None else f"not in {advice.time_s:g} s"
    sec = format_angle(60 * band * cosine)
    yield _fact("settles", f"95 % within {band:g} deg ({sec} sec L) {when}, from any heading")


def _iter_shares(advice: Advice) -> Iterator[str]:
    for source, share in advice.shares.items():
        if share >= _LEAST_SHARE:
            yield f"{SOURCES[source]} {share:.0%}"


def _name_motion(advice: Advice) -> str:
    """Return the motion of the base in a word."""
    motion = advice.sheet.tables["motion"]
    words = {
        "turned": advice.sheet.is_turned,
        "surging": level_surge(motion.get("surge_m_per_s")) > 0,
        "rocking": any(motion.get(f"{axis}_amplitude_deg") for axis in _AXES),
        "vibrating": any(motion.get(f"vibration_{key}") for key in ("ug_rms", "deg_per_h_rms")),
    }
    return next((word for word, is_so in words.items() if is_so), "still")


def _iter_motion(motion: dict[str, Any]) -> Iterator[str]:
    """Yield the numbers of the motion that the advice assumes."""
    for axis in _AXES:
        if amplitude := motion.get(f"{axis}_amplitude_deg"):
            yield f"{axis} {amplitude} deg every {motion[f'{axis}_period_s']:g} s"
    if surge := motion.get("surge_m_per_s"):
        yield f"surge {surge} m/s rms over {methods.surge_time_s(motion):g} s"
    if lever_arm := motion.get("lever_arm_m"):
        yield f"lever arm {lever_arm} m"


def _describe_filter(advice: Advice) -> str:
    """Return how to set a filter that goes on with a covariance after the alignment."""
    sheet = advice.sheet
    if sheet.is_turned:
        return (
            "to go on with a covariance: after the last turn, from the attitude, gyro biases and"
            " sigmas of gravity_fit (kalman_sincos through the turns keeps the biases' error)"
        )
    share = sum(advice.shares.get(source, 0.0) for source in TURN_ON)
    biases = format_angle(math.sqrt(share) * advice.sigma / ARCMIN)
    gyro, accel = methods.gyro_density(sheet), methods.accel_density(sheet)
    return (
        f"to go on with a covariance: kalman_sincos, Q of {gyro:g} deg/sqrt(h) and {accel:g}"
        f" ug/sqrt(Hz), R of {methods.velocity_sigma(sheet):g} m/s an update; its P lacks the"
        f" turn-on biases: add {biases} to sigma in quadrature"
    )


def _describe_turns(advice: Advice) -> str:
    turns = advice.turns
    if turns is None:
        return "the sheet turns the base, and the numbers above are with it"
    parked = turns.options[0].sigma_arcmin
    if turns.best.sigma_arcmin > _PAYS * parked:
        return "hardly pays: the noise and not the biases decide, or there is no time for it"
    ways = [
        one
        for one in turns.options[1:]
        if one.name in ("half turn", turns.best.name) and one.sigma_arcmin <= parked
    ]
    errors = [format_angle(advice.heading.rms_arcmin)]
    errors += [format_angle(wrapped_rms(one.sigma_arcmin * ARCMIN) / ARCMIN) for one in ways]
    names = ("no turn", *map(_describe_option, ways))
    numbers = ", ".join(f"{name} {error}" for name, error in zip(names, errors, strict=True))
    return f"on a {_name_motion(advice)} base: {numbers}"


def _describe_option(option: TurnOption) -> str:
    if option.name == "half turn":
        return f"one 180 deg turn at {option.motion['turn_times_s'][0]:g} s"
    return option.name

"""Advice in one screen of text."""

import math
from collections.abc import Iterator

from sinsjax.advice.advise import Advice
from sinsjax.advice.heading import SOURCES, format_angle, wrapped_rms
from sinsjax.advice.method import surge_time_s
from sinsjax.advice.sheet import Sheet
from sinsjax.methods.filters.keys import level_surge
from sinsjax.units import ARCMIN, DEG

_LEAST_SHARE = 0.005
_PAYS = 0.8
_AXES = ("pitch", "roll", "yaw")


def describe_advice(advice: Advice) -> Iterator[str]:
    """Yield the lines of an advice."""
    here, cosine = advice.heading, math.cos(advice.latitude_deg * DEG)
    place = f"{advice.latitude_deg:g} deg of latitude"
    yield f"{advice.name}, {_name_motion(advice.sheet)} base, {advice.time_s:g} s at {place}"
    yield ""
    if assumed := ", ".join(_iter_motion(advice.sheet)):
        yield _fact("motion", assumed)
    for doubt in advice.sheet.doubts:
        yield _fact("doubt", doubt)
    yield _fact(
        "heading",
        f"{format_angle(here.rms_arcmin)} rms from true north"
        f" ({format_angle(here.rms_arcmin * cosine)} sec L),"
        f" 95 % within {format_angle(here.within_95_arcmin)}",
    )
    reported = [one for one in advice.headings if one.time_s in advice.sheet.times_s]
    yield _row("after", [f"{one.time_s:g} s" for one in reported])
    yield _row("rms", [format_angle(one.rms_arcmin) for one in reported])
    yield _row("95 %", [format_angle(one.within_95_arcmin) for one in reported])
    band, settled = advice.settles
    when = f"from {settled:.0f} s" if settled is not None else f"not in {advice.time_s:g} s"
    yield _fact("settles", f"95 % within {band:g} deg {when}, from any heading")
    shares = {SOURCES[name].words: share for name, share in advice.shares.items()}
    parts = (f"{words} {share:.0%}" for words, share in shares.items() if share >= _LEAST_SHARE)
    yield _fact("budget", ", ".join(parts))
    halved = f"halving it gives {format_angle(advice.halved_rms_arcmin)}"
    dominant = f"{SOURCES[advice.dominant].words}: {halved}"
    yield _fact("dominant", f"{dominant} instead of {format_angle(here.rms_arcmin)}")
    yield _fact(
        "method",
        f"{advice.choice.method}: {advice.choice.reason}; its error is {advice.loss:.2f} times the"
        f" information bound of linear theory, {format_angle(advice.bound_arcmin)}",
    )
    yield ""
    yield from (f"    {line}".rstrip() for line in advice.choice.toml.splitlines())
    yield ""
    yield _fact("turning", _describe_turns(advice))
    for warning in advice.warnings:
        yield _fact("warning", warning)


def _fact(name: str, text: str) -> str:
    return f"  {name:<9} {text}"


def _row(name: str, cells: list[str]) -> str:
    return _fact(name, " ".join(f"{cell:>9}" for cell in cells))


def _name_motion(sheet: Sheet) -> str:
    """Return the motion of the base in a word."""
    words = {
        "turned": sheet.is_turned,
        "surging": level_surge(sheet.motion.get("surge_m_per_s")) > 0,
        "rocking": any(sheet.motion.get(f"{axis}_amplitude_deg") for axis in _AXES),
        "vibrating": any(sheet.motion.get(f"vibration_{k}") for k in ("ug_rms", "deg_per_h_rms")),
    }
    return next((word for word, is_so in words.items() if is_so), "still")


def _iter_motion(sheet: Sheet) -> Iterator[str]:
    """Yield the numbers of the motion that the advice assumes."""
    for axis in _AXES:
        if amplitude := sheet.motion.get(f"{axis}_amplitude_deg"):
            yield f"{axis} {amplitude} deg every {sheet.motion[f'{axis}_period_s']:g} s"
    if surge := sheet.motion.get("surge_m_per_s"):
        yield f"surge {surge} m/s rms over {surge_time_s(sheet):g} s"
    if lever_arm := sheet.motion.get("lever_arm_m"):
        yield f"lever arm {lever_arm} m"


def _describe_turns(advice: Advice) -> str:
    turns = advice.turns
    if turns is None:
        return "the sheet turns the base, and the numbers above are with it"
    parked, best = turns.options[0].sigma_arcmin, turns.best
    if best.sigma_arcmin > _PAYS * parked:
        return "hardly pays: the noise and not the biases decide, or there is no time for it"
    errors = {"no turn": format_angle(advice.heading.rms_arcmin)}
    for one in turns.options[1:]:
        name = one.name
        if name == "half turn":
            name = f"one 180 deg turn at {one.motion['turn_times_s'][0]:g} s"
        if one.sigma_arcmin <= parked and one.name in ("half turn", best.name):
            errors[name] = format_angle(wrapped_rms(one.sigma_arcmin * ARCMIN) / ARCMIN)
    numbers = ", ".join(f"{name} {error}" for name, error in errors.items())
    return f"on a {_name_motion(advice.sheet)} base: {numbers}"

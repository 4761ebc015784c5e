"""Advice in one screen of text."""

import math
from collections.abc import Iterable, Iterator

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
    """Yield the lines of an advice: title, facts by label, and settings as TOML."""
    sheet = advice.sheet
    place = f"{advice.time_s:g} s at {sheet.latitude_deg:g} deg of latitude"
    yield f"{sheet.name}, {_name_motion(sheet)} base, {place}"
    yield ""
    yield from (f"  {label:<9} {text}" for label, text in _iter_facts(advice) if text)
    yield ""
    yield from (f"    {line}".rstrip() for line in advice.choice.toml.splitlines())


def _iter_facts(advice: Advice) -> Iterator[tuple[str, str]]:
    """Yield labels and texts; an empty text is not shown."""
    sheet, here = advice.sheet, advice.heading
    rms, cosine = format_angle(here.rms_arcmin), math.cos(sheet.latitude_deg * DEG)
    yield "motion", ", ".join(_iter_motion(sheet))
    yield from (("doubt", doubt) for doubt in sheet.doubts)
    level, widest = map(format_angle, (here.rms_arcmin * cosine, here.within_95_arcmin))
    yield "heading", f"{rms} rms from true north ({level} sec L), 95 % within {widest}"
    reported = [one for one in advice.headings if one.time_s in sheet.times_s]
    yield "after", _align(f"{one.time_s:g} s" for one in reported)
    yield "rms", _align(format_angle(one.rms_arcmin) for one in reported)
    yield "95 %", _align(format_angle(one.within_95_arcmin) for one in reported)
    band, settled = advice.settles
    when = f"from {settled:.0f} s" if settled is not None else f"not in {advice.time_s:g} s"
    yield "settles", f"95 % within {band:g} deg {when}, from any heading"
    shares = {SOURCES[name].words: share for name, share in advice.shares.items()}
    parts = (f"{words} {share:.0%}" for words, share in shares.items() if share >= _LEAST_SHARE)
    yield "budget", ", ".join(parts)
    halved = format_angle(advice.halved_rms_arcmin)
    yield "dominant", f"{next(iter(shares))}: halving it gives {halved} instead of {rms}"
    bound = f"the information bound of linear theory, {format_angle(advice.bound_arcmin)}"
    loss = f"its error is {advice.loss:.2f} times {bound}"
    yield "method", f"{advice.choice.method}: {advice.choice.reason}; {loss}"
    yield "turning", _describe_turns(advice)
    yield from (("warning", warning) for warning in advice.warnings)


def _align(cells: Iterable[str]) -> str:
    return " ".join(f"{cell:>9}" for cell in cells)


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
    if advice.turns is None:
        return "the sheet turns the base, and the numbers above are with it"
    (parked, *turned), best = advice.turns.options, advice.turns.best
    if best.sigma_arcmin > _PAYS * parked.sigma_arcmin:
        return "hardly pays: the noise and not the biases decide, or there is no time for it"
    parts = [f"no turn {format_angle(advice.heading.rms_arcmin)}"]
    for one in turned:
        if one.sigma_arcmin <= parked.sigma_arcmin and one.name in ("half turn", best.name):
            times_s = one.motion["turn_times_s"]
            half = f"one 180 deg turn at {times_s[0]:g} s"
            name = half if one.name == "half turn" else one.name
            parts.append(f"{name} {format_angle(wrapped_rms(one.sigma_arcmin * ARCMIN) / ARCMIN)}")
    return f"on a {_name_motion(advice.sheet)} base: {', '.join(parts)}"

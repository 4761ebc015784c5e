"""Advice in one screen of text."""

import math
from collections.abc import Iterator
from typing import Any

from sinsjax.advice import method as methods
from sinsjax.advice.advise import Advice
from sinsjax.advice.heading import SOURCES
from sinsjax.covariance.turn_planner import TurnOption
from sinsjax.study.reset_plan import ResetPlan
from sinsjax.units import DEG

_LEAST_SHARE = 0.005
_PAYS = 0.8


def describe_advice(advice: Advice) -> Iterator[str]:
    """Yield the lines of an advice."""
    motion = advice.sheet.tables["motion"]
    moves = "surging" if methods.level_surge(motion) else "swaying" if motion else "at rest"
    if any(key.startswith("turn") for key in motion):
        moves = "turned"
    place = f"{advice.latitude_deg:g} deg of latitude"
    yield f"{advice.name}, {moves}, {advice.time_s:g} s at {place}"
    yield ""
    for doubt in advice.sheet.doubts:
        yield _fact("doubt", doubt)
    yield from _describe_heading(advice)
    yield _fact("budget", ", ".join(_iter_shares(advice)))
    here = advice.heading
    yield _fact(
        "dominant",
        f"{SOURCES[advice.dominant]}: half of it gives {angle(advice.halved_rms_arcmin)} instead of"
        f" {angle(here.rms_arcmin)}",
    )
    yield _fact(
        "method",
        f"{advice.choice.method}: {advice.choice.reason}; {advice.loss:.2f} times the information"
        f" bound, {angle(here.bound_arcmin)}",
    )
    yield ""
    yield from (f"    {line}".rstrip() for line in advice.choice.toml.splitlines())
    yield ""
    yield _fact("resets", describe_resets(advice.resets, advice.choice.method))
    yield _fact("turning", _describe_turns(advice))
    yield _fact("again", _describe_passes(advice))
    for warning in advice.warnings:
        yield _fact("warning", warning)


def angle(arcmin: float) -> str:
    """Return an angle, arcmin, in degrees where it is large."""
    if arcmin < 100:
        return f"{arcmin:.1f}'" if arcmin < 20 else f"{arcmin:.0f}'"
    return f"{arcmin / 60:.1f} deg" if arcmin < 600 else f"{arcmin / 60:.0f} deg"


def _fact(name: str, text: str) -> str:
    return f"  {name:<9} {text}"


def _describe_heading(advice: Advice) -> Iterator[str]:
    here, cosine = advice.heading, math.cos(advice.latitude_deg * DEG)
    reported = [one for one in advice.headings if one.time_s in advice.sheet.times_s]
    yield _fact(
        "heading",
        f"{angle(here.rms_arcmin)} rms from true north, 95 % within {angle(here.within_95_arcmin)}"
        f" ({angle(here.rms_arcmin * cosine)} sec L rms)",
    )
    columns: list[tuple[str, list[str]]] = [
        ("after", [f"{one.time_s:g} s" for one in reported]),
        ("rms", [angle(one.rms_arcmin) for one in reported]),
        ("95 %", [angle(one.within_95_arcmin) for one in reported]),
        ("x sec L", [angle(one.rms_arcmin * cosine) for one in reported]),
    ]
    for name, cells in columns:
        yield _fact(name, " ".join(f"{cell:>9}" for cell in cells))
    band, settled = advice.settles
    when = f"from {settled:.0f} s" if settled is not None else f"not in {advice.time_s:g} s"
    sec = angle(60 * band * cosine)
    yield _fact("settles", f"95 % within {band:g} deg ({sec} sec L) {when}, from any heading")


def _iter_shares(advice: Advice) -> Iterator[str]:
    for source, share in advice.shares.items():
        if share >= _LEAST_SHARE:
            yield f"{SOURCES[source]} {share:.0%}"


def describe_resets(plan: ResetPlan | None, method: str) -> str:
    """Return whether resets are of use, and when."""
    none = f"{method} needs none"
    if plan is None:
        return f"{none}; the law has no schedule for a five-state filter with this noise"
    times = ", ".join(f"{time:g}" for time in plan.times_s)
    without = "never" if math.isinf(plan.without_s) else f"in {plan.without_s:.0f} s"
    return (
        f"{none}; kalman5 with this noise, reset at {times} s, settles within"
        f" {plan.band_arcmin:g}' of its floor from {plan.heading_bound_deg:g} deg in"
        f" {plan.settling_s:.0f} s, without resets {without}"
    )


def _describe_turns(advice: Advice) -> str:
    turns = advice.turns
    if turns is None:
        return "the sheet turns the base, and the numbers above are with it"
    if not turns.pays or turns.best.sigma_arcmin > _PAYS * turns.options[0].sigma_arcmin:
        return "hardly pays: the noise and not the biases decide, or there is no time for it"
    ways = [one for one in turns.options if one.name in ("half turn", turns.best.name)]
    gains = ", ".join(f"{_way(one)} {angle(one.sigma_arcmin)}" for one in ways)
    return f"gives, on a quiet base, {gains}; parked {angle(turns.options[0].sigma_arcmin)}"


def _way(option: TurnOption) -> str:
    motion: dict[str, Any] = option.motion
    if option.name != "half turn":
        return f"with a {option.name}" if "carousel" in option.name else f"with {option.name}"
    (time,), (turned,) = motion["turn_times_s"], motion["turn_angles_deg"]
    return f"with one turn of {turned:g} deg at {time:g} s"


def _describe_passes(advice: Advice) -> str:
    if advice.choice.method == methods.FIT:
        return "a stored record need not be passed through again: the fit uses all of it at once"
    return "a second pass over a stored record repairs a large initial error, and adds nothing else"

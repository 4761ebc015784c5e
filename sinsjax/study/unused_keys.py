"""Keys of a study that have no effect on any of its runs, named in one line before it runs."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sinsjax.methods.method import INITIAL_KEYS
from sinsjax.study.keys import (
    SECTION_OF,
    SECTIONS,
    SWEEPABLE,
    deciding_keys,
    effect_conditions,
    has_effect,
    reading_methods,
)
from sinsjax.study.study import COARSE_START, Study
from sinsjax.value_types import KeyCondition

_MAX_LISTED_VALUES = 3  # of a key in one line


def list_idle_keys(study: Study) -> list[str]:
    """List the keys that have no effect on any run of a study, in one line if there are any.

    They are keys that its methods do not read, and keys that the values of others make irrelevant.
    Keys at their defaults are left out.
    """
    idle: dict[str, dict[str, list[str]]] = {}  # keys by table, by the reason
    for key, table in _keys_with_tables(study):
        tuned = table.startswith("[tune")
        if SECTION_OF.get(key) in SWEEPABLE and (reason := _idle_reason(study, key, tuned)):
            idle.setdefault(reason, {}).setdefault(table, []).append(key)
    parts = []
    for reason, tables in idle.items():
        verb = "has" if sum(map(len, tables.values())) == 1 else "have"
        listed = ", ".join(f"{table} {', '.join(keys)}" for table, keys in tables.items())
        parts.append(f"{listed} {verb} no effect {reason}")
    return [f"{'; '.join(parts)}."] if parts else []


def _keys_with_tables(study: Study) -> Iterator[tuple[str, str]]:
    """Yield the keys that a study varies or changes from their defaults, and their tables."""
    tables = study.to_dict()
    for name in SWEEPABLE:
        for key in tables.get(name, ()):
            if getattr(getattr(study, name), key) != SECTIONS[name].model_fields[key].default:
                yield key, f"[{name}]"
    for key in (*study.axis_keys, *study.drawn_keys):
        if key != "case":
            yield key, str(study.given_in(key))
    for name in ("variables", "baseline") if study.tune else ():
        yield from ((key, f"[tune.{name}]") for key in getattr(study.tune, name))


def _idle_reason(study: Study, key: str, tuned: bool) -> str | None:
    """Return the reason why a key has no effect on any run, as text; None if it has an effect."""
    varied = {*study.tune.variables, *study.tune.baseline} if study.tune else set()
    if "method" not in varied and {*study.methods}.isdisjoint(reading_methods(key)):
        return f"with method {' or '.join(sorted(study.methods))}"
    if tuned or not varied.isdisjoint(deciding_keys(key)):
        return None
    coarse = COARSE_START if key in INITIAL_KEYS and study.coarse else ()
    points = list(study.combinations(*dict.fromkeys((*deciding_keys(key), *coarse))))
    if coarse:
        points = [p for p in points if not study.has_coarse_stage(*(p[k] for k in coarse))]
        if not points:
            return "with coarse alignment"
    if any(has_effect(key, point) for point in points):
        return None
    idle = (c for c in effect_conditions(key) if not c.acts_at(points))
    return next((describe_idle(condition, points) for condition in idle), "in any variant")


def describe_idle(condition: KeyCondition, points: Sequence[Mapping[str, Any]]) -> str:
    """Return the values of keys at some points, with which others have no effect, as text."""
    parts = []
    for key in condition.given:
        values = sorted({point[key] for point in points}, key=str)
        shown = [f"{v:g}" if isinstance(v, float) else str(v) for v in values]
        text = f"no {key}" if values == [None] else f"{key} = {' or '.join(shown)}"
        parts.append(text if len(values) <= _MAX_LISTED_VALUES else f"these values of {key}")
    return f"with {', '.join(parts)}"

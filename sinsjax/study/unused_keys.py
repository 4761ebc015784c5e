"""Keys of a study that have no effect on any of its runs, named in one line before it runs."""

from collections.abc import Iterator

from sinsjax.study.keys import SECTION_OF, SECTIONS, SWEEPABLE, deciding_keys, reading_methods
from sinsjax.study.study import Study


def list_idle_keys(study: Study) -> list[str]:
    """List the keys that have no effect on any run of a study, in one line if there are any.

    Keys at their defaults are left out, and those that a tuning may give an effect.
    """
    tuned = {*study.tune.variables, *study.tune.baseline} if study.tune else set()
    idle: dict[str, dict[str, list[str]]] = {}  # keys by table, by the reason
    for key, table in _keys_with_tables(study):
        deciding = deciding_keys(key)
        if SECTION_OF[key] not in SWEEPABLE or not tuned.isdisjoint(deciding):
            continue
        if {*study.methods}.isdisjoint(reading_methods(key)):
            reason = f"method {' or '.join(sorted(study.methods))}"
        elif study.is_readable(key) and study.without_effect(key).all():
            others = [other for other in deciding if other != "method"] or ["coarse_method"]
            reason = f"the values of {', '.join(others)}"
        else:
            continue
        idle.setdefault(reason, {}).setdefault(table, []).append(key)
    parts = []
    for reason, tables in idle.items():
        verb = "has" if sum(map(len, tables.values())) == 1 else "have"
        listed = ", ".join(f"{table} {', '.join(keys)}" for table, keys in tables.items())
        parts.append(f"{listed} {verb} no effect with {reason}")
    return [f"{'; '.join(parts)}."] if parts else []


def _keys_with_tables(study: Study) -> Iterator[tuple[str, str]]:
    """Yield the keys that a study varies or changes from their defaults, and their tables."""
    for name in filter(study.has, SWEEPABLE):
        section, fields = getattr(study, name), SECTIONS[name].model_fields
        for key in (key for key in fields if key in section.model_fields_set):
            if getattr(section, key) != fields[key].default:
                yield key, f"[{name}]"
    for key in (*study.axis_keys, *study.drawn_keys):
        if key != "case":
            yield key, str(study.given_in(key))
    for name in ("variables", "baseline") if study.tune else ():
        yield from ((key, f"[tune.{name}]") for key in getattr(study.tune, name))

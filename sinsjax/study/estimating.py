"""What covariance analysis holds for, and what a study that is estimated by it has no use for."""

from collections.abc import Iterator, Mapping

from sinsjax.alignment.methods import METHODS
from sinsjax.alignment.triggers.section import any_trigger
from sinsjax.errors import InputError
from sinsjax.study.distributions import BIASES, INITIAL_KEYS, is_normal
from sinsjax.study.in_turn import keys_in_turn
from sinsjax.study.keys import SECTION_OF
from sinsjax.study.study import Study


def require_modelled(study: Study) -> None:
    """Refuses what covariance analysis does not hold for.

    Raises:
        InputError: names the key, and why.
    """
    told = next(_unmodelled(study, {}), None)
    if told is not None:
        raise InputError(f"{study.name}: {told}")


def is_modelled(study: Study) -> bool:
    """Whether covariance analysis holds for a study."""
    return next(_unmodelled(study, {}), None) is None


def check(study: Study, where: Mapping[str, str]) -> None:
    """Refuses what does not go with covariance analysis, where a study or its tuning asks for it.

    Args:
        study: checked study.
        where: the table, in brackets, of every key that the file gives.

    Raises:
        InputError: ``[section] key: what is wrong (hint)``.
    """
    if study.tune and "covariance" in study.tune.searches:
        if told := next(_unmodelled(study, where), None):
            text = f"'covariance' cannot be one of them (use 'sobol'): {told}"
            raise InputError(f"[tune] searches: {text}")
    if not study.is_estimated:
        for key in ("check_linearity", "estimate_samples"):
            if getattr(study.study, key) is not None:
                raise InputError(f"[study] {key}: requires estimate = 'covariance'")
        return
    told = next(_unmodelled(study, where), None)
    if told is not None:
        raise InputError(f"{told} (use estimate = 'draws')")
    search = "a search by covariance analysis is one of its searches"
    unread = {
        "[tune]": (study.has("tune"), search),
        "[study] curves": (study.study.curves, "there are no runs to have any"),
        "[stop_when]": (study.has("stop_when"), "there are no draws to stop"),
    }
    for place, (given, why) in unread.items():
        if given:
            raise InputError(f"{place}: is not read beside estimate = 'covariance' ({why})")


def _unmodelled(study: Study, where: Mapping[str, str]) -> Iterator[str]:
    """What there is that covariance analysis does not hold for, a line each."""
    if study.is_recorded:
        yield "[record]: covariance analysis needs the noise of a simulation"
        return
    if study.passes:
        yield "[passes]: covariance analysis takes noise as white, passes take it in again"
    if study.coarse_stages:
        yield "[coarse]: covariance analysis begins with the method's own P0"
    for key, law in study.drawn.laws.items() if study.drawn else ():
        if key not in (*INITIAL_KEYS, *BIASES):
            yield f"[drawn] {key}: covariance analysis takes its value as given (sweep it instead)"
        elif not is_normal(key, law):
            yield f"[drawn] {key}: covariance analysis takes what is drawn as normal"
    if any_trigger(study):
        place = where.get("reset_trigger", "[resets]")
        yield f"{place} reset_trigger: covariance analysis needs resets at given times"
    for key in keys_in_turn(study):
        if key.startswith("vibration") or "quantisation" in key:
            place = where.get(key, f"[{SECTION_OF[key]}]")
            yield f"{place} {key}: covariance analysis knows no vibration and no digits"
    for name in study.methods:
        if not METHODS[name].has_error_step:
            place = where.get("method", "[alignment]")
            yield f"{place} method: covariance analysis knows no linear part of {name}"

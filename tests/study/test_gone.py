"""Keys and values of earlier versions are refused in a line that names what to use."""

import pytest
from support.plain_studies import refusal_line
from support.refusals import refused

from sinsjax import gone
from sinsjax.study.keys import KEYS, unknown_key_error
from sinsjax.study.sweep import value_error


@pytest.fixture(autouse=True)
def some_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(gone.KEYS, "filter.mass_kg", "use q_scale")
    monkeypatch.setitem(gone.VALUES, ("resets.reset_kind", "half"), "use 'scale'")


@refused("""
filter.mass_kg = 3                           -> [filter] mass_kg: removed 1.0 q_scale
cases = [{mass_kg = 3}]                      -> [cases] mass_kg: removed 1.0 q_scale
tune.variables.mass_kg = {low = 1, high = 3} -> [tune.variables] mass_kg: removed 1.0 q_scale
resets.reset_kind = "half"                   -> [resets] reset_kind: 'half' removed 1.0 'scale'
axes.reset_kind = ["full", "half"]           -> [axes] reset_kind[1]: 'half' removed 1.0 'scale'
tune = {variables.p0_yaw_deg = {low = 10, high = 90}, searches = ["grid", "random"]}
    -> [tune] searches[1]: 'random' removed 1.0 'sobol'
""")
def test_gone_key_or_value_is_refused_with_its_replacement(refusal):
    refusal.check(refusal_line(**refusal.tables))


def test_table_lists_only_what_is_gone():
    for place, text in gone.KEYS.items():
        section, _, key = place.partition(".")
        assert (section, key) not in KEYS
        assert unknown_key_error(key, ()) == f"was removed after 1.0 ({text})"
    for place, value in gone.VALUES:
        key = place.partition(".")[2]
        assert value_error(value, key) and value_error((value,), key)

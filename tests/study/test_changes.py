"""Changes of a study's keys, as `--set` and `sinsjax.load_study` make them."""

from support.studies import small_study


def test_changed_key_replaces_its_alternative() -> None:
    study = small_study(resets={"reset_count": 2, "reset_cycle_s": 2.0})
    changed = study.replace({"resets.reset_times_s": [1.5]})
    assert [*map(tuple, changed.reset_times())] == [(1.5,)]
    back = changed.replace({"resets.reset_count": 1, "resets.reset_first_s": 3.0})
    assert [*map(tuple, back.reset_times())] == [(3.0,)]

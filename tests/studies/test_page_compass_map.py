from pathlib import Path

from sinsjax.study.load import load_study

CONFIG = Path(__file__).parents[2] / "configs" / "paper2_map.toml"


def test_shipped_map_study_covers_required_axes_and_cases():
    study = load_study(CONFIG)
    assert {"velocity", "velocity_and_rate", "reflect"} <= set(study.axes["turn"])
    records = study.axes["stored_s"]
    assert (min(records), max(records)) == (20, 300) and 80 in records
    assert len(study.cases) >= 3 and study.n_draws >= 32
    assert study.study.settle_bands_arcmin == (6.0, 1.2)

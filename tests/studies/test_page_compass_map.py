from pathlib import Path

import numpy as np

from docs.studies.compass_map import map as error_map
from sinsjax.study.load import load_study

CONFIG = Path(__file__).parents[2] / "configs" / "paper2_map.toml"


def test_convergence_is_from_the_smallest_sigma_that_has_no_failure_above_it():
    within = np.array(
        [[True, False, True, True], [True] * 4, [True, True, True, False], [False] * 3 + [True]]
    )
    found = error_map.converges_from(within, (0.01, 0.02, 0.03, 0.04))
    np.testing.assert_array_equal(found, [0.03, 0.01, np.nan, 0.04])


def test_the_shipped_study_is_the_one_of_the_issue():
    study = load_study(CONFIG)
    assert {"velocity", "velocity_and_rate", "reflect"} <= set(study.axes["turn"])
    tapes = study.axes["tape_s"]
    assert (min(tapes), max(tapes)) == (20, 300) and 80 in tapes
    assert len(study.cases) >= 3 and study.n_draws >= 32
    assert study.study.settle_bands_arcmin == (6.0, 1.2)

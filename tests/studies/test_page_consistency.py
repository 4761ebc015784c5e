"""The engine under the page on consistency: the filter knows its error where its belief is true."""

import tomllib
from pathlib import Path

import pytest

from sinsjax import analysis
from sinsjax.execution import run as study_run
from sinsjax.execution.source import Source
from sinsjax.report import study_page
from sinsjax.study.load import study_from_dict

ROOT = Path(__file__).parents[2]
DRAWS = 128


@pytest.mark.nightly
@pytest.mark.optimised(False)
def test_filter_is_consistent_only_if_its_model_is_true():
    data = tomllib.loads((ROOT / "configs" / "consistency.toml").read_text(encoding="utf-8"))
    data["study"]["draws"] = DRAWS
    study = study_from_dict(data)
    page = study_page.load_script(ROOT / "docs" / "studies" / "consistency")
    checked = page.checks(Source(Path("x"), study, "x.toml", study_run.run(study).summary))
    assert len(checked) == 5
    for case, one in checked.items():
        is_true = case in (page.TRUE, page.SLOW)
        assert page.within(one.nees, analysis.chi2_mean_band(3, DRAWS)) == is_true, case
        unseen = is_true or case == page.BIASED  # a bias moves the limit, not the NIS from it
        assert page.within(one.nis_u, analysis.chi2_mean_band(1, DRAWS)) == unseen, case
        assert (one.inside.low <= 0.95 <= one.inside.high) == is_true, case

"""Every page of docs/studies from results that no engine made: names exist, all are used."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from support.made_up import curves_of, summary_of

from sinsjax.report import folder
from sinsjax.report.base import Source
from sinsjax.study.load import study_from_dict

ROOT = Path(__file__).parents[2]
PAGES = {
    "adaptive": ("adaptive_resets", "car_adaptive"),
    "consistency": ("consistency",),
    "kalman_passes": ("kalman_passes",),
    "paper1": ("paper1_conditions", "paper1_resets", "paper1_readings"),
    "reset_cycle": ("reset_cycle_study",),
}
"""The studies of each page."""

DRAWS = 4


def made_up(directory: Path, name: str) -> Source:
    """Numbers for every column of a shipped study, with few draws."""
    data = tomllib.loads((ROOT / "configs" / f"{name}.toml").read_text(encoding="utf-8"))
    if "record" not in data:
        data["study"]["draws"] = DRAWS
    study = study_from_dict(data)
    source = Source(directory, study, f"configs/{name}.toml", summary_of(study, every=True))
    if study.study.curves:
        stored = directory / name / "curves"
        stored.mkdir(parents=True)
        times = np.linspace(1.0, study.duration_s, 41).round()
        pq.write_table(curves_of(study, times=times), stored / "part-0000.parquet")
        return replace(source, directory=directory / name)
    return source


def test_every_page_is_looked_at():
    assert {path.name for path in (ROOT / "docs" / "studies").iterdir()} == set(PAGES)


@pytest.mark.parametrize("name", PAGES)
def test_a_page_names_all_that_its_script_computes(name, tmp_path):
    """Claims are looked at, but made-up numbers need not hold to them."""
    at = ROOT / "docs" / "studies" / name
    page = folder.compute(at, [made_up(tmp_path, study) for study in PAGES[name]])
    text = folder.render(at, page, enforced=False)
    assert text.startswith("# ")


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_short(name):
    """The committed page, outside its folded tables."""
    text = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
    parts = [part.partition("</details>")[2] for part in ("</details>" + text).split("<details>")]
    assert sum(len(part.split()) for part in parts) < 2500

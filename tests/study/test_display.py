"""Displays of a study as text and HTML, completion, and the round trip through tables."""

import tomllib
from html.parser import HTMLParser

import pytest
import tomli_w
from support.studies import small_study

import sinsjax
from sinsjax.study import display, files


@pytest.mark.nightly(
    fast=(
        "car_test",
        "compass_car",
        "methods",
        "paper1_resets",
        "reset_sweep",
        "tune_condition5",
    )
)
@pytest.mark.parametrize("name", files.shipped_studies())
def test_shipped_study_is_displayed_in_five_short_lines_and_round_trips(name):
    study = sinsjax.load_study(name)
    title, *facts = lines = repr(study).splitlines()
    assert title == f"Study {name}" and len(lines) == 5 and max(map(len, lines)) <= 80
    assert str(study) == repr(study)
    assert f"{study.n_variants:,} variant" in facts[0] and study.methods[0] in facts[2]
    tables = study.to_dict()
    assert sinsjax.study_from_dict(tables) == study
    assert sinsjax.study_from_dict(tomllib.loads(tomli_w.dumps(tables))) == study


def test_changed_tables_of_a_study_do_not_change_it():
    study = small_study(axes={"phi_u0_deg": [1.0, 2.0]})
    tables = study.to_dict()
    tables["axes"]["phi_u0_deg"].append(3.0)
    assert study.n_variants == 2 and sinsjax.study_from_dict(tables).n_variants == 3
    assert "p0_yaw_deg" not in tables.get("filter", {})  # its default
    assert "max_gap_s" not in tables["study"]


class _Cells(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.text = ""

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.tags.add(tag)

    def handle_data(self, data: str) -> None:
        self.text += data


def test_html_escapes_text_from_a_file():
    study = small_study(study={"name": "<script>alert(1)</script>&"})
    reader = _Cells()
    reader.feed(study._repr_html_())
    assert reader.tags == {"table", "caption", "tr", "th", "td"}
    assert "<script>alert(1)</script>&" in reader.text
    for shown in (
        display.format_text("t", {"a": "\x1b[31m"}),
        display.format_html("\x1b", {"a": "b"}),
    ):
        assert "\x1b" not in shown and "\\x1b" in shown
    assert "<b>" not in display.format_html("t", {"<b>name": "<b>fact"})


def test_study_is_loaded_from_name_path_or_study(tmp_path, monkeypatch):
    shipped = sinsjax.load_study("reset_sweep")
    assert sinsjax.load_study(shipped) is shipped
    assert sinsjax.load_study(shipped, {"study.draws": 2}).n_draws == 2
    monkeypatch.chdir(tmp_path)
    (tmp_path / "reset_sweep").write_bytes(tomli_w.dumps(small_study().to_dict()).encode())
    assert sinsjax.load_study("reset_sweep").n_variants == 1  # a file of that name comes first
    with pytest.raises(sinsjax.InputError, match=r"^reset_swep: .*did you mean reset_sweep\?"):
        sinsjax.run("reset_swep")
    with pytest.raises(sinsjax.InputError, match=r"did you mean tune_large\?"):
        sinsjax.tune("tune_larg", tmp_path / "out")


def test_input_error_carries_a_line_for_every_mistake_of_a_stage():
    tables = small_study().to_dict()
    tables["study"]["draws"] = 0
    tables["axes"] = {"phi_u0_deg": [200.0]}
    tables["earth"]["latitude_deg"] = 95.0
    with pytest.raises(sinsjax.InputError) as caught:
        sinsjax.study_from_dict(tables, "mine")
    lines = caught.value.lines
    assert {line.partition(": ")[2].split(":")[0] for line in lines} == {
        "[study] draws",
        "[axes] phi_u0_deg[0]",
        "[earth] latitude_deg",
    }
    assert str(caught.value) == "\n".join(lines)

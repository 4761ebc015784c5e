"""The first ten minutes: studies by name, templates, changes, checks before a run, help."""

import errno
import os
import re
from pathlib import Path

import pytest
import tomli_w
from support.studies import small_tables

import sinsjax as package
from sinsjax.study import files

pytestmark = pytest.mark.optimised(False)

CONFIGS = Path(__file__).parents[2] / "configs"


def test_study_is_found_by_name_after_local_files(sinsjax):
    path = CONFIGS / "reset_sweep.toml"
    Path("reset_sweep").mkdir()  # results are no study
    for name in ("reset_sweep", "reset_sweep.toml", "configs/reset_sweep.toml", path):
        assert files.study_file_or_given_path(name).samefile(path)
    with pytest.raises(package.InputError, match=r"^reset_sweeps: cannot .*mean reset_sweep\?"):
        package.load_study("reset_sweeps")
    Path("reset_sweep.toml").write_text("x = 1\n")
    assert files.study_file_or_given_path("reset_sweep").samefile("reset_sweep.toml")


def test_init_copies_study_file_with_comments(sinsjax):
    code, told, error = sinsjax("init", "reset_sweep")
    assert (code, error) == (0, "") and "sinsjax validate reset_sweep.toml" in told
    schema, _, text = Path("reset_sweep.toml").read_text().partition("\n")
    assert schema == f"#:schema {(CONFIGS / 'schema.json').as_uri()}"
    original = (CONFIGS / "reset_sweep.toml").read_text().splitlines()[1:]
    changed = set(text.splitlines()) - set(original)
    assert len(text.splitlines()) == len(original) and all(line[0] == "#" for line in changed)
    assert "configs/" not in text  # a user has no such folder
    code, told, _ = sinsjax("init", "--list")
    known = {*files.shipped_studies(), *files.TEMPLATES}
    assert code == 0 and known <= {*re.findall(r"\w+", told)} and "configs/" not in told


@pytest.mark.parametrize("name", files.TEMPLATES)
def test_templates_are_valid(sinsjax, name):
    assert sinsjax("init", name)[0] == 0
    code, told, error = sinsjax("validate", name)
    assert (code, error) == (0, "") and f"{name}.toml: valid; " in told


def test_errors_of_shipped_studies_name_the_study(sinsjax):
    Path("mine.toml").write_text((CONFIGS / "reset_sweep.toml").read_text())
    for given, name in {"reset_sweep": "reset_sweep", "mine": "mine.toml"}.items():
        _, _, error = sinsjax("validate", given, "--set", "alignment.foo=3")
        assert error.startswith(f"error: {name}: [alignment] foo: unknown key")
    code, told, _ = sinsjax("validate", "reset_sweep", "--set", "axes.reset_count={}")
    assert code == 0 and told.startswith("reset_sweep: valid; ")


def test_study_file_is_written_whole_or_not_at_all(sinsjax, tmp_path, monkeypatch):
    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        line = "error: sweep.toml: cannot be written: No space left on device\n"
        assert sinsjax("init", "sweep") == (2, "", line)
    assert not list(tmp_path.iterdir())
    assert sinsjax("init", "sweep")[0] == 0
    written = Path("sweep.toml").read_bytes()
    Path("dangling.toml").symlink_to("nowhere")
    for name in ("sweep", "dangling"):
        code, _, error = sinsjax("init", "sweep", "-o", f"{name}.toml")
        assert code == 2 and error.startswith(f"error: {name}.toml: exists, and is not overwritten")
    assert Path("sweep.toml").read_bytes() == written and not Path("nowhere").exists()


def test_validate_reports_all_errors_of_a_stage(sinsjax):
    """First those of names; once these are right, those of values."""
    tables = small_tables(study={"draws": 0}, axes={"phi_u0_deg": [0, "x", 400]})
    for more, places in (
        ({"filtr": {}, "seedd": 3}, ["[filtr]", "[seedd]"]),
        ({}, ["[axes] phi_u0_deg[1]", "[axes] phi_u0_deg[2]", "[study] draws"]),
    ):
        Path("wrong.toml").write_text(tomli_w.dumps(tables | more))
        code, told, error = sinsjax("validate", "wrong")
        lines = error.replace("error: wrong.toml: ", "").splitlines()
        assert (code, told) == (2, "") and sorted(x.partition(":")[0] for x in lines) == places


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("sweep reset_sweep --bogus", "--bogus"),
        ("sweep reset_sweep", "'--out' / '-o'"),
        ("validate reset_sweep --set phi_u0_deg", "must be SECTION.KEY=VALUE"),
        ("validate reset_sweep --set alignment.phi_u0_deg=[", "not a TOML value"),
        ("validate reset_sweep --set coarse={}", "coarse: cannot be dropped"),
        (f"validate reset_sweep --set study.window_s={'[' * 20_000}", "too deeply"),
        ("validate ..", ".."),
        ("sweep car_test -o out", "align"),
        ("sweep reset_sweep -o out --devices 4096", "--devices: 4096"),
        ("align no.imu reset_sweep -o out", "[record]"),
        ("init reset_swep", "did you mean reset_sweep?"),
        ("keys reset_cont", "did you mean reset_count?"),
    ],
    ids=lambda text: text[:50],
)
def test_wrong_command_line_gives_one_line_error(sinsjax, words, named):
    code, told, error = sinsjax(*words.split())
    assert (code, told, error.count("\n")) == (2, "", 1)
    assert error.startswith("error: ") and named in error and not Path("out").exists()


def test_validate_reports_planned_runs_and_cost_and_keys_explain(sinsjax):
    code, told, _ = sinsjax("validate", "reset_sweep", "--set", "alignment.phi_u0_deg=12")
    assert code == 0 and "variants: 56, draws: 16." in told
    assert "896 runs of up to 900 s: roughly" in told and "of memory" in told and "on disk" in told
    code, told, _ = sinsjax("keys", "reset_count")
    assert code == 0 and told.startswith("[resets] reset_count: default 0; methods: all but ")
    assert sinsjax("keys", "earth")[1].count("[earth]") == 6


def test_replace_changes_given_keys_and_what_follows_from_them():
    drawn = package.load_study("reset_sweep").replace(
        {"drawn.gyro_bias_deg_per_h.normal": [0.0, 0.1]}
    )
    assert not drawn.replace({"sensors.gyro_bias_deg_per_h": 0.0}).drawn_keys
    template = package.load_study(files.template_files()["sweep"])
    assert template.replace({"study.duration_s": 600.0}).study.window_s == (400.0, 600.0)
    assert template.replace({"axes.reset_times_s": {}}).axis_keys == ("phi_u0_deg",)
    paper = package.load_study("paper1_resets")
    assert paper.replace({"cases": paper.to_dict()["cases"][:1]}).values("case") == ["condition 1"]

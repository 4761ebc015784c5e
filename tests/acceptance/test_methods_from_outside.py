"""A method of another package, found by its entry point."""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.forked import Server

import sinsjax as package
from sinsjax.methods import base

EXAMPLE = Path(__file__).parents[1] / "example_method"
PAGE = (EXAMPLE.parents[1] / "docs" / "own_method.md").read_text("utf-8")
MESSAGES = (EXAMPLE.parents[1] / "docs" / "messages.md").read_text("utf-8")
STUDY = re.findall(r"^```toml\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)[-1]


def test_own_method_pages_document_options_and_covariance() -> None:
    """Yield the fields in order, and the hidden differences between two objects."""
    fields = ", ".join(base.AttitudeCovariance._fields)
    assert f"`AttitudeCovariance({fields})`, rad^2" in PAGE
    assert all(f"`{name}`" in PAGE for name in base.Options._fields)
    assert "functools.partial(_step, options.dt)" in PAGE
    extending = (EXAMPLE.parents[1] / "docs" / "extending.md").read_text("utf-8")
    _, _, section = extending.partition("\n## Covariance analysis\n")
    for name in ("has_error_step=True", "error_step(", "error_angles(", "start_error("):
        assert name in section.partition("\n## ")[0]
    assert "extending.md#covariance-analysis" in PAGE


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder where the example is installed."""
    build = pytest.importorskip("hatchling.build")
    folder = tmp_path_factory.mktemp("site")
    source = shutil.copytree(EXAMPLE, tmp_path_factory.mktemp("source") / "example")
    here = os.getcwd()
    try:
        os.chdir(source)
        wheel = build.build_wheel(str(folder))
    finally:
        os.chdir(here)
    with zipfile.ZipFile(folder / wheel) as archive:
        archive.extractall(folder)
    return folder


@pytest.fixture(scope="module")
def forked() -> Iterator[Server]:
    """Run command lines one after the other in a process that finds methods of its own."""
    server = Server()
    yield server
    server.close()


def sinsjax(*words: str, site: Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a command as a user does, in a fresh process."""
    paths = [str(site), *filter(None, [os.environ.get("PYTHONPATH")])]
    return subprocess.run(
        [sys.executable, "-m", "sinsjax", *words],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
    )


def is_listed(line: str) -> bool:
    """Return whether a row on methods of other packages is on a message that names one."""
    section = MESSAGES.partition("\n## A method of another package\n")[2].partition("\n## ")[0]
    rows = [row.split("|")[1] for row in section.splitlines() if row.startswith("| `")]
    forms = [form.split("...") for row in rows for form in re.findall("`(.+?)`", row)]
    patterns = (".*".join(re.escape(piece.strip()) for piece in form) for form in forms)
    return any(re.search(pattern, line) for pattern in patterns)


@pytest.mark.slow
@pytest.mark.optimised(False)
def test_plugin_method_is_explained_and_swept_like_built_in_methods(
    site: Path, tmp_path: Path
) -> None:
    """Its section is read and explained, its runs are compared with others, its version stored."""
    (tmp_path / "averages.toml").write_text(STUDY)
    told = sinsjax("keys", "averaged", site=site, cwd=tmp_path)
    assert (told.returncode, told.stderr) == (0, "")
    assert "averaging_time_s" in told.stdout and "time constant of the average" in told.stdout
    assert "package: averaged-alignment 1.0" in told.stdout
    (silent,) = (line for line in told.stdout.splitlines() if "without effect" in line)
    assert "phi_u0_deg" in silent
    swept = sinsjax("sweep", "averages.toml", "-o", "out", site=site, cwd=tmp_path)
    assert swept.returncode == 0, swept.stderr
    assert package.read_manifest(tmp_path / "out")["versions"]["averaged-alignment"] == "1.0"
    runs = package.read_summary(tmp_path / "out").to_pylist()
    errors = {row["method"]: row["phi_u_arcmin"] - row["floor_arcmin"] for row in runs}
    assert set(errors) == {"averaged", "inertial"} and max(map(abs, errors.values())) < 0.5


def tuning(path: Path, tune: str = "") -> None:
    """Write the study of the page with its variable, for the searches that [tune] does."""
    (ranges,) = re.findall(r"`(averaging_time_s = \{.+\})`", PAGE)
    study = STUDY.replace("averaging_time_s = 1000.0", "").replace(', "inertial"]', "]")
    path.write_text(f"{study}{tune}[tune.variables]\n{ranges}\n")


@pytest.mark.slow
def test_plugin_method_key_can_be_tuned_by_gradient(
    forked: Server, site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Numbers follow the key, and the searches of [tune] use it."""
    monkeypatch.syspath_prepend(site)
    method, relaxed = (
        import_module(f"averaged_alignment.{name}") for name in ("method", "relaxed")
    )

    def kept(time_s: float) -> Any:
        columns = SimpleNamespace(column=lambda key: np.array([time_s]), rate_hz=50.0)
        return method.numbers(columns, None, 1.0)

    changed = relaxed.RELAXED.changes["averaging_time_s"](kept(10.0), None, 40.0, 10.0)
    np.testing.assert_allclose(changed.kept, kept(40.0).kept, rtol=1e-12)
    tuning(tmp_path / "tuned.toml")
    (told,) = forked(("validate", "tuned.toml"), site=site, cwd=tmp_path)
    assert (told.returncode, told.stderr) == (0, "") and "tunes averaging_time_s" in told.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "line"),
    [
        (("description:AVERAGED", "nowhere:AVERAGED"), "cannot be loaded (ModuleNotFoundError: "),
        (("description:", "de-scription:"), "cannot be loaded ('averaged_alignment.de-scription:"),
        (("AVERAGED", "AveragedSection"), "description:AveragedSection is a ModelMetaclass, no "),
        (('name="averaged"', 'name="inertial"'), "there is already a method 'inertial'"),
        (('{"averaged": Av', '{"filter": Av'), "section [filter] is that of another method"),
        (("averaging_time_s", "level_time_s"), "key level_time_s is one of section [compass]"),
        (("averaging_time_s", "duration_s"), "[averaged] duration_s is a key of [study]"),
        (
            ("reads=INITIAL", "reads=('nosuch_deg',) + INITIAL"),
            "reads: 'nosuch_deg' is no key of [al",
        ),
        (('{"averaged": Av', '{"study": Av'), "[study] is a section of every study"),
    ],
)
def test_broken_or_clashing_plugin_gives_one_line_error(
    forked: Server, site: Path, tmp_path: Path, change: tuple[str, str], line: str
) -> None:
    changed = shutil.copytree(site, tmp_path / "site")
    for path in (
        changed / "averaged_alignment" / "description.py",
        changed / "averaged_alignment-1.0.dist-info" / "entry_points.txt",
    ):
        text = path.read_text()
        if path.suffix == ".txt" or not change[0].startswith(("desc", "AV")):
            path.write_text(text.replace(*change))
    (told,) = forked(("keys", "averaged"), site=changed, cwd=tmp_path)
    assert told.returncode == 2 and told.stderr.count("\n") == 1
    assert told.stderr.startswith("error: ") and line in told.stderr
    assert "averaged-alignment 1.0" in told.stderr and is_listed(told.stderr)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (("averaging_time_s", "duration_s"), "[averaged] duration_s is a key of [study]"),
        (
            ("reads=", "reads=('phi_u_deg',) + "),
            "reads: 'phi_u_deg' is no key of [alignment] or [passes] (did you mean phi_u0_deg?)",
        ),
    ],
)
def test_broken_plugin_affects_only_studies_that_use_it(
    forked: Server, site: Path, tmp_path: Path, change: tuple[str, str], why: str
) -> None:
    changed = shutil.copytree(site, tmp_path / "site")
    described = changed / "averaged_alignment" / "description.py"
    described.write_text(described.read_text().replace(*change))
    # Its section and its keys are no errors of their own, wherever the method is named.
    study = STUDY.replace("[averaged]\n", "").replace("averaging_time_s = 1000.0\n", "")
    study = study.replace("[alignment]\n", '[alignment]\nmethod = "averaged"\n')
    study = study.replace('method = ["averaged", "inertial"]', "averaging_time_s = [1.0, 2.0]")
    (tmp_path / "averages.toml").write_text(study)
    other, told = forked(
        ("validate", "reset_sweep"), ("validate", "averages.toml"), site=changed, cwd=tmp_path
    )
    assert (other.returncode, other.stderr) == (0, "")
    why = f"method 'averaged' of averaged-alignment 1.0: {why}"
    line = f"averages.toml: [alignment] method: 'averaged' cannot be used: {why}"
    assert (told.returncode, told.stderr) == (2, f"error: {line}\n")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kalman5", "my averaged"])
def test_misnamed_entry_point_is_reported_by_validate_and_info(
    forked: Server, site: Path, tmp_path: Path, name: str
) -> None:
    """A study with the method's own name is told where to look."""
    changed = shutil.copytree(site, tmp_path / "site")
    points = changed / "averaged_alignment-1.0.dist-info" / "entry_points.txt"
    points.write_text(points.read_text().replace("averaged =", f"{name} ="))
    study = STUDY.replace("[averaged]\naveraging_time_s = 1000.0\n", "")
    (tmp_path / "averages.toml").write_text(study)
    (tmp_path / "section.toml").write_text(STUDY)  # its section is unknown, too
    told, of_section, info = forked(
        *(("validate", "averages.toml"), ("validate", "section.toml"), ("info",)),
        site=changed,
        cwd=tmp_path,
    )
    assert told.returncode == 2 and told.stderr.count("\n") == 1
    assert told.stderr.startswith("error: averages.toml: [axes] method[0]: must be 'kalman5', ")
    assert "not 'averaged'" in told.stderr and "`sinsjax info` shows why" in told.stderr
    assert of_section.returncode == 2
    assert all("`sinsjax info` shows why" in line for line in of_section.stderr.splitlines())
    assert all(map(is_listed, of_section.stderr.splitlines()))
    assert f"not usable  entry point '{name}' in sinsjax.methods of averaged-a" in info.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "what", "function"),
    [
        (("none = jnp", "none = state.nothing  # jnp"), "step: AttributeError: 'State' obj", ""),
        (("sample.dv),", "sample.dv)[:1],"), "step: gave state.force[0], not ", "_step"),
    ],
)
def test_validate_reports_failing_plugin_step(
    forked: Server, site: Path, tmp_path: Path, change: tuple[str, str], what: str, function: str
) -> None:
    changed = shutil.copytree(site, tmp_path / "site")
    method = changed / "averaged_alignment" / "method.py"
    method.write_text(method.read_text().replace(*change))
    (tmp_path / "averages.toml").write_text(STUDY)
    (told,) = forked(("validate", "averages.toml"), site=changed, cwd=tmp_path)
    assert told.returncode == 2 and told.stderr.count("\n") == 1
    assert told.stderr.startswith(f"error: method 'averaged' of averaged-alignment 1.0: {what}")
    sought = f"def {function}(" if function else change[1]
    (line,) = (i for i, text in enumerate(method.read_text().splitlines(), 1) if sought in text)
    assert told.stderr.endswith(f", in {method}:{line}\n")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "what"),
    [
        ("1 / 0", "ZeroDivisionError: division by zero, in "),
        ("value.nothing", "AttributeError: "),
        ("params.kept * base / value", "gave one number or array, without numbers.kept, unlike "),
        ("params._replace(kept=params.kept / value)", "gives numbers.kept = 0.0031"),
        ("params", "no number changes with it at 10, 316.228 and 10000, in "),
        ("params._replace(kept=params.kept + 0 * value)", "no number changes with it at 10, "),
    ],
)
def test_validate_and_tune_report_wrong_relaxed_changes_of_plugin(
    forked: Server, site: Path, tmp_path: Path, change: str, what: str
) -> None:
    changed = shutil.copytree(site, tmp_path / "site")
    relaxed = changed / "averaged_alignment" / "relaxed.py"
    text = re.sub(r"return params\._replace.*", f"return {change}", relaxed.read_text())
    relaxed.write_text(text)
    tuning(tmp_path / "tuned.toml")
    commands = ("validate", "tuned.toml"), ("tune", "tuned.toml", "-o", "out")
    for told in forked(*commands, site=changed, cwd=tmp_path):
        whose = "method 'averaged' of averaged-alignment 1.0: relaxed.changes['averaging_time_s']"
        assert told.returncode == 2 and told.stderr.count("\n") == 1
        assert told.stderr.startswith(f"error: {whose}: {what}")
        assert re.search(rf", in {relaxed}:\d+$", told.stderr)
        assert "Error: " in told.stderr or is_listed(told.stderr)


def test_unsupported_covariance_search_names_file_and_remedy(
    forked: Server, site: Path, tmp_path: Path
) -> None:
    tuning(tmp_path / "tuned.toml", '[tune]\nsearches = ["covariance"]\n')
    (told,) = forked(("validate", "tuned.toml"), site=site, cwd=tmp_path)
    why = "[axes] method: covariance analysis has no linear model of averaged"
    line = f"[tune] searches: 'covariance' does not apply to this study (use 'sobol'): {why}"
    assert (told.returncode, told.stderr) == (2, f"error: tuned.toml: {line}\n")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("given", "described", "what"),
    [
        ("no_covariance(state.nav.ve)", True, "gives none as a run begins, but has_covariance is"),
        ("AttitudeCovariance(*(one, 0 * one) * 3)", False, "gives one, but has_covariance is Fal"),
        ("AttitudeCovariance(*(-one, 0 * one) * 3)", True, "gives a negative variance as a run "),
        ("AttitudeCovariance(one, 0 * one, 0 * one, one, 0 * one, one)", True, None),
    ],
)
def test_validate_warns_if_covariance_contradicts_description(
    forked: Server, site: Path, tmp_path: Path, given: str, described: bool, what: str | None
) -> None:
    changed = shutil.copytree(site, tmp_path / "site") / "averaged_alignment"
    for name, change in {
        "description.py": ("has_covariance=False", f"has_covariance={described}"),
        "method.py": (
            "return no_covariance(state.nav.ve)",
            f"one = 1 + 0 * state.nav.ve\n    return {given}",
        ),
    }.items():
        text = (changed / name).read_text().replace(*change)
        text = text.replace("import Method", "import AttitudeCovariance, Method")
        (changed / name).write_text(text)
    (tmp_path / "averages.toml").write_text(STUDY)
    (told,) = forked(("validate", "averages.toml"), site=changed.parent, cwd=tmp_path)
    assert (told.returncode, told.stderr) == (0, "")
    warnings = [line for line in told.stdout.splitlines() if line.startswith("Warning: method")]
    start = "Warning: method 'averaged' of averaged-alignment 1.0: covariance: "
    assert len(warnings) == (what is not None)
    assert all(line.startswith(f"{start}{what}") and is_listed(line) for line in warnings)

"""``benchmarks/soak.py`` on a fake command: a sound one passes, a faulty one fails."""

import re
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import soak  # noqa: E402

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not Path("/proc/self/stat").exists(), reason="no /proc to find processes in"
    ),
]

COMMAND = """
import fcntl, json, os, sys, time
from pathlib import Path

fault, out = sys.argv[1], Path(sys.argv[sys.argv.index("-o") + 1])
(out / "summary").mkdir(parents=True, exist_ok=True)
lock = open(out / ".lock", "w")
try:
    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
except OSError:
    print(f"error: {out}: another process is writing there", file=sys.stderr)
    sys.exit(2)
for path in out.rglob("*.tmp") if fault != "litter" else ():
    path.unlink()
if fault == "child" and "--resume" in sys.argv and os.fork() == 0:
    time.sleep(100)
for k in range(15):
    path = out / "summary" / f"part-{k}.parquet"
    if path.exists():
        continue
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    temporary.write_text(f"{k}" + "!" * (fault == "part" and "--resume" in sys.argv))
    time.sleep(0.01)
    temporary.replace(path)
state = "running" if fault == "manifest" and "--resume" in sys.argv else "complete"
(out / "manifest.json").write_text(json.dumps({"state": state, "chunks": []}))
"""


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("none", "directories complete ("),
        ("part", "differ"),
        ("litter", "temporary files are left"),
        ("manifest", "manifest.json says running"),
        ("child", "leaves processes that do not end"),
        ("report", "cannot be reported: no"),
    ],
)
def test_soak_passes_sound_command_and_detects_faults(
    fault: str,
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(soak, "LEAVES_S", 0.3)
    program = tmp_path / "command.py"
    program.write_text(COMMAND)
    python = [sys.executable, "-S", "-E"]
    report = [*python, "-c", f"raise SystemExit({'no' if fault == 'report' else 0!r})"]
    case = soak.Case("stub", [*python, str(program), fault], report)
    # As often as it takes: a fault ends it.
    status = soak.soak([case], tmp_path, minutes=0.03 if fault == "none" else 1.0, seed=3)
    told = capsys.readouterr().out
    assert status == (fault != "none") and says in told, told
    kept = re.search(r"kept: (.*)", told)
    if fault == "none":
        kills = re.search(r"complete .*, (\d+) kills, 0 mismatches", told)
        assert kills is not None and int(kills[1]) > 0 and kept is None
    else:
        assert kept is not None and list(Path(kept[1]).rglob("*.parquet"))


def test_soak_cases_use_real_sweep_and_tune_commands(tmp_path: Path) -> None:
    """The three commands, whose studies load."""
    from sinsjax.study.load import load_study

    one, two, tune = soak.the_cases(tmp_path)
    assert two.words == [*one.words, "--workers", "2"] and two.crew and not one.crew
    assert "sweep" in one.words and "tune" in tune.words
    study = load_study(tmp_path / "sweep.toml")
    assert study.n_draws * study.n_variants / soak.CHUNK_RUNS == 100
    assert load_study(tmp_path / "tune.toml").tune is not None

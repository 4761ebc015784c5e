"""The gate of the engine's speed fails above its bound and is skipped where it cannot measure."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import gate  # noqa: E402


@pytest.mark.parametrize(("measured", "status"), [(1.25, 0), (1.26, 1)])
def test_gate_passes_or_fails_by_ratio(measured, status):
    assert gate.judge(measured, "AVX2", 1.25)[0] == status


def test_gate_is_skipped_on_another_processor_and_fails_as_its_worst_set(monkeypatch):
    monkeypatch.setattr(gate.platform, "machine", lambda: "arm64")
    (skipped,) = gate.gate()
    assert skipped.status == 0 and "skipped" in skipped.line
    monkeypatch.setattr(gate, "gate", lambda: [gate.judge(r, "AVX2", 1.25) for r in (1.3, 1.0)])
    monkeypatch.setattr(sys, "argv", ["gate.py"])
    with pytest.raises(SystemExit) as ended:
        gate.main()
    assert ended.value.code == 1

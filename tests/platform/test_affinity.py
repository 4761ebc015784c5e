"""One core per process: real processes with real locks."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import sinsjax
from sinsjax.platform import affinity

pytestmark = pytest.mark.skipif(
    not hasattr(os, "sched_setaffinity"), reason="this system keeps no process to a core"
)

START = """
import os, sys, threading, types
os.sched_setaffinity(0, {cores})
threading.Thread(target=sys.stdin.readline).start()  # one that is there before
if {bare}:  # the module alone, without jax: quicker
    package = types.ModuleType("sinsjax")
    package.__path__ = [{path!r}]
    sys.modules["sinsjax"] = package
    from sinsjax.platform import affinity
    affinity.pin_if_requested()
else:
    import jax, sinsjax
    sinsjax.configure()
    jax.devices()
cores = {{frozenset(os.sched_getaffinity(int(t))) for t in os.listdir("/proc/self/task")}}
print(*sorted(map(sorted, cores)), flush=True)
"""

CORES = sorted(os.sched_getaffinity(0))[:2] if hasattr(os, "sched_getaffinity") else []

Start = Callable[..., tuple[str, subprocess.Popen]]


@pytest.fixture
def start_pinned_process(tmp_path: Path) -> Iterator[Start]:
    """Start processes that print the cores of their threads and stay until the test ends."""
    started: list[subprocess.Popen] = []

    def begin(asked: str = "1", bare: bool = True) -> tuple[str, subprocess.Popen]:
        package = Path(sinsjax.__file__).parent
        process = subprocess.Popen(
            [sys.executable, "-c", START.format(bare=bare, cores=CORES, path=str(package))],
            env={
                **os.environ,
                "PYTHONPATH": str(package.parent),
                "TMPDIR": str(tmp_path),
                affinity.VARIABLE: asked,
            },
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        assert process.stdout is not None
        return process.stdout.readline().strip(), process

    yield begin
    for process in started:
        process.communicate("\n", timeout=60)


def test_each_process_holds_separate_core_until_it_ends(start_pinned_process: Start) -> None:
    first, process = start_pinned_process()
    assert first == f"[{CORES[0]}]"
    others = [start_pinned_process()[0] for _ in CORES[1:]]
    assert others == [f"[{core}]" for core in CORES[1:]]
    # There is none left: a process more may run on all.
    assert start_pinned_process()[0] == str(CORES)
    process.kill()
    process.wait()
    assert start_pinned_process()[0] == first


def test_configure_pins_process_before_jax_starts_threads(start_pinned_process: Start) -> None:
    assert start_pinned_process(bare=False)[0] == f"[{CORES[0]}]"


def test_affinity_is_unchanged_unless_requested(start_pinned_process: Start) -> None:
    assert start_pinned_process(asked="0")[0] == str(CORES)


def test_world_writable_lock_folder_is_not_used(
    start_pinned_process: Start, tmp_path: Path
) -> None:
    folder = tmp_path / f"sinsjax-{os.getuid()}"
    folder.mkdir()
    folder.chmod(0o777)
    assert start_pinned_process()[0] == str(CORES)
    assert not list(folder.iterdir())

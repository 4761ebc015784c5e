"""Kills sweeps and tunings at random moments, goes on with them, and compares what comes of it.

`sweep` and `tune` in turn, sometimes two processes at once, until a directory is complete: then it
has to be what nobody disturbed, byte for byte. Ends at the first difference with exit code 1.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import common
import tomli_w

from sinsjax.platform import runtime

HANGS_S = 300.0
MOST_KILLS = 25
"""Of a directory; then it may come to its end."""

_LOCKED = ("another process is writing there", "another process has just written there")

_BASE: dict[str, dict[str, Any]] = {
    "earth": {"latitude_deg": 32.0},
    "motion": {"pitch_amplitude_deg": 1.8, "pitch_period_s": 6.0}
    | {"yaw_center_deg": 10.0, "yaw_amplitude_deg": 2.8, "yaw_period_s": 10.0},
    "sensors": {"gyro_bias_deg_per_h": 0.1, "gyro_noise_deg_per_h": 0.1}
    | {"accel_bias_ug": 500.0, "accel_noise_ug": 500.0},
    "alignment": {"phi_e0_deg": 5.0, "phi_n0_deg": 5.0},
}
SWEEP = _BASE | {
    "study": {"name": "soaked", "duration_s": 30.0, "rate_hz": 100.0, "window_s": [0, 30]}
    | {"draws": 400, "curves": True},
    "axes": {"yaw_amplitude_deg": [2.8, 0.0], "p0_yaw_deg": [10.0 * k for k in range(1, 17)]},
}
"""Two environments of 16 variants: 100 chunks of 128 runs."""

TUNE = _BASE | {
    "study": {"name": "soaked", "duration_s": 20.0, "rate_hz": 20.0, "window_s": [10, 20]},
    "resets": {"reset_count": 2, "reset_cycle_s": 5.0},
    "axes": {"phi_u0_deg": [5.0, 30.0]},
    "tune": {
        "objective": "final_error",
        "objective_across": "worst",
        **{"searches": ["grid", "gradient"], "grid_points": 8, "descent_starts": 1},
        **{"tune_draws": 64, "evaluation_draws": 128},
        "variables": {
            "reset_times_s": [{"low": 1.0, "high": 10.0}, {"low": 2.0, "high": 19.0}],
            "reset_count": {"candidates": [1, 2]},
        },
    },
}


class Different(Exception):
    """What a soak found."""


class Whole(NamedTuple):
    """What a command leaves undisturbed: files that count, by name, and how long it took."""

    files: dict[str, bytes]
    seconds: float


class Plan(NamedTuple):
    """When a process is killed: ``after_s`` once it has written ``files`` more files, and how."""

    after_s: float
    files: int
    number: int


class Process:
    """A command, its output and what is to become of it."""

    def __init__(self, words: list[str], log: Path, plan: Plan | None) -> None:
        self.plan, self.sent, self.log = plan, False, log
        with log.open("wb") as file:
            self.child = subprocess.Popen(
                words, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT
            )
        self._due: float | None = None

    def look(self, written: int) -> None:
        """Send the signal if its time has come."""
        if self.sent or self.plan is None or self.child.poll() is not None:
            return
        if self._due is None and written >= self.plan.files:
            self._due = time.monotonic() + self.plan.after_s
        if self._due is not None and time.monotonic() >= self._due:
            self.sent = True
            with suppress(ProcessLookupError):
                self.child.send_signal(self.plan.number)

    def is_complete(self, alone: bool) -> bool:
        """Whether it came to its end; raises `Different` for an end that it may not have."""
        code, said = self.child.returncode, self.log.read_text(errors="replace")
        if code == 0:
            return True
        if code == 2 and not alone and any(words in said for words in _LOCKED):
            return False
        if self.sent and self.plan is not None:
            early = code == 1 and ("Aborted" in said or "KeyboardInterrupt" in said)
            if early or code in (130, -self.plan.number, 128 + self.plan.number):
                return False
        raise Different(f"ends with {code} ({self.plan if self.sent else 'not killed'}): {said}")


def draw_plan(whole: Whole, chance: random.Random) -> Plan | None:
    """How the next process is killed; None lets it come to its end."""
    if chance.random() < 0.03:
        return None
    stop = chance.choice([signal.SIGINT, signal.SIGTERM])
    number = signal.SIGKILL if chance.random() < 0.7 else stop
    if chance.random() < 0.25:  # while it starts, mostly
        return Plan(chance.uniform(0, whole.seconds), 0, number)
    return Plan(chance.expovariate(10), chance.randint(1, max(1, len(whole.files) // 15)), number)


def counted(directory: Path) -> dict[str, bytes]:
    """The files that count, by name: parts, the study, what a tuning found."""
    names = ("*.parquet", "study.toml", "tuned.toml")
    found = {path for name in names for path in directory.rglob(name)}
    return {path.relative_to(directory).as_posix(): path.read_bytes() for path in sorted(found)}


def run_undisturbed(words: list[str], directory: Path) -> Whole:
    """What a command leaves; once for the compiler, and once for the clock."""
    files: list[dict[str, bytes]] = []
    for _ in range(2):
        shutil.rmtree(directory, ignore_errors=True)
        since = time.monotonic()
        process = Process([*words, "-o", str(directory)], Path(f"{directory}.log"), None)
        process.child.wait(HANGS_S)
        process.is_complete(alone=True)
        files.append(counted(directory))
    if files[0] != files[1]:
        raise Different(f"{unlike(*files)}, undisturbed")
    return Whole(files[1], time.monotonic() - since)


def unlike(files: dict[str, bytes], expected: dict[str, bytes]) -> str:
    """Which files differ."""
    names = [n for n in sorted({*files, *expected}) if files.get(n) != expected.get(n)]
    return f"{len(names)} files differ: {', '.join(names[:5])}"


def run_disturbed(
    words: list[str], whole: Whole, directory: Path, chance: random.Random, *, kill: bool
) -> list[Process]:
    """Run one process, perhaps with a second one beside it, up to their ends."""
    begin = time.monotonic() + (chance.uniform(0, whole.seconds) if chance.random() < 0.2 else 1e9)
    before, last = len(list(directory.rglob("*.parquet"))), time.monotonic() + HANGS_S
    words = [*words, "-o", str(directory), "--resume"]

    def start(log: str) -> Process:
        return Process(
            words, Path(f"{directory}.{log}"), draw_plan(whole, chance) if kill else None
        )

    processes = [start("log")]
    try:
        while any(process.child.poll() is None for process in processes):
            if len(processes) == 1 and time.monotonic() > begin:
                processes.append(start("second.log"))
            for process in processes:
                process.look(len(list(directory.rglob("*.parquet"))) - before)
            if time.monotonic() > last:
                raise Different(f"hangs: {processes[0].log.read_text(errors='replace')}")
            time.sleep(0.005)
    finally:
        for process in processes:
            process.child.kill()
            process.child.wait()
    return processes


def kill_until_complete(
    words: list[str], whole: Whole, directory: Path, chance: random.Random
) -> int:
    """Kill and go on until all is there, and compare; the number of kills."""
    killed, complete = 0, False
    while not complete:
        ended = run_disturbed(words, whole, directory, chance, kill=killed < MOST_KILLS)
        # Of all first, so that none is left out.
        complete = any([process.is_complete(len(ended) == 1) for process in ended])
        killed += sum(process.sent for process in ended)
        there = {n: b for n, b in counted(directory).items() if n in whole.files}
        # A tuning's history is written again by whoever goes on with it.
        there = {n: b for n, b in there.items() if not n.endswith("history.parquet")}
        if wrong := [n for n, b in there.items() if b != whole.files[n]]:
            raise Different(f"differ after a kill: {', '.join(wrong[:5])}")
    if (files := counted(directory)) != whole.files:
        raise Different(unlike(files, whole.files))
    if left := sorted(path.name for path in directory.rglob("*.tmp")):
        raise Different(f"{len(left)} temporary files are left: {', '.join(left[:5])}")
    for path in directory.rglob("manifest.json"):
        manifest = json.loads(path.read_text())
        if manifest["state"] != "complete" or manifest["runs_done"] != manifest["runs"]:
            raise Different(f"{path.relative_to(directory)} is not complete")
    report = subprocess.run([*words[:3], "report", str(directory)], capture_output=True, text=True)
    if report.returncode:
        raise Different(f"cannot be reported: {report.stderr}")
    return killed


def main() -> None:
    """Soak, and tell; no directory begins after the time, but each command has one."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=1.0, help="how long (1)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments; 0 takes the time's")
    flags = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="sinsjax-soak-"))
    os.environ.setdefault(runtime.CACHE_VARIABLE, str(folder / "cache"))
    path = [str(common.ROOT), os.environ.get("PYTHONPATH", "")]
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, path))
    seed = flags.seed or time.time_ns() // 10**9
    chance, since, number, kills = random.Random(seed), time.monotonic(), 0, 0
    commands = {"sweep": ["--chunk-runs", "128"], "tune": []}
    wholes: dict[str, Whole] = {}
    print(f"seed {seed}", flush=True)
    while number < len(commands) or time.monotonic() < since + 60 * flags.minutes:
        name = list(commands)[number % len(commands)]
        config, directory = folder / f"{name}.toml", folder / f"{name}-{number}"
        config.write_text(tomli_w.dumps(SWEEP if name == "sweep" else TUNE), encoding="utf-8")
        words = [sys.executable, "-m", "sinsjax", name, str(config), *commands[name]]
        try:
            if name not in wholes:
                wholes[name] = run_undisturbed(words, directory)
                shutil.rmtree(directory)
            killed = kill_until_complete(words, wholes[name], directory, chance)
        except Different as found:
            print(f"DIFFERENT: {name}: {found}\n  kept: {directory}", flush=True)
            raise SystemExit(1) from None
        print(f"{name}: equal after {killed} kills", flush=True)
        shutil.rmtree(directory)
        number, kills = number + 1, kills + killed
    print(f"{number} directories complete, {kills} kills")
    shutil.rmtree(folder)


if __name__ == "__main__":
    main()

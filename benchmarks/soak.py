"""Kills sweeps and tunings at random moments, goes on with them, and compares what comes of it.

One process, two Dask workers and `tune` in turn, each in a directory of its own until it is
complete: then every part, and what a tuning found, has to be what nobody disturbed, byte for byte.
Ends at the first difference, keeps its directory and exits with 1.
"""

import argparse
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import common
import tomli_w

from sinsjax.platform import compile_cache

CHUNK_RUNS = 128
HANGS_S = 300.0
LEAVES_S = 60.0
"""Within this time the workers of a process that was killed have gone."""

MOST_KILLS = 25
"""Of a directory; then it may come to its end."""

_STOPS = (signal.SIGINT, signal.SIGTERM)
_LOOK_S = 0.005
_LOCKED = re.compile(r"another process (is writing|has just written) there")

_BASE: dict[str, dict[str, Any]] = {
    "earth": {"latitude_deg": 32.0},
    "motion": {
        "yaw_center_deg": 10.0,
        "pitch_amplitude_deg": 1.8,
        "pitch_period_s": 6.0,
        "roll_amplitude_deg": 2.4,
        "roll_period_s": 8.0,
        "yaw_amplitude_deg": 2.8,
        "yaw_period_s": 10.0,
    },
    "sensors": {
        "gyro_bias_deg_per_h": 0.1,
        "gyro_noise_deg_per_h": 0.1,
        "accel_bias_ug": 500.0,
        "accel_noise_ug": 500.0,
    },
    "alignment": {"phi_e0_deg": 5.0, "phi_n0_deg": 5.0},
}
SWEEP: dict[str, dict[str, Any]] = _BASE | {
    "study": {
        "name": "soaked",
        "duration_s": 30.0,
        "rate_hz": 100.0,
        "draws": 400,
        "window_s": [0, 30],
        "curves": True,
    },
    "axes": {
        "yaw_amplitude_deg": [2.8, 0.0],
        "p0_yaw_deg": [10.0 * k for k in range(1, 17)],
    },
}
"""Two environments of 16 variants: 100 chunks of `CHUNK_RUNS` runs."""

TUNE: dict[str, dict[str, Any]] = _BASE | {
    "study": {"name": "soaked", "duration_s": 20.0, "rate_hz": 20.0, "window_s": [10, 20]},
    "resets": {"reset_count": 2, "reset_cycle_s": 5.0},
    "axes": {"phi_u0_deg": [5.0, 30.0]},
    "tune": {
        "objective": "final_error",
        "objective_across": "worst",
        "searches": ["grid", "gradient"],
        "tune_draws": 64,
        "evaluation_draws": 128,
        "grid_points": 8,
        "descent_starts": 1,
        "variables": {
            "reset_times_s": [{"low": 1.0, "high": 10.0}, {"low": 2.0, "high": 19.0}],
            "reset_count": {"candidates": [1, 2]},
        },
    },
}


class Different(Exception):
    """What a soak found."""


class Case(NamedTuple):
    """Something that is killed and gone on with.

    Attributes:
        name: of it.
        words: of its command line; ``-o DIRECTORY --resume`` is added.
        report: of the command that reads what is there at last; the directory is added.
        crew: whether it has workers, which are killed too, alone or together with it.
    """

    name: str
    words: Sequence[str]
    report: Sequence[str]
    crew: bool = False


class Whole(NamedTuple):
    """What a case leaves if nobody disturbs it: files that count, by name, and how long it took."""

    files: dict[str, bytes]
    seconds: float


class Plan(NamedTuple):
    """How a process is killed.

    Attributes:
        after_s: since it began, or since it had written more files.
        files: how many more files come first; 0: none.
        signals: one, or two at once.
        whom: "group", "asker" or "worker".
        worker: which of them, from 0 to 1.
    """

    after_s: float
    files: int
    signals: tuple[int, ...]
    whom: str
    worker: float = 0.0

    def __str__(self) -> str:
        names = " and ".join(signal.Signals(number).name for number in self.signals)
        return f"{names} to the {self.whom}"


class Process:
    """A command in a process group of its own, and what is to become of it."""

    def __init__(self, words: Sequence[str], said: Path, plan: Plan | None) -> None:
        self.plan, self.sent = plan, False
        self._said = said
        with said.open("wb") as file:
            self._child = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        self._since, self._more = time.monotonic(), 0

    @property
    def code(self) -> int | None:
        """Exit code once it has ended."""
        return self._child.poll()

    @property
    def said(self) -> str:
        """Its output so far."""
        return self._said.read_text(errors="replace")

    def look(self, written: Callable[[], int], began_with: int) -> None:
        """Send the signals if their time has come."""
        if self.sent or self.plan is None or self.code is not None:
            return
        if self._more < self.plan.files and written() >= began_with + self.plan.files:
            self._since, self._more = time.monotonic(), self.plan.files
        if self._more < self.plan.files or time.monotonic() < self._since + self.plan.after_s:
            return
        self.sent = True
        for number in self.plan.signals:
            self._send(number)

    def _send(self, number: int) -> None:
        workers = [pid for pid in members(self._child.pid) if pid != self._child.pid]
        with suppress(ProcessLookupError):
            if self.plan is not None and self.plan.whom == "worker" and workers:
                os.kill(workers[int(self.plan.worker * len(workers))], number)
            elif self.plan is not None and self.plan.whom == "group":
                os.killpg(self._child.pid, number)
            else:
                os.kill(self._child.pid, number)

    def leaves(self) -> bool:
        """Whether nothing of it is left, after some time; ends what is."""
        until = time.monotonic() + LEAVES_S
        while members(self._child.pid) and time.monotonic() < until:
            time.sleep(0.05)
        left = bool(members(self._child.pid))
        self.end()
        return not left

    def end(self) -> None:
        """End it and its workers."""
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._child.pid, signal.SIGKILL)
        self._child.wait()


def members(group: int) -> list[int]:
    """The processes of a group that are alive."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, leader = path.read_text().rpartition(")")[2].split()[:3]
        except (OSError, ValueError):  # gone meanwhile
            continue
        if int(leader) == group and state not in "ZX":
            found.append(int(path.parent.name))
    return found


def plan(case: Case, whole: Whole, chance: random.Random) -> Plan | None:
    """How the next process is killed; None lets it come to its end."""
    if chance.random() < 0.03:
        return None
    stops = chance.choice([*((one,) for one in _STOPS), _STOPS])
    signals = (signal.SIGKILL,) if chance.random() < 0.7 else stops
    whom = chance.choice(["group", "asker", "worker"]) if case.crew else "asker"
    if chance.random() < 0.25:  # while it starts, mostly
        after_s, files = chance.uniform(0, whole.seconds), 0
    else:
        after_s, files = chance.expovariate(10), chance.randint(1, max(1, len(whole.files) // 15))
    return Plan(after_s, files, signals, whom, chance.random())


def counted(directory: Path) -> dict[str, bytes]:
    """The files that count, by name: parts, the study, what a tuning found."""
    names = ("*.parquet", "study.toml", "tuned.toml")
    found = {path for name in names for path in directory.rglob(name)}
    return {path.relative_to(directory).as_posix(): path.read_bytes() for path in sorted(found)}


def undisturbed(case: Case, directory: Path) -> Whole:
    """What a case leaves; once for the compiler, and once for the clock."""
    wholes = []
    for _ in range(2):
        shutil.rmtree(directory, ignore_errors=True)
        since = time.monotonic()
        process = Process([*case.words, "-o", str(directory)], Path(f"{directory}.log"), None)
        while process.code is None:
            time.sleep(_LOOK_S)
        if process.code or not process.leaves():
            raise Different(f"ends with {process.code}, undisturbed: {process.said}")
        wholes.append(Whole(counted(directory), time.monotonic() - since))
    first, second = (whole.files for whole in wholes)
    if first != second:
        raise Different(f"{unlike(first, second)}, undisturbed")
    return wholes[1]


def unlike(files: dict[str, bytes], expected: dict[str, bytes]) -> str:
    """Which files differ."""
    names = sorted(files.keys() ^ expected.keys())
    names += [n for n in sorted(files.keys() & expected.keys()) if files[n] != expected[n]]
    return f"{len(names)} files differ: {', '.join(names[:5])}"


def life(
    case: Case, whole: Whole, directory: Path, chance: random.Random, *, kill: bool
) -> Iterator[Process]:
    """One process, perhaps with a second one beside it, up to their ends."""
    words = [*case.words, "-o", str(directory), "--resume"]
    beside = chance.random() < 0.2
    begin = time.monotonic() + chance.uniform(0, whole.seconds)
    began_with = len(files_of(directory))
    last = time.monotonic() + HANGS_S
    processes = [
        Process(words, Path(f"{directory}.log"), plan(case, whole, chance) if kill else None)
    ]
    try:
        while any(process.code is None for process in processes):
            if beside and time.monotonic() > begin:
                beside = False
                own = plan(case, whole, chance) if kill else None
                processes.append(Process(words, Path(f"{directory}.second.log"), own))
            for process in processes:
                process.look(lambda: len(files_of(directory)), began_with)
            if time.monotonic() > last:
                raise Different(f"hangs: {processes[0].said}")
            time.sleep(_LOOK_S)
        for process in processes:
            if not process.leaves():
                raise Different(f"leaves processes that do not end, after {process.plan}")
    finally:
        for process in processes:
            process.end()
    yield from processes


def files_of(directory: Path) -> list[Path]:
    """Every file that a process wrote so far."""
    return list(directory.rglob("*.parquet"))


def judge(process: Process, alone: bool) -> bool:
    """Whether a process came to its end; raises `Different` for an end that it may not have."""
    code, said = process.code, process.said
    if code == 0:
        return True
    if code == 2 and not alone and _LOCKED.search(said):
        return False
    if process.sent and process.plan is not None and process.plan.whom != "worker":
        fatal = {-number for number in process.plan.signals}
        stopped = {130, *(128 + number for number in process.plan.signals)}
        early = code == 1 and ("Aborted" in said or "KeyboardInterrupt" in said)
        if code in fatal | stopped or early:
            return False
    raise Different(f"ends with {code} ({process.plan if process.sent else 'not killed'}): {said}")


def cycle(
    case: Case, whole: Whole, directory: Path, chance: random.Random, kills: Counter[str]
) -> int:
    """Kill and go on until all is there, and compare; the number of processes."""
    lives, killed, complete = 0, 0, False
    while not complete:
        ended = list(life(case, whole, directory, chance, kill=killed < MOST_KILLS))
        lives += len(ended)
        for process in ended:
            complete |= judge(process, len(ended) == 1)
            if process.sent:
                killed += 1
                kills[f"{case.name}: {process.plan}"] += 1
        there = counted(directory)
        # A study of a tuning's search is written again by whoever goes on with it: the same.
        wrong = {n: b for n, b in there.items() if n in whole.files and b != whole.files[n]}
        wrong = {n: b for n, b in wrong.items() if not n.endswith("history.parquet")}
        if wrong:
            raise Different(f"differ after a kill: {', '.join(sorted(wrong)[:5])}")
    check_complete(case, whole, directory)
    return lives


def check_complete(case: Case, whole: Whole, directory: Path) -> None:
    """Raises `Different` where something is not as it would be if nobody had disturbed it."""
    if (files := counted(directory)) != whole.files:
        raise Different(unlike(files, whole.files))
    if left := sorted(path.name for path in directory.rglob("*.tmp")):
        raise Different(f"{len(left)} temporary files are left: {', '.join(left[:5])}")
    for path in directory.rglob("manifest.json"):
        told = json.loads(path.read_text())
        states = {told["state"], *(chunk["state"] for chunk in told["chunks"])}
        if wrong := sorted(states - {"complete", "done"}):
            raise Different(f"{path.relative_to(directory)} says {', '.join(wrong)}")
    ended = subprocess.run([*case.report, str(directory)], capture_output=True, text=True)
    if ended.returncode:
        raise Different(f"cannot be reported: {ended.stderr}")


def soak(cases: Sequence[Case], folder: Path, minutes: float, seed: int) -> int:
    """Soak cases in turn, and tell; the exit status.

    Args:
        cases: what is killed.
        folder: for the directories.
        minutes: after which no cycle begins; one of each case there is in any case.
        seed: of the moments.
    """
    chance, kills, cycles, lives = random.Random(seed), Counter[str](), Counter[str](), 0
    since = time.monotonic()
    wholes: dict[str, Whole] = {}
    number, directory, case = 0, folder, cases[0]
    try:
        while number < len(cases) or time.monotonic() < since + 60 * minutes:
            case = cases[number % len(cases)]
            directory = folder / f"{case.name.replace(' ', '-')}-{number}"
            if case.name not in wholes:
                wholes[case.name] = undisturbed(case, directory)
                whole, first = wholes[case.name], wholes[cases[0].name]
                if set(whole.files) == set(first.files) and whole.files != first.files:
                    raise Different(unlike(whole.files, first.files))
                print(f"{case.name}: {whole.seconds:.1f} s, {len(whole.files)} files", flush=True)
                shutil.rmtree(directory)
            before = kills.total()
            lives += cycle(case, wholes[case.name], directory, chance, kills)
            print(f"{case.name}: equal after {kills.total() - before} kills", flush=True)
            cycles[case.name] += 1
            shutil.rmtree(directory)
            number += 1
    except Different as found:
        print(f"DIFFERENT: {case.name}: {found}\n  kept: {directory}", flush=True)
        status = 1
    else:
        status = 0
    for what, count in sorted(kills.items()):
        print(f"{count:6}  {what}")
    told = ", ".join(f"{count} of {name}" for name, count in cycles.items())
    print(
        f"seed {seed}, {(time.monotonic() - since) / 60:.1f} minutes: {cycles.total()} directories"
        f" complete ({told}), {lives} processes, {kills.total()} kills, {status} mismatches"
    )
    return status


def the_cases(folder: Path) -> list[Case]:
    """One process, two workers and `tune`, their studies in a folder."""
    command = [sys.executable, "-m", "sinsjax"]
    paths = {}
    for name, study in {"sweep": SWEEP, "tune": TUNE}.items():
        paths[name] = folder / f"{name}.toml"
        paths[name].write_text(tomli_w.dumps(study), encoding="utf-8")
    sweep = [*command, "sweep", str(paths["sweep"]), "--chunk-runs", str(CHUNK_RUNS)]
    report = [*command, "report"]
    return [
        Case("one process", sweep, report),
        Case("two workers", [*sweep, "--workers", "2"], report, crew=True),
        Case("tune", [*command, "tune", str(paths["tune"])], report),
    ]


def main() -> None:
    """Soak, and tell."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=1.0, help="how long (1)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments; 0 takes the time's")
    parser.add_argument("--case", help="only this one")
    flags = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="sinsjax-soak-"))
    os.environ.setdefault(compile_cache.VARIABLE, str(folder / "cache"))
    os.environ["PYTHONPATH"] = os.pathsep.join(
        filter(None, [str(common.ROOT), os.environ.get("PYTHONPATH")])
    )
    cases = [case for case in the_cases(folder) if flags.case in (None, case.name)]
    if not cases:
        parser.error(f"--case: there is no {flags.case}")
    status = soak(cases, folder, flags.minutes, flags.seed or time.time_ns() // 10**9)
    if not status:
        shutil.rmtree(folder)
    raise SystemExit(status)


if __name__ == "__main__":
    main()

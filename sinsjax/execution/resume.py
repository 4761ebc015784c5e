"""State of a results directory, and whether a study may be written to it."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sinsjax.alignment.methods import packages_of
from sinsjax.errors import InputError
from sinsjax.execution.belongings import DATASETS, WHOLE
from sinsjax.execution.parts import MANIFEST, find, read_manifest
from sinsjax.execution.tasks import Job
from sinsjax.messages import one_line, shortened
from sinsjax.platform import runtime, xla
from sinsjax.platform.files import unwritable
from sinsjax.study.fingerprint import fingerprint, with_draws
from sinsjax.study.load import load_study
from sinsjax.study.study import Study

_NAMES = (*DATASETS, "figures", "study.toml", MANIFEST)


class _Checked(BaseModel):
    model_config = ConfigDict(extra="allow", allow_inf_nan=False)


class RunSession(_Checked):
    """Manifest entry of a process that wrote results.

    Attributes:
        started_unix_s: start time, s since 1970.
        wall_s: duration, s.
        versions: of the packages that may change the rows.
        instructions: instruction set that computed the rows.
    """

    started_unix_s: float
    wall_s: float
    versions: dict[str, str] = {}
    instructions: str | None = None


class File(_Checked):
    """Manifest entry of a part: its path in the directory, number of rows and checksum."""

    file: str
    rows: int
    sha256: str


class Done(_Checked):
    """Manifest entry of a chunk; without files it is missing."""

    name: str
    state: str
    seconds: float | None = None
    files: list[File] = []


class Manifest(_Checked):
    """The entries of a manifest that are needed to resume its results.

    Attributes:
        identity: of the job, see `Job.identity`.
        curves: whether curves are kept; None follows the study.
        chunk_runs: runs per chunk, as given to the job.
        extended_at: numbers of draws before each extension, as in the job.
        sessions: processes that wrote results.
        chunks: all chunks of the study.
    """

    identity: str
    curves: bool | None
    chunk_runs: Annotated[int, Field(ge=1)] | None
    extended_at: tuple[Annotated[int, Field(ge=1)], ...] = ()
    sessions: list[RunSession] = []
    chunks: list[Done] = []


def manifest(directory: Path) -> Manifest | None:
    """The manifest of a directory; None if missing or not suitable for resuming."""
    try:
        return Manifest.model_validate(read_manifest(directory))
    except (InputError, ValidationError):
        return None


def resumed(directory: Path, job: Job, instructions: str | None = None) -> Job:
    """The job with the runs per chunk and the choice of curves that its results began with.

    Its draws may be more than there were: it is then marked as extended.

    Args:
        directory: results directory.
        job: the job as requested now.
        instructions: instruction set that will run it; None for this process's.

    Raises:
        InputError: the directory holds results of another study (names the keys that differ),
            record, version or instruction set.
    """
    kept = check_same_study(directory, job.study)
    extended = kept is not None and _is_extended(kept, job.study)
    known = manifest(directory) or _from_parts(directory)
    if known is None:
        if (directory / MANIFEST).exists():
            raise InputError(
                f"{directory}: holds results of another version of sinsjax, which cannot be resumed"
                " (give --overwrite to replace them)"
            )
        return job
    _check_chunks(directory, known)
    if job.chunk_runs not in (None, known.chunk_runs):
        raise InputError(
            f"{directory}: chunk_runs: {job.chunk_runs} asked for, but its results were begun with"
            f" {known.chunk_runs or 'the default'} (--resume keeps that: leave --chunk-runs out)"
        )
    before = {*known.extended_at, *([kept.n_draws] if kept is not None and extended else [])}
    extended_at = tuple(sorted(draws for draws in before if draws <= job.study.n_draws))
    job = job._replace(curves=known.curves, chunk_runs=known.chunk_runs, extended_at=extended_at)
    _check_versions(directory, known, packages_of(job.study.methods))
    _check_instructions(directory, known, instructions or xla.instructions())
    if known.identity != job.identity:
        what = "study" if kept is None else "record or reference"
        raise InputError(f"{directory}: holds results of another {what}")
    return job


def check_same_study(directory: Path, study: Study) -> Study | None:
    """Reject results of another study than this one with as many draws, or with fewer.

    Returns:
        The study that the results are of; None if the directory has none that can be read.

    Raises:
        InputError: names the keys that differ, or why these results cannot be extended.
    """
    kept = _kept_study(directory)
    if kept is None:
        return None
    if _is_extended(kept, study):
        _check_extension(directory, kept, study)
    elif fingerprint(kept) != fingerprint(study):
        text = "; ".join(differences(kept, study)) or "written by another version"
        if _is_extended(study, kept):
            text += f" (there can be more, not fewer: go on with --draws {kept.n_draws})"
        raise InputError(f"{directory}: holds results of another study: {text}")
    return kept


def _is_extended(kept: Study, study: Study) -> bool:
    """Whether a study is a simulated one, ``kept``, with more draws and nothing else changed."""
    draws = study.study.draws
    if kept.study.draws is None or draws is None or draws <= kept.study.draws:
        return False
    return fingerprint(with_draws(kept, draws)) == fingerprint(study)


def _check_extension(directory: Path, kept: Study, study: Study) -> None:
    """Reject more draws where those that are there would mean something else.

    Estimates conclude from all draws at once. A list with an entry for every draw would begin
    again, which nobody meant who wrote it.
    """
    if kept.is_estimated:
        raise InputError(
            f"{directory}: [study] draws: {kept.study.draws} there, {study.study.draws} here:"
            " estimates of all draws cannot be extended (give another directory)"
        )
    laws = kept.drawn.laws if kept.drawn else {}
    for key, law in laws.items():
        if law.values and len(law.values) == kept.n_draws > 1:
            raise InputError(
                f"{directory}: [drawn] {key}.values: ends with the {kept.n_draws} draws that are"
                " there (give another directory to begin it again)"
            )


def _check_versions(directory: Path, known: Manifest, packages: Iterable[str]) -> None:
    """Reject rows of other versions, be they of packages that bring methods: bits may differ."""
    here = runtime.versions()
    for session in known.sessions:
        for name in (*runtime.DECISIVE, *packages):
            there = shortened(one_line(session.versions.get(name, here[name])))
            if there != here[name]:
                raise InputError(
                    f"{directory}: was computed with {name} {there}, but here is {here[name]}"
                    " (install that one, or give --overwrite)"
                )


def _check_instructions(directory: Path, known: Manifest, here: str) -> None:
    """Reject rows of another instruction set: last bits differ, and the difference grows."""
    for session in known.sessions:
        if (there := shortened(one_line(session.instructions or here))) != here:
            raise InputError(
                f"{directory}: was computed with instruction set {there}, but here is {here} (use a"
                f" machine with that one, XLA_FLAGS=--xla_cpu_max_isa={there} on a larger one, or"
                " --overwrite)"
            )


def _kept_study(directory: Path) -> Study | None:
    """The study of a directory; None if unreadable, as the parts identify their study too."""
    try:
        return load_study(directory / "study.toml")
    except InputError:
        return None


def _check_chunks(directory: Path, known: Manifest) -> None:
    """Reject chunks that differ from the stored parts: all of them would be recomputed."""
    sizes = set()
    for part in _readable_parts(directory):
        if part.chunk_runs == known.chunk_runs:
            return
        sizes.add("none" if part.chunk_runs is None else part.chunk_runs)
    if sizes:
        here = "none" if known.chunk_runs is None else known.chunk_runs
        raise InputError(
            f"{directory}: manifest.json: chunk_runs: is {here}, but its parts were written with"
            f" {min(sizes, key=str)} (restore that value, or give --overwrite)"
        )


def _from_parts(directory: Path) -> Manifest | None:
    """A manifest from the readable part with most extensions; None if there is none."""
    parts = _readable_parts(directory)
    return max(parts, key=lambda part: len(part.extended_at), default=None)


def _readable_parts(directory: Path) -> Iterator[Manifest]:
    """A manifest from the metadata of each readable part."""
    curves = True if any(find(directory, "curves")) else None
    for path in (path for name in WHOLE for path in sorted(find(directory, name))):
        try:
            marks = pq.read_schema(path).metadata or {}
            chunk, identity = json.loads(marks[b"sinsjax.chunk"]), marks[b"sinsjax.study"].decode()
            yield Manifest(
                identity=identity,
                curves=curves,
                chunk_runs=chunk["chunk_runs"],
                extended_at=chunk.get("extended_at", ()),
            )
        except (OSError, ValueError, RecursionError, pa.ArrowException, KeyError, TypeError):
            continue


def differences(there: Study, here: Study) -> list[str]:
    """Keys that affect results and differ between two studies, with both values."""
    old, new = _by_key(there), _by_key(here)
    found = [
        f"{key}: {_shown(old.get(key))} there, {_shown(new.get(key))} here"
        for key in dict.fromkeys((*old, *new))
        if old.get(key) != new.get(key)
    ]
    return found or ["its keys are in another order"]


def _by_key(study: Study) -> dict[str, Any]:
    """Values of a study by section and key of its file."""
    content = study.model_dump(exclude={"tune"}, exclude_none=True)
    for key in ("name", "unchecked"):
        content["study"].pop(key, None)
    tables = {f"axes.{name}": keys for name, keys in content.pop("zips", {}).items()}
    drawn = content.pop("drawn", {})
    tables["drawn"] = drawn.get("laws", {}) | {k: v for k, v in drawn.items() if k != "laws"}
    for i, case in enumerate(content.pop("cases", ())):
        tables[f"cases {i}"] = case
    return {
        f"[{table}] {key}": value
        for table, keys in (content | tables).items()
        for key, value in keys.items()
    }


def _shown(value: Any) -> str:
    text = "none" if value is None else str(list(value) if isinstance(value, tuple) else value)
    return shortened(text, 60)


def check_free(directory: Path, *, overwrite: bool) -> None:
    """Reject a directory that holds results, unless they may be used, or foreign files.

    Results are identified by their manifest or parts; a foreign file of the same name is never
    touched.

    Raises:
        InputError: the directory cannot be used.
    """
    taken = names_taken(directory, _NAMES)
    if not taken:
        return
    if not _is_ours(directory):
        raise InputError(
            f"{directory}: holds a {taken[0]} that is not a result (give another directory)"
        )
    if not overwrite:
        raise InputError(
            f"{directory}: already holds results (give --resume to continue them, or --overwrite"
            " to replace them; in Python resume=True or overwrite=True)"
        )


def names_taken(directory: Path, names: Iterable[str]) -> list[str]:
    """Which of some names exist in a directory, which may be missing itself.

    Raises:
        InputError: the directory is a file, or cannot be read.
    """
    try:
        if directory.exists() and not directory.is_dir():
            raise InputError(f"{directory}: is a file, not a directory")
        return [name for name in names if (directory / name).exists()]
    except OSError as error:
        raise InputError(unwritable(directory, error)) from error


def _is_ours(directory: Path) -> bool:
    """Whether a directory holds results, by its manifest or else by its parts."""
    try:
        if "fingerprint" in read_manifest(directory):
            return True
    except InputError:
        pass
    return _from_parts(directory) is not None


def named(directory: str | Path) -> Path:
    """The path of a results directory.

    Raises:
        InputError: the path is empty.
    """
    if not str(directory):
        raise InputError("the results directory must not be empty (use '.' for the current one)")
    return Path(directory)

"""Checks of a results directory before a job writes to it, and continuation of its results."""

from pathlib import Path

from sinsjax.errors import InputError
from sinsjax.execution.checks import refuse_external
from sinsjax.execution.directory import (
    DATASETS,
    MANIFEST,
    STUDY,
    Manifest,
    OtherVersionError,
    check_directory,
    read_manifest,
)
from sinsjax.execution.tasks import Job
from sinsjax.messages import shorten, to_one_line
from sinsjax.methods.registry import packages_of
from sinsjax.platform import runtime
from sinsjax.study.identity import describe_differences, fingerprint, with_draws
from sinsjax.study.study import Study


def check_available(directory: Path, *, overwrite: bool, resume: bool) -> None:
    """Reject a directory with foreign files, or with results that may not be used.

    Results are identified by their manifest; a foreign file of the same name is never touched.

    Args:
        directory: results directory, which may be missing.
        overwrite: whether results may be replaced.
        resume: whether results may be continued.

    Raises:
        InputError: the directory cannot be used.
    """
    check_directory(directory)
    names = (*DATASETS, "figures", STUDY)
    if not (directory / MANIFEST).exists():
        if existing := [name for name in names if (directory / name).exists()]:
            text = f"contains {existing[0]}, which is not a result (give another directory)"
            raise InputError(f"{directory}: {text}")
        return
    try:
        read_manifest(directory)
    except OtherVersionError:
        if not overwrite:
            raise
    if not (overwrite or resume):
        raise InputError(
            f"{directory}: already contains results (give --resume to continue them, or --overwrite"
            " to replace them; in Python resume=True or overwrite=True)"
        )


def continue_job(job: Job) -> Job:
    """Return the job as a continuation of the results in its directory, if there are any.

    It uses their runs per chunk and choice of curves. If it has more draws, it is marked as
    extended.

    Args:
        job: the job as requested now.

    Raises:
        InputError: the directory contains results of another study (names the keys that differ), of
            another record or version, or with other chunks.
    """
    directory, study = job.directory, job.study
    assert directory is not None
    manifest = Manifest.find(directory)
    if manifest is None:
        return job
    refuse_external(manifest.external, directory)
    ends = {*manifest.extended_at}
    if manifest.fingerprint != fingerprint(study):
        ends.add(_draws_before_extension(directory, manifest, study))
    if job.chunk_runs not in (None, manifest.chunk_runs):
        raise InputError(
            f"{directory}: chunk_runs: {job.chunk_runs} requested, but its results were begun with"
            f" {manifest.chunk_runs or 'the default'} (--resume keeps that: leave --chunk-runs out)"
        )
    _check_versions(directory, manifest, study)
    job = job._replace(
        curves=manifest.curves, chunk_runs=manifest.chunk_runs, extended_at=tuple(sorted(ends))
    )
    if manifest.identity != job.identity:
        raise InputError(f"{directory}: contains results of another record or reference")
    return job


def _draws_before_extension(directory: Path, manifest: Manifest, study: Study) -> int:
    """Return the number of stored draws, to which a study only adds more; refuse other studies."""
    stored, draws = manifest.draws, study.study.draws
    only_draws = (
        stored is not None
        and draws is not None
        and fingerprint(with_draws(study, stored)) == manifest.fingerprint
    )
    if not only_draws or stored is None or draws is None or draws < stored:
        text = "; ".join(describe_differences(manifest.study, study))
        if only_draws:
            text += f" (draws can be added, not removed: continue with --draws {stored})"
        raise InputError(f"{directory}: contains results of another study: {to_one_line(text)}")
    for key, law in (study.drawn.laws if study.drawn else {}).items():
        # A list with an entry for every draw would begin again, which is hardly intended.
        if law.values and len(law.values) == stored > 1:
            raise InputError(
                f"{directory}: [drawn] {key}.values: ends with the {stored} existing draws"
                " (give another directory to begin it again)"
            )
    return stored


def check_instruction_set(directory: Path, current: str) -> None:
    """Reject rows of another instruction set: last bits differ, and the differences grow.

    Args:
        directory: results directory.
        current: instruction set that will compute the missing rows.

    Raises:
        InputError: names both instruction sets.
    """
    manifest = Manifest.find(directory)
    stored = manifest and manifest.instructions
    if stored and stored != current:
        stored = shorten(to_one_line(stored))
        raise InputError(
            f"{directory}: was computed with instruction set {stored}, but here is {current}"
            f" (use a machine with that one, XLA_FLAGS=--xla_cpu_max_isa={stored} on a larger one,"
            " or --overwrite)"
        )


def _check_versions(directory: Path, manifest: Manifest, study: Study) -> None:
    """Reject rows of other versions, including packages that provide methods: bits may differ."""
    current = runtime.relevant_versions()
    for name in (*runtime.RESULT_PACKAGES, *packages_of(study.methods)):
        stored = manifest.versions.get(name, current[name])
        if stored != current[name]:
            raise InputError(
                f"{directory}: was computed with {name} {shorten(to_one_line(stored))}, but here is"
                f" {current[name]} (install that one, or give --overwrite)"
            )

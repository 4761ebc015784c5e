"""What is said of workers and a scheduler that come and go, without any."""

import io
import json
import logging
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import dask
import distributed
import pytest
import tomli_w
from support.studies import BASE, small_study

from sinsjax.cli import study as studies
from sinsjax.errors import InputError
from sinsjax.execution import dask_client, dask_pool, run
from sinsjax.execution.tasks import Executor


class Seen:
    """A client of a scheduler with these workers, or of none that answers."""

    def __init__(self, *workers: str) -> None:
        self.workers: tuple[str, ...] | None = workers

    def nthreads(self) -> dict[str, int]:
        if self.workers is None:
            raise OSError("Timed out\nand more")
        return dict.fromkeys(self.workers, 2)


def test_lost_workers_are_reported_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(dask_client, "CONNECT_S", 0.0)
    client = Seen("tcp://a:1", "tcp://b:1", "tcp://c:1")
    pool = dask_pool.DaskPool(client, "tcp://head:8786")

    def said(*workers: str) -> str:
        client.workers = workers
        if not pool._look():
            pool._alone(time.monotonic() - 1.0)
        return capsys.readouterr().err

    assert said("tcp://a:1", "tcp://b:1", "tcp://c:1") == ""
    assert said("tcp://a:1", "tcp://b:1") == (
        "Warning: tcp://c:1: worker lost, its tasks run again (2 left)\n"
    )
    assert said("tcp://a:1", "tcp://b:1", "tcp://d:1") == ""
    lost, waiting = said().splitlines()
    assert lost == "Warning: tcp://a:1 and 2 more: worker lost, its tasks run again (0 left)"
    assert waiting == (
        "Warning: tcp://head:8786: all workers have left (waiting up to 10 min; start one: dask"
        " worker tcp://head:8786)"
    )
    assert said() == ""


def test_scheduler_without_workers_waits_for_first_worker(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(dask_client, "CONNECT_S", 0.0)
    pool = dask_pool.DaskPool(Seen(), "tcp://head:8786")
    assert pool._look() == {}
    pool._alone(time.monotonic() - 1.0)
    assert capsys.readouterr().err.startswith(
        "Warning: tcp://head:8786: no workers yet (waiting up to"
    )


def test_lost_scheduler_raises_error_with_reason() -> None:
    client = Seen()
    client.workers = None
    with pytest.raises(InputError) as told:
        dask_pool.DaskPool(client, "tcp://head:8786")._look()
    assert str(told.value) == (
        "tcp://head:8786: lost the scheduler: Timed out (results so far are kept: the same again"
        " with --resume, in Python resume=True)"
    )


@pytest.mark.parametrize("configured", [False, True])
def test_only_default_dask_log_handler_is_silenced(configured: bool) -> None:
    """Not a handler of the user's, nor a log that the user has configured."""
    logger, streams = logging.getLogger("distributed.client"), (io.StringIO(), io.StringIO())
    assert distributed.__version__  # imported, or Dask knows no format of its log
    handlers = [logging.StreamHandler(stream) for stream in streams]
    handlers[0].setFormatter(logging.Formatter(dask.config.get("distributed.admin.log-format")))
    for handler in handlers:
        logger.addHandler(handler)
    try:
        chosen: dict[str, Any] = {"logging": {"distributed": "info"}} if configured else {}
        with dask.config.set(chosen), dask_client._log_off(dask):
            logger.error("within")
        logger.error("after")
    finally:
        for handler in handlers:
            logger.removeHandler(handler)
    dasks, users = (stream.getvalue() for stream in streams)
    assert ("within" in dasks) is configured and "after" in dasks
    assert users == "within\nafter\n"


def test_forecast_counts_worker_threads_and_remaining_runs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    config, out = tmp_path / "study.toml", tmp_path / "out"
    config.write_text(tomli_w.dumps(BASE))
    runs = (study := small_study()).n_draws * study.n_variants
    out.mkdir()
    (out / "manifest.json").write_text(json.dumps({"fingerprint": "", "runs_done": runs - 1}))
    executor = Executor(lambda runner, tasks: iter(()), {"threads": 24})
    monkeypatch.setattr(studies, "_executor", lambda *_: nullcontext(executor))
    monkeypatch.setattr(run, "run_into", lambda *_, **__: None)
    monkeypatch.setattr("sinsjax.report.summarise", lambda *_, **__: None)
    options: dict[str, Any] = {"overwrite": False, "devices": None, "curves": None, "resume": True}
    for cluster, on in (((None, "tcp://head:8786"), "24 worker threads"), ((1, None), "1 core")):
        studies.run_study(config, str(out), cluster=cluster, **options)
        (line,) = capsys.readouterr().out.splitlines()
        assert f", 1 left: roughly 1 s on {on}, " in line

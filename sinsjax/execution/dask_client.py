"""Dask clients of an existing scheduler, or of a local one with its own workers."""

import asyncio
import gc
import logging
import multiprocessing
import os
import signal
import socket
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from sinsjax.errors import InputError
from sinsjax.messages import first_line
from sinsjax.platform import affinity, runtime, xla

CONNECT_S = 10.0
"""Time allowed for a scheduler to answer, s."""

_CONFIG = {
    "distributed.worker.multiprocessing-method": "spawn",  # JAX does not survive a fork
    "distributed.admin.large-graph-warning-threshold": "1 GiB",  # a record, once per worker
}


@contextmanager
def connected(address: str) -> Iterator[Any]:
    """A client of an existing scheduler."""
    dask, distributed = _dask()
    with dask.config.set(_CONFIG), _log_off(dask):
        since = time.monotonic()
        try:
            _require_scheduler(address)
            left = max(1.0, since + CONNECT_S - time.monotonic())
            with warnings.catch_warnings():  # which versions decide, our own check tells
                warnings.simplefilter("ignore", distributed.versions.VersionMismatchWarning)
                client = distributed.Client(address, timeout=left, set_as_default=False)
        except Exception as error:  # any other service may answer at this address
            text = f"{address}: no Dask scheduler answers there ({_reason(error)})"
            raise InputError(text) from error
        with client:
            yield client


def _require_scheduler(address: str) -> None:
    """Check that a scheduler answers; a client would wait forever for any other service."""
    from distributed import Security, rpc
    from distributed.comm import addressing

    wait_s = 0.8 * CONNECT_S  # leaving the rest to the client

    scheme, location = addressing.parse_address(address)
    place = addressing.parse_host_port(location, 0) if scheme in ("tcp", "tls") else None

    async def ask() -> str:
        arguments = Security().get_connection_args("client")
        async with rpc(address, timeout=0.9 * wait_s, connection_args=arguments) as there:
            return (await there.identity())["type"]

    answers: list[str | BaseException] = []

    def within_time() -> None:
        try:
            if place:
                _resolve(place[0])
            answers.append(asyncio.run(asyncio.wait_for(ask(), wait_s)))
        except TimeoutError as error:
            answers.append(TimeoutError(first_line(error) or f"no answer in {wait_s:g} s"))
        except OSError as error:
            error.__cause__ = (_refusal(place) if place else None) or error.__cause__
            answers.append(error)
        except BaseException as error:
            answers.append(error)

    # In a thread, because a notebook already runs an event loop, and to limit the time if it hangs.
    asking = threading.Thread(target=within_time, daemon=True)
    asking.start()
    asking.join(CONNECT_S)
    kind = answers[0] if answers else TimeoutError(f"no answer in {wait_s:g} s")
    if isinstance(kind, BaseException):
        raise kind
    if kind != "Scheduler":
        raise ValueError(f"found a Dask {kind.lower()}")


def _resolve(host: str) -> None:
    """Look a host up: Dask would try again and again, and then only tell how long."""
    try:
        socket.getaddrinfo(host, None)
    except socket.gaierror as error:
        raise ValueError(f"host {host}: {error.strerror}") from None


def _refusal(place: tuple[str, int]) -> OSError | None:
    """What the system says of a connection: Dask has forgotten it if its last try was short."""
    try:
        socket.create_connection(place, 1.0).close()
    except OSError as error:
        return error
    return None


def _reason(error: BaseException) -> str:
    """An error's first line, and what the system said where that was the cause."""
    text, cause = first_line(error), error
    while cause.__cause__ is not None:
        cause = cause.__cause__
    said = cause.strerror if isinstance(cause, OSError) else None
    return f"{text}: {said}" if said and said not in text else text


@contextmanager
def _log_off(dask: Any) -> Iterator[None]:
    """Silence the handler that Dask gives its loggers when nobody else configures them.

    What it would print, with a traceback, is told in one line. Handlers of the user's, and a log
    that the user has configured for Dask, stay as they are.
    """
    config = dask.config.config
    if {"logging", "logging-file-config"} & {*config, *config.get("distributed", {})}:
        yield
        return
    form = dask.config.get("distributed.admin.log-format")
    loggers = map(logging.getLogger, ("distributed", "distributed.client"))
    default = [
        handler
        for handler in dict.fromkeys(h for logger in loggers for h in logger.handlers)
        if type(handler) is logging.StreamHandler
        and handler.formatter is not None
        and handler.formatter._fmt == form
    ]
    for handler in default:
        handler.addFilter(_nothing)
    try:
        yield
    finally:
        for handler in default:
            handler.removeFilter(_nothing)


def _nothing(record: logging.LogRecord) -> bool:
    return False


@contextmanager
def local(workers: int) -> Iterator[Any]:
    """A client of a scheduler in this process, with child processes as workers."""
    dask, distributed = _dask()
    cores = runtime.usable_cores()
    if workers > cores:
        raise InputError(f"workers: {workers} exceeds the {cores} available cores")
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(_CONFIG))
        stack.enter_context(_log_off(dask))
        stack.enter_context(_environment(_for_workers()))
        with _signals_blocked(), _collector_off():
            cluster = stack.enter_context(
                distributed.LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    processes=True,
                    memory_limit=0,
                    dashboard_address=None,
                    scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
                    preload=["sinsjax.execution.dask_worker"],
                    silence_logs=logging.ERROR,
                )
            )
            client = stack.enter_context(distributed.Client(cluster, set_as_default=False))
        yield client


def _dask() -> tuple[Any, Any]:
    try:
        import dask
        import distributed
    except ImportError:
        raise InputError(
            '--workers and --scheduler need Dask: pip install "sinsjax[cluster]"'
        ) from None
    return dask, distributed


def _for_workers() -> dict[str, str]:
    """Environment variables for worker processes, which read them before importing JAX."""
    return {
        affinity.VARIABLE: "1",
        "XLA_FLAGS": xla.extended_flags(),
        xla.OPT_OUT: "0",  # the flags are final; warnings are not repeated
        "JAX_PLATFORMS": os.environ.get("JAX_PLATFORMS", "cpu"),
    }


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Set variables for this process and its children while workers may be restarted."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def _collector_off() -> Iterator[None]:
    """Disable garbage collection, since a collection breaks Dask while it installs its hooks."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


@contextmanager
def _signals_blocked() -> Iterator[None]:
    """Block Ctrl-C and SIGTERM in threads started here, and in the processes they start.

    A terminal sends Ctrl-C, and a batch system SIGTERM, to all processes; only the main process
    should handle them, and it lets the workers finish.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # The first lock starts Python's resource tracker, which would unblock the signals.
    multiprocessing.get_context("spawn").Lock()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)

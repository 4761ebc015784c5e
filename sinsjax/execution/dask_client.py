"""Dask clients: of a scheduler that others started, or of one here with workers of its own."""

import asyncio
import gc
import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from sinsjax.errors import InputError
from sinsjax.messages import first_line
from sinsjax.platform import affinity, runtime, xla

CONNECT_S = 10.0
"""Within this time a scheduler has answered, or there is none."""

_CONFIG = {
    "distributed.worker.multiprocessing-method": "spawn",  # jax does not survive a fork
    "distributed.admin.large-graph-warning-threshold": "1 GiB",  # a record, once a worker
}


@contextmanager
def connected(address: str) -> Iterator[Any]:
    """A client of a scheduler that is there."""
    dask, distributed = _dask()
    with dask.config.set(_CONFIG):
        since = time.monotonic()
        try:
            _require_scheduler(address)
            left = max(1.0, since + CONNECT_S - time.monotonic())
            client = distributed.Client(address, timeout=left, set_as_default=False)
        except Exception as error:  # whatever else may answer there
            text = f"{address}: no Dask scheduler answers there ({first_line(error)})"
            raise InputError(text) from error
        with client:
            yield client


def _require_scheduler(address: str) -> None:
    """Ask who is there; a client would wait for ever for one that listens and is no scheduler."""
    from distributed import Security, rpc

    wait_s = 0.8 * CONNECT_S  # a client has the rest

    async def ask() -> str:
        arguments = Security().get_connection_args("client")
        async with rpc(address, timeout=0.9 * wait_s, connection_args=arguments) as there:
            return (await there.identity())["type"]

    said: list[str | BaseException] = []

    def within_time() -> None:
        try:
            said.append(asyncio.run(asyncio.wait_for(ask(), wait_s)))
        except TimeoutError as error:
            said.append(TimeoutError(first_line(error) or f"nothing in {wait_s:g} s"))
        except BaseException as error:
            said.append(error)

    # In a thread: a notebook has a loop of its own, and whatever blocks this one holds up no more.
    asking = threading.Thread(target=within_time, daemon=True)
    asking.start()
    asking.join(CONNECT_S)
    who = said[0] if said else TimeoutError(f"nothing in {wait_s:g} s")
    if isinstance(who, BaseException):
        raise who
    if who != "Scheduler":
        raise ValueError(f"but a Dask {who.lower()}")


@contextmanager
def local(workers: int) -> Iterator[Any]:
    """A client of a scheduler in this process, and of workers that are its children."""
    dask, distributed = _dask()
    cores = runtime.usable_cores()
    if workers > cores:
        raise InputError(f"--workers: {workers} exceeds the {cores} available cores")
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(_CONFIG))
        stack.enter_context(_environment(_for_workers()))
        with _signals_kept_away(), _collector_off():
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
    """The environment that worker processes take over, read before they import jax."""
    flags = os.environ.get("XLA_FLAGS", "")
    if not (xla.opted_out() or xla.names_a_file(flags)):
        refused = xla.refused_flags(runtime.versions()["jaxlib"])
        flags = xla.merge_options(flags, refused, xla.wanted())
    return {
        affinity.VARIABLE: "1",
        "XLA_FLAGS": flags,
        xla.OPT_OUT: "0",  # the flags stand; nothing is warned of a second time
        "JAX_PLATFORMS": os.environ.get("JAX_PLATFORMS", "cpu"),
    }


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Variables set for this process and its children, as long as workers may be started again."""
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
    """No garbage collection: Dask hooks into it as it starts, and one under way would trip it."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


@contextmanager
def _signals_kept_away() -> Iterator[None]:
    """Threads started here, and the processes that those start, get no Ctrl-C and no SIGTERM.

    A terminal sends Ctrl-C to all processes, a batch system SIGTERM: they are for the process that
    asked, which lets the workers finish.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # The first lock starts Python's resource tracker, which would open the mask again.
    multiprocessing.get_context("spawn").Lock()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)

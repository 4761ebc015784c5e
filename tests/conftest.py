"""Settings of the whole test run; JAX reads some of them once, so they come first."""

import atexit
import gc
import os
import shutil
import tempfile

os.environ["MPLBACKEND"] = "Agg"
# Tables in a pipe are as wide as that says, and pytest-xdist's workers have it.
os.environ.pop("COLUMNS", None)
# Products of small matrices: more threads of OpenBLAS only wait, each at the cost of a core.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# What one process compiles, xdist's others and those that tests start take from it; the folder
# begins empty and ends with the process that made it.
if "SINSJAX_COMPILE_CACHE" not in os.environ:
    os.environ["SINSJAX_COMPILE_CACHE"] = tempfile.mkdtemp(prefix="sinsjax-tests-")
    atexit.register(shutil.rmtree, os.environ["SINSJAX_COMPILE_CACHE"], ignore_errors=True)

from pathlib import Path

import hypothesis
import jax
import pytest
from support import type_checks

type_checks.install("sinsjax")

from support import compilation  # noqa: E402  (imports what is to be checked)

from sinsjax.platform import runtime  # noqa: E402

runtime.configure(devices=2, x64=True)
compilation.install()
jax.config.update("jax_legacy_prng_key", "error")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Tracing makes many objects that stay; looking through them for garbage took a fifth of its time.
gc.set_threshold(100_000, 20, 50)

hypothesis.settings.register_profile("sinsjax", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.load_profile("sinsjax")


def pytest_configure(config: pytest.Config) -> None:
    """A program that another process is just writing is compiled here instead; JAX warns of it."""
    line = "ignore:Error reading persistent compilation cache entry:UserWarning"
    config.addinivalue_line("filterwarnings", line)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """One level of optimisation after the other: to change it drops what is compiled."""
    items.sort(key=compilation.least)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Before any fixture, which may compile."""
    compilation.suit(item)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of recorded data: ``SINSJAX_DATA``, or ``shared/data`` beside the repository."""
    given = os.environ.get("SINSJAX_DATA")
    folder = Path(given) if given else Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no recorded data: {folder} is no folder (set SINSJAX_DATA)")
    return folder


@pytest.fixture
def drawn():
    """Has a test lay its figures out, which takes most of a report's time."""


@pytest.fixture
def drawn_on_request(request, monkeypatch):
    """Lays no figure out but for a test that asks for `drawn`."""
    if "drawn" not in request.fixturenames:
        monkeypatch.setattr("sinsjax.plots.png", lambda *_: b"not drawn")

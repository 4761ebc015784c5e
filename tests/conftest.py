"""Settings of the whole test run; JAX reads some of them once, so they come first."""

import gc
import os

os.environ["MPLBACKEND"] = "Agg"
# Tables in a pipe are as wide as that says, and pytest-xdist's workers have it.
os.environ.pop("COLUMNS", None)
# Products of small matrices: more threads of OpenBLAS only wait, each at the cost of a core.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
from pathlib import Path

import hypothesis
import jax
import pytest
from support import tiers, type_checks

type_checks.install("sinsjax")

from support import compilation  # noqa: E402  (imports what is to be checked)

from sinsjax.methods.registry import METHODS  # noqa: E402
from sinsjax.platform import runtime  # noqa: E402

compilation.share_cache(Path(__file__).parents[1])
runtime.configure(devices=2)
compilation.install_spared_options()
jax.config.update("jax_legacy_prng_key", "error")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Tracing makes many objects that stay; looking through them for garbage took a fifth of its time.
gc.set_threshold(100_000, 20, 50)

hypothesis.settings.register_profile("sinsjax", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.load_profile("sinsjax")


def pytest_configure(config: pytest.Config) -> None:
    """Ignore three warnings; all others are errors."""
    # Doubts about a study are not what most tests are about; some expect them by `pytest.warns`.
    config.addinivalue_line("filterwarnings", "ignore::sinsjax.errors.StudyWarning")
    # A program that another process is just writing is compiled here instead.
    line = "ignore:Error reading persistent compilation cache entry:UserWarning"
    config.addinivalue_line("filterwarnings", line)
    # A false alarm from Python 3.14 on, where references are counted otherwise.
    line = "ignore:It looks like `register_random` was passed"
    config.addinivalue_line("filterwarnings", line)


@pytest.hookimpl(tryfirst=True)  # before tests are deselected by their markers
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Sort tests by level of optimisation, a change of which drops all programs; set the tiers."""
    items.sort(key=compilation.has_least_optimisation)
    tiers.keep_fast_cases(items, whole_files=not any("::" in name for name in config.args))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Before any fixture, which may compile."""
    compilation.set_optimisation_level(item)


@pytest.hookimpl(trylast=True)  # after fixtures are gone
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Drop compiled programs after a module that leaves many, or a test that leaves more.

    Programs outside sinsjax whose results a module has scored are no methods of the next one.
    """
    ends_module = nextitem is None or nextitem.path != item.path
    if ends_module:
        for name in [name for name, method in METHODS.items() if method.is_external]:
            del METHODS[name]
    compilation.drop_programs_above(
        compilation.LARGE_BYTES if ends_module else compilation.LARGEST_BYTES
    )


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of recorded data: ``SINSJAX_DATA``, or ``shared/data`` beside the repository."""
    given = os.environ.get("SINSJAX_DATA")
    folder = Path(given) if given else Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no recorded data: {folder} is no folder (set SINSJAX_DATA)")
    return folder


@pytest.fixture
def sinsjax(monkeypatch, capsys, tmp_path):
    """Runs a command line in this process, in an empty folder: exit code, output, error output."""
    from support.commands import command_line  # and all that the command line imports

    monkeypatch.chdir(tmp_path)
    return command_line(monkeypatch, capsys)


@pytest.fixture
def drawn():
    """Has a test lay its figures out, which takes most of a report's time."""


@pytest.fixture
def drawn_on_request(request, monkeypatch):
    """Lays no figure out but for a test that asks for `drawn`."""
    if "drawn" not in request.fixturenames:
        monkeypatch.setattr("sinsjax.plots.render_png", lambda *_: b"not drawn")

"""Imports point down the floors only, folder by folder; read from the source, nothing is run."""

import ast
import graphlib
from functools import cache
from pathlib import Path

import pytest

import sinsjax

FLOORS = (
    {"console", "errors", "messages", "types", "units"},
    {"analysis", "columns", "maths", "platform"},
    {"plots", "records", "strapdown", "value_types"},
    {"methods"},
    {"study"},
    {"engine"},
    {"covariance"},
    {"bench", "execution"},
    {"advice", "arena", "tuning"},
    {"report"},
    {"__main__", "cli"},
)
"""The ground floor first. A folder stands for all of its modules."""

FLOOR = {name: floor for floor, names in enumerate(FLOORS) for name in names}
METHODS = {
    f"methods.{path.parent.name}"
    for path in Path(sinsjax.__file__).parent.glob("methods/*/method.py")
}
"""Folders of alignment methods; no method knows another."""
KNOW_METHODS = {"methods.registry", "methods.page", "methods.sections"}
"""What in `methods` may know the methods' folders."""
WITHOUT_JAX = {"columns", "errors", "messages", "records", "study", "units", "value_types"}
SAYS_KEYS = {"config", "description", "registry", "section", "sections"}
"""Modules of `methods` that studies are read with."""
FOR_PEOPLE = {"matplotlib", "rich", "typer"}
MEETS_PEOPLE = {"advice", "bench", "cli", "console", "execution", "plots", "report", "tuning"}
JAX = {"jax", "jaxlib", "optax"}

Sources = dict[str, str]


def read_sources() -> Sources:
    """The source of every module by dotted name below `sinsjax`; the package itself is exempt."""
    root = Path(sinsjax.__file__).parent
    sources = {}
    for path in sorted(root.rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        sources[name] = path.read_text(encoding="utf-8")
    sources.pop("")
    return sources


def imported(
    name: str, source: str, sources: Sources, *, later: bool = True
) -> tuple[set[str], set[str]]:
    """What a module imports: modules of the package, and others' top-level names.

    The package itself is the module ``""``. Without ``later``, what functions import when they are
    called is left out.
    """
    found: list[str] = []
    for node in import_statements(source, later=later):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        else:
            assert node.level == 0, f"{name}: line {node.lineno}: write imports in full"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                is_module = whole.removeprefix("sinsjax.") in sources
                found.append(whole if is_module else str(node.module))
    own, others = set(), set()
    for path in found:
        top, _, rest = path.partition(".")
        if top == "sinsjax":
            own.add(rest)
        else:
            others.add(top)
    return own, others


@cache
def import_statements(source: str, *, later: bool) -> list[ast.Import | ast.ImportFrom]:
    """The imports of a source, those in functions' bodies if ``later``."""
    nodes = walk(ast.parse(source), later=later)
    return [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]


def walk(node: ast.AST, *, later: bool) -> list[ast.AST]:
    """All nodes below one, those in functions' bodies if ``later``."""
    if not later and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
        return []
    below = [walk(child, later=later) for child in ast.iter_child_nodes(node)]
    return [node, *(found for nodes in below for found in nodes)]


def loaded(name: str, sources: Sources) -> set[str]:
    """What importing a module loads from outside the package, through all that it imports.

    The packages that a module lies in are loaded with it, but for `sinsjax` itself.
    """
    others: set[str] = set()
    done: set[str] = set()
    left = [name]
    while left:
        module = left.pop()
        if module in done or module not in sources:
            continue
        done.add(module)
        own, outside = imported(module, sources[module], sources, later=False)
        others |= outside
        left += own
        left.append(module.rpartition(".")[0])
    return others


def floor(name: str) -> int | None:
    """The floor of a module of the package; None if the table lacks it."""
    return FLOOR.get(folder(name))


def folder(name: str) -> str:
    """What of the table a module belongs to."""
    return name.partition(".")[0]


def method_of(name: str) -> str | None:
    """The folder of the method that a module belongs to."""
    return next((m for m in METHODS if name == m or name.startswith(f"{m}.")), None)


def is_without_jax(name: str) -> bool:
    """Whether a module reads input: it, and all that it imports, does without JAX."""
    return folder(name) in WITHOUT_JAX or name.rpartition(".")[2] in SAYS_KEYS


def violations(sources: Sources) -> list[str]:
    """One line for every module or import that breaks the floors."""
    wrong = []
    graph: dict[str, set[str]] = {}
    for name, source in sources.items():
        if floor(name) is None:
            wrong.append(f"{name} is on no floor: add it to FLOORS in {Path(__file__).name}")
            continue
        own, others = imported(name, source, sources)
        graph[name] = {other for other in own if other in sources}
        if "" in own:
            wrong.append(f"{name} imports from the package itself a name that is no module")
        wrong += [
            f"{name} (floor {floor(name)}) imports {other} (floor {floor(other)})"
            for other in sorted(graph[name])
            if (floor(other) or 0) > floor(name)
        ]
        if folder(name) == "methods" and name not in KNOW_METHODS:
            wrong += [
                f"{name} imports {other}: no method knows another"
                for other in sorted(graph[name] - {name})
                if other in KNOW_METHODS or method_of(other) not in (None, method_of(name))
            ]
        if is_without_jax(name) and loaded(name, sources) & JAX:
            wrong.append(f"{name} reads input, but importing it loads jax")
        if folder(name) not in MEETS_PEOPLE and others & FOR_PEOPLE:
            wrong.append(f"{name} must not import {sorted(others & FOR_PEOPLE)}")
    by_folder: dict[str, set[str]] = {}
    for name, others in graph.items():
        by_folder.setdefault(folder(name), set()).update(set(map(folder, others)) - {folder(name)})
    for arrows, of in ((graph, ""), (by_folder, " of folders")):
        try:
            graphlib.TopologicalSorter(arrows).prepare()
        except graphlib.CycleError as error:
            wrong.append(f"cycle{of}: " + " -> ".join(error.args[1]))
    return wrong


def test_imports_reach_only_same_or_lower_floors():
    assert not violations(read_sources())


BY_NAME = {"cli", "cli.running", "report.study_page"}
"""Modules that import others by name: with JAX in them, when a command needs them, or a page's."""


def test_no_other_modules_are_imported_by_name():
    """Such imports are arrows that the cycles above would not show."""
    found = {name for name, source in read_sources().items() if "import_module(" in source}
    assert found == BY_NAME


def test_method_package_init_files_import_nothing():
    """Else importing a section would load every method, and JAX."""
    for name in ("methods", *METHODS, "methods.triggers"):
        tree = ast.parse(read_sources()[name])
        assert [type(node) for node in tree.body] == [ast.Expr], name


def test_package_has_py_typed_marker():
    """Type checkers look for the marker of PEP 561 beside the modules."""
    assert (Path(sinsjax.__file__).parent / "py.typed").is_file()


def test_read_sources_includes_packages_and_modules():
    assert {"types", "platform.runtime", "methods", "methods.base"} <= read_sources().keys()


def test_every_folder_has_docstring():
    """In one sentence, for whoever reads the list of folders."""
    sources = read_sources()
    folders = {name.rpartition(".")[0] for name in sources} - {""}
    assert all(ast.get_docstring(ast.parse(sources[name])) for name in folders)


@pytest.mark.parametrize(
    ("sources", "message"),
    [
        ({"novel": ""}, "novel is on no floor"),
        ({"novel.part": ""}, "novel.part is on no floor"),
        (
            {"units": "from sinsjax.maths import rng", "maths.rng": ""},
            "units (floor 0) imports maths.rng",
        ),
        ({"units": "import sinsjax.maths.rng", "maths.rng": ""}, "units (floor 0) imports maths"),
        (
            {"units": "def f():\n    from sinsjax.maths.rng import pair", "maths.rng": ""},
            "units (floor 0) imports maths.rng",
        ),
        ({"engine.batch": "from sinsjax import __version__"}, "engine.batch imports from the"),
        (
            {
                "maths.algebra": "from sinsjax.maths import rng",
                "maths.rng": "import sinsjax.maths.algebra",
            },
            "cycle: ",
        ),
        (
            {
                "maths.algebra": "from sinsjax.platform import machine",
                "maths.rng": "",
                "platform.files": "from sinsjax.maths import rng",
                "platform.machine": "",
            },
            "cycle of folders: ",
        ),
        (
            {
                "methods.compass.method": "from sinsjax.methods.zero_velocity.method import x",
                "methods.zero_velocity.method": "",
            },
            "methods.compass.method imports methods.zero_velocity.method: no method knows",
        ),
        (
            {
                "methods.compass.method": "from sinsjax.methods.registry import METHODS",
                "methods.registry": "",
            },
            "methods.compass.method imports methods.registry: no method knows",
        ),
        (
            {
                "methods.kalman": "from sinsjax.methods.compass import design",
                "methods.compass.design": "",
            },
            "methods.kalman imports methods.compass.design: no method knows",
        ),
        ({"study.load": "import jax.numpy as jnp"}, "study.load reads input, but importing it"),
        ({"records.psins": "from jax import jit"}, "records.psins reads input"),
        (
            {
                "study.schema": "from sinsjax.methods.sections import AlignmentSection",
                "methods": "from sinsjax.methods import base",
                "methods.base": "import jax",
                "methods.sections": "",
            },
            "study.schema reads input, but importing it loads jax",
        ),
        (
            {
                "methods.compass.config": "from sinsjax.maths import algebra",
                "maths.algebra": "from sinsjax.maths import rng",
                "maths.rng": "import jaxlib",
            },
            "methods.compass.config reads input, but importing it loads jax",
        ),
        ({"engine.simulate": "import matplotlib.pyplot"}, "engine.simulate must not import"),
    ],
)
def test_broken_layer_rules_are_reported(sources, message):
    assert any(line.startswith(message) for line in violations(sources))


def test_relative_imports_are_refused():
    with pytest.raises(AssertionError, match="maths.rng: line 1: write imports in full"):
        violations({"maths.rng": "from . import algebra"})


def test_allowed_imports_are_not_reported():
    assert not violations(
        {
            "units": "import math",
            "maths.rng": "import jax\nfrom sinsjax.units import DEG",
            "methods.base": "from sinsjax.maths import rng",
            "methods.compass.method": "from sinsjax.methods.base import Method",
            "methods.compass.config": "def f():\n    import jax",
            "methods.registry": "from sinsjax.methods.compass import config",
            "plots": "import matplotlib",
        }
    )

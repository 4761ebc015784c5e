"""Imports point up the list of layers only; read from the source, nothing is imported."""

import ast
import graphlib
from pathlib import Path

import pytest

import sinsjax

LAYERS = (
    {
        "affinity",
        "columns",
        "compile_cache",
        "files",
        "hlo",
        "machine",
        "runtime",
        "types",
        "units",
        "xla",
        "xla_trial",
    },
    {
        "config",
        "designs",
        "drawing",
        "fields",
        "layouts",
        "ranges",
        "records",
        "rules",
        "sections",
        "studies",
        "success",
        "sweeps",
        "tuned_keys",
        "unreached",
        "usual",
        "variables",
        "wording",
    },
    {"algebra", "earth", "kalman", "randomness", "rotations"},
    {"bounds", "error_model", "imu", "limits", "loops", "mechanisation", "trajectory"},
    {"alignment"},
    {
        "batch",
        "doubts",
        "draws",
        "metrics",
        "scenario",
        "simulate",
        "stepping",
        "study_limits",
        "tunings",
        "verdicts",
        "worlds",
    },
    {
        "analysis",
        "belongings",
        "directories",
        "forecast",
        "parts",
        "plots",
        "results",
        "statements",
        "stopping",
        "store",
        "work",
    },
    {
        "__main__",
        "baseline",
        "bench",
        "campaign",
        "cli",
        "clients",
        "cluster",
        "console",
        "report",
        "reruns",
        "screen",
        "tuning",
        "worker",
    },
)
"""Level 0 first. A package stands for all of its modules."""

LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}
SHARED_BY_METHODS = {
    "alignment.base",
    "alignment.schedules",
    "alignment.triggers",
    "alignment.scores",
}
NOT_METHODS = SHARED_BY_METHODS | {"alignment", "alignment.coarse", "alignment.reverse"}
WITHOUT_JAX = LAYERS[1]
FOR_PEOPLE = {"matplotlib", "rich", "typer"}

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


def imported(name: str, source: str, sources: Sources) -> tuple[set[str], set[str]]:
    """What a module imports anywhere in it: modules of the package, and others' top-level names.

    The package itself is the module ``""``.
    """
    found: list[str] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
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


def level(name: str) -> int | None:
    """The level of a module of the package; None if the table lacks it."""
    return LEVEL.get(name.partition(".")[0])


def violations(sources: Sources) -> list[str]:
    """One line for every module or import that breaks the layers."""
    wrong = []
    graph: dict[str, set[str]] = {}
    for name, source in sources.items():
        if level(name) is None:
            wrong.append(f"{name} is in no layer: add it to LAYERS in {Path(__file__).name}")
            continue
        own, others = imported(name, source, sources)
        graph[name] = {other for other in own if other in sources}
        if "" in own:
            wrong.append(f"{name} imports from the package itself a name that is no module")
        wrong += [
            f"{name} (level {level(name)}) imports {other} (level {level(other)})"
            for other in sorted(graph[name])
            if (level(other) or 0) > level(name)
        ]
        if name.startswith("alignment.") and name not in NOT_METHODS:
            wrong += [
                f"{name} imports {other}: a method may share only {sorted(SHARED_BY_METHODS)}"
                for other in sorted(own - SHARED_BY_METHODS)
                if other.partition(".")[0] == "alignment"
            ]
        if name.partition(".")[0] in WITHOUT_JAX and others & {"jax", "jaxlib", "optax"}:
            wrong.append(f"{name} reads input and must not import jax")
        if level(name) <= 5 and others & FOR_PEOPLE:
            wrong.append(f"{name} must not import {sorted(others & FOR_PEOPLE)}")
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        wrong.append("cycle: " + " -> ".join(error.args[1]))
    return wrong


def test_imports_point_up_the_list_of_layers():
    assert not violations(read_sources())


def test_others_may_check_their_types_against_the_package():
    """Type checkers look for the marker of PEP 561 beside the modules."""
    assert (Path(sinsjax.__file__).parent / "py.typed").is_file()


def test_every_source_file_is_read():
    assert {"types", "runtime", "alignment", "alignment.base"} <= read_sources().keys()


@pytest.mark.parametrize(
    ("sources", "message"),
    [
        ({"novel": ""}, "novel is in no layer"),
        ({"units": "from sinsjax import kalman", "kalman": ""}, "units (level 0) imports kalman"),
        ({"units": "import sinsjax.kalman", "kalman": ""}, "units (level 0) imports kalman"),
        (
            {"units": "def f():\n    from sinsjax.kalman import predict", "kalman": ""},
            "units (level 0) imports kalman",
        ),
        ({"batch": "from sinsjax import __version__"}, "batch imports from the package itself"),
        (
            {"earth": "from sinsjax import kalman", "kalman": "import sinsjax.earth"},
            "cycle: ",
        ),
        (
            {"alignment.a": "from sinsjax.alignment.b import step", "alignment.b": ""},
            "alignment.a imports alignment.b: a method may share only",
        ),
        (
            {"alignment.a": "from sinsjax.alignment import METHODS", "alignment": ""},
            "alignment.a imports alignment: a method may share only",
        ),
        ({"config": "import jax.numpy as jnp"}, "config reads input and must not import jax"),
        ({"records.psins": "from jax import jit"}, "records.psins reads input"),
        ({"simulate": "import matplotlib.pyplot"}, "simulate must not import ['matplotlib']"),
    ],
)
def test_a_broken_rule_is_told(sources, message):
    assert any(line.startswith(message) for line in violations(sources))


def test_a_relative_import_is_told():
    with pytest.raises(AssertionError, match="earth: line 1: write imports in full"):
        violations({"earth": "from . import kalman"})


def test_what_is_allowed_is_not_told():
    assert not violations(
        {
            "units": "import math",
            "kalman": "import jax\nfrom sinsjax.units import DEG",
            "alignment.base": "from sinsjax import kalman, units",
            "alignment.a": "from sinsjax.alignment.base import Method",
            "alignment": "from sinsjax.alignment import a",
            "plots": "import matplotlib",
        }
    )

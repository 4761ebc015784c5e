"""Imports point down the floors only, folder by folder, and on a floor to the left only."""

import ast
import graphlib
from pathlib import Path

# The ground floor first, a line each. A folder stands for all of its modules.
FLOORS = """messages errors types units
analysis columns maths platform
plots records strapdown value_types
methods
study
engine
bounds
execution
advice arena tuning
report
cli __main__"""
PLACE = {name: place for place, name in enumerate(FLOORS.split())}
MEETS_PEOPLE = {"advice", "cli", "execution", "messages", "plots", "report", "tuning"}


def imported(path: Path) -> set[str]:
    """All that a file imports, at any depth: dotted names, the last of which may be no module."""
    nodes = [*ast.walk(ast.parse(path.read_text(encoding="utf-8")))]
    plain = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    froms = [node for node in nodes if isinstance(node, ast.ImportFrom)]
    return plain | {f"{node.module}.{alias.name}" for node in froms for alias in node.names}


ROOT = Path(__file__).parents[1] / "sinsjax"
PATHS = {".".join(p.relative_to(ROOT).with_suffix("").parts): p for p in ROOT.rglob("*.py")}
IMPORTS = {name.removesuffix(".__init__"): imported(path) for name, path in PATHS.items()}
del IMPORTS["__init__"]  # the package itself, which offers names of all floors
OWN = {m: {n[8:] for n in names if n.startswith("sinsjax.")} for m, names in IMPORTS.items()}
GRAPH = {m: {n if n in OWN else n.rpartition(".")[0] for n in names} for m, names in OWN.items()}


def folder(name: str) -> str:
    return name.partition(".")[0]


def test_imports_point_down_the_floors_and_not_in_circles():
    edges = {(folder(name), folder(other)) for name, others in GRAPH.items() for other in others}
    assert set(map(folder, GRAPH)) == PLACE.keys()
    assert not [(above, below) for above, below in edges if PLACE[below] > PLACE[above]]
    graphlib.TopologicalSorter(GRAPH).prepare()  # a circle is an error


def test_methods_know_no_other_method_and_the_engine_knows_studies_in_one_module():
    methods = {m for m in GRAPH["methods.registry"] if folder(m) == "methods"} - {"methods.method"}
    assert not [name for name in methods if GRAPH[name] & methods - {name}]
    engine = {name for name in GRAPH if folder(name) == "engine"}
    assert {n for n in engine if "study" in map(folder, GRAPH[n])} == {"engine.scenario"}


def test_libraries_for_people_are_imported_by_what_meets_them():
    people = {"matplotlib", "rich", "typer"}
    found = [name for name, names in IMPORTS.items() if people & set(map(folder, names))]
    assert set(map(folder, found)) <= MEETS_PEOPLE

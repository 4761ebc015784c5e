"""Imports point down the floors only, folder by folder; read from the source."""

import ast
import graphlib
from pathlib import Path

import sinsjax

FLOORS = (
    {"errors", "messages", "types", "units"},
    {"analysis", "columns", "maths", "platform"},
    {"plots", "records", "strapdown", "value_types"},
    {"methods"},
    {"study"},
    {"engine"},
    {"bounds"},
    {"execution"},
    {"advice", "arena", "tuning"},
    {"report"},
    {"__main__", "cli"},
)
"""The ground floor first. A folder stands for all of its modules."""
FLOOR = {name: floor for floor, names in enumerate(FLOORS) for name in names}
MEETS_PEOPLE = {"advice", "cli", "execution", "messages", "plots", "report", "tuning"}


def imported(path: Path) -> set[str]:
    """All that a file imports, at any depth: dotted names, the last of which may be no module."""
    nodes = [*ast.walk(ast.parse(path.read_text(encoding="utf-8")))]
    plain = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    froms = [node for node in nodes if isinstance(node, ast.ImportFrom)]
    assert not any(node.level for node in froms), f"{path}: write imports in full"
    return plain | {f"{node.module}.{alias.name}" for node in froms for alias in node.names}


ROOT = Path(sinsjax.__file__).parent
PATHS = {".".join(p.relative_to(ROOT).with_suffix("").parts): p for p in ROOT.rglob("*.py")}
IMPORTS = {name.removesuffix(".__init__"): imported(path) for name, path in PATHS.items()}
del IMPORTS["__init__"]  # the package itself, which offers names of all floors
GRAPH: dict[str, set[str]] = {name: set() for name in IMPORTS}
for module, names in IMPORTS.items():
    own = {name.partition(".")[2] for name in names if name.startswith("sinsjax.")}
    GRAPH[module] = {name if name in IMPORTS else name.rpartition(".")[0] for name in own}


def folder(name: str) -> str:
    return name.partition(".")[0]


def test_imports_point_down_the_floors_and_not_in_circles():
    folders: dict[str, set[str]] = {}
    for name, own in GRAPH.items():
        assert all(FLOOR[folder(other)] <= FLOOR[folder(name)] for other in own), name
        folders.setdefault(folder(name), set()).update(set(map(folder, own)) - {folder(name)})
    assert folders.keys() == FLOOR.keys()
    graphlib.TopologicalSorter(GRAPH).prepare()  # a circle is an error
    graphlib.TopologicalSorter(folders).prepare()


def test_methods_know_no_other_method_and_the_engine_knows_studies_in_one_module():
    methods = {m for m in GRAPH["methods.registry"] if folder(m) == "methods"} - {"methods.method"}
    for name in methods:
        assert not GRAPH[name] & methods - {name}
    engine = {name for name in GRAPH if folder(name) == "engine"}
    assert {n for n in engine if "study" in map(folder, GRAPH[n])} == {"engine.scenario"}


def test_libraries_for_people_are_imported_by_what_meets_them():
    for name, found in IMPORTS.items():
        for_people = set(map(folder, found)) & {"matplotlib", "rich", "typer"}
        assert folder(name) in MEETS_PEOPLE or not for_people, name

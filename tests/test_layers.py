"""Imports point down the floors only, folder by folder; read from the source, nothing is run."""

import ast
import graphlib
from pathlib import Path

import sinsjax

FLOORS = (
    {"console", "errors", "gone", "messages", "types", "units"},
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
KNOW_METHODS = {"methods.registry"}
"""What in `methods` may know the methods."""
EXTENDS = {"methods.surge": "methods.sincos"}
"""A method that is another with more states."""
WITHOUT_JAX = set("columns errors gone messages records units value_types".split())
FOR_PEOPLE = {"matplotlib", "rich", "typer"}
MEETS_PEOPLE = {"advice", "cli", "console", "execution", "plots", "report", "tuning"}
JAX = {"jax", "jaxlib", "optax"}


def folder(name: str) -> str:
    return name.partition(".")[0]


def read_modules() -> dict[str, ast.Module]:
    """Every module by dotted name below `sinsjax`; the package itself is exempt."""
    root = Path(sinsjax.__file__).parent
    modules = {}
    for path in root.rglob("*.py"):
        parts = path.relative_to(root).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        modules[name] = ast.parse(path.read_text(encoding="utf-8"))
    modules.pop("")
    return modules


MODULES = read_modules()


def walk(node: ast.AST, *, later: bool) -> list[ast.AST]:
    """All nodes below one, those in functions' bodies if ``later``."""
    if not later and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
        return []
    below = [walk(child, later=later) for child in ast.iter_child_nodes(node)]
    return [node, *(found for nodes in below for found in nodes)]


def imported(name: str, *, later: bool = True) -> tuple[set[str], set[str]]:
    """The modules of the package and others' top-level names; ``later``: also when called."""
    found: list[str] = []
    for node in walk(MODULES[name], later=later):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: line {node.lineno}: write imports in full"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                is_module = whole.removeprefix("sinsjax.") in MODULES
                found.append(whole if is_module else str(node.module))
    own = {path.partition(".")[2] for path in found if path.partition(".")[0] == "sinsjax"}
    return own, {path.partition(".")[0] for path in found} - {"sinsjax"}


GRAPH = {name: imported(name)[0] for name in MODULES}
METHODS = {
    ".".join(name.split(".")[:2])
    for name in GRAPH["methods.registry"] - {"methods.method", "methods.plugins"}
    if folder(name) == "methods"
}
"""The alignment methods, each a module or a folder; no method knows another."""


def loaded(name: str) -> set[str]:
    """What importing a module loads from outside, through all that it imports and lies in."""
    others: set[str] = set()
    done, left = {""}, [name]
    while left:
        if (module := left.pop()) not in done:
            done.add(module)
            own, outside = imported(module, later=False)
            others |= outside
            left += [*own, module.rpartition(".")[0]]
    return others


def method_of(name: str) -> str | None:
    return next((m for m in METHODS if f"{name}.".startswith(f"{m}.")), None)


def test_every_module_is_on_a_floor_and_imports_no_higher_one():
    assert set(map(folder, MODULES)) == FLOOR.keys()
    for name, own in GRAPH.items():
        assert "" not in own, f"{name} imports from the package itself"
        higher = {other for other in own if FLOOR[folder(other)] > FLOOR[folder(name)]}
        assert not higher, name


def test_neither_modules_nor_folders_import_in_circles():
    folders: dict[str, set[str]] = {}
    for name, own in GRAPH.items():
        folders.setdefault(folder(name), set()).update(set(map(folder, own)) - {folder(name)})
    graphlib.TopologicalSorter(GRAPH).prepare()  # a circle is an error
    graphlib.TopologicalSorter(folders).prepare()


def test_no_method_knows_another():
    for name in MODULES:
        if folder(name) == "methods" and name not in KNOW_METHODS:
            others = {method_of(n) for n in GRAPH[name]} - {None, method_of(name)}
            known = others - {EXTENDS.get(name)}
            assert not known and not GRAPH[name] & KNOW_METHODS, name


def test_reading_input_loads_no_jax():
    for name in MODULES:
        if folder(name) in WITHOUT_JAX:
            assert not loaded(name) & JAX, name


def test_only_what_meets_people_imports_libraries_for_it():
    for name in MODULES:
        assert folder(name) in MEETS_PEOPLE or not imported(name)[1] & FOR_PEOPLE, name


def test_no_modules_are_imported_by_name():
    """Such imports are arrows that the circles above would not show."""
    assert not {name for name in MODULES if "import_module(" in ast.unparse(MODULES[name])}


def test_package_has_py_typed_marker():
    """Type checkers look for the marker of PEP 561 beside the modules."""
    assert (Path(sinsjax.__file__).parent / "py.typed").is_file()


def test_one_module_of_the_engine_knows_studies():
    engine = (name for name in MODULES if folder(name) == "engine")
    knowing = {name for name in engine if any(folder(other) == "study" for other in GRAPH[name])}
    assert knowing == {"engine.scenario"}

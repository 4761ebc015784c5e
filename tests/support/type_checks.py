"""Checks every call of a package against the annotations of its functions and methods.

By beartype alone: sinsjax annotates arrays as scalars, and thus has no sizes to compare between
arguments. jaxtyping's own hook does that, and took two thirds of the time of tests without JAX.
Functions within others are not checked: they are made, and would be decorated, at each call.
"""

import ast
import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import CodeType, ModuleType
from typing import Any

from beartype import beartype

CHECKED = "checked_by_beartype"


class _Decorated(ast.NodeTransformer):
    """Decorates functions below all other decorators.

    Annotations that are imported for static checkers alone are dropped.
    """

    def __init__(self) -> None:
        self._absent: set[str] = set()

    def visit_If(self, node: ast.If) -> ast.If:
        if ast.unparse(node.test) == "TYPE_CHECKING":
            imports = [line for line in node.body if isinstance(line, ast.ImportFrom)]
            self._absent |= {alias.asname or alias.name for line in imports for alias in line.names}
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        for owner, name in [(node, "returns"), *((arg, "annotation") for arg in node.args.args)]:
            if getattr(getattr(owner, name), "value", None) in self._absent:
                setattr(owner, name, None)
        node.decorator_list.append(ast.copy_location(ast.Name(CHECKED, ast.Load()), node))
        return node


class _Loader(SourceFileLoader):
    def source_to_code(
        self, data: Any, path: Any, fullname: str | None = None, *, _optimize: int = -1
    ) -> CodeType:  # Python 3.15 passes the name as well
        tree = _Decorated().visit(ast.parse(data))
        return compile(tree, path, "exec", dont_inherit=True, optimize=_optimize)

    def path_stats(self, path: str) -> Any:
        raise OSError("the bytecode beside the source has no checks")

    def exec_module(self, module: ModuleType) -> None:
        vars(module)[CHECKED] = beartype
        super().exec_module(module)


class _Finder(MetaPathFinder):
    def __init__(self, package: str) -> None:
        self._package = package

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name.partition(".")[0] != self._package:
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


def install(package: str) -> None:
    """Check the calls of a package that is yet to be imported."""
    assert package not in sys.modules
    sys.meta_path.insert(0, _Finder(package))

"""Checks every call of a package against the annotations of its functions and dataclasses.

By beartype alone: sinsjax annotates arrays as scalars, and thus has no sizes to compare between
arguments. jaxtyping's own hook does that, and took two thirds of the time of tests without JAX.
"""

import ast
import sys
from collections.abc import Sequence
from functools import update_wrapper
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import CodeType, FunctionType, ModuleType
from typing import Any

from beartype import beartype

CHECKED = "checked_by_beartype"

_WRAPPED = "__beartype_func"  # the keyword by which what beartype writes gets what it calls
_WRITTEN: dict[CodeType, FunctionType] = {}


def _checked(target: Any) -> Any:
    """Return a function or class whose calls are checked.

    A function within another is made at each call of that, but what checks it is written once.
    """
    if not isinstance(target, FunctionType) or "<locals>" not in target.__qualname__:
        return beartype(target)
    if target.__code__ not in _WRITTEN:
        check = beartype(target)
        if _WRAPPED not in (check.__kwdefaults__ or {}):
            return check  # nothing to check, or another beartype
        _WRITTEN[target.__code__] = _copy(check)
    made = _copy(_WRITTEN[target.__code__])
    made.__kwdefaults__[_WRAPPED] = target
    return update_wrapper(made, target)


def _copy(check: FunctionType) -> FunctionType:
    """Return what beartype wrote without what it calls, which would keep that in memory."""
    copy = FunctionType(check.__code__, check.__globals__)
    copy.__kwdefaults__ = check.__kwdefaults__ | {_WRAPPED: None}
    return copy


class _Decorated(ast.NodeTransformer):
    """Decorates functions below all other decorators, and dataclasses above them.

    No other classes: JAX fills its trees, named tuples among them, with whatever it likes. Nor
    against what is imported for static checkers alone.
    """

    def __init__(self) -> None:
        self._absent: set[str] = set()

    def visit(self, node: ast.AST) -> Any:
        """Leave expressions alone, most of a tree: no function is defined within one."""
        return node if isinstance(node, ast.expr) else super().visit(node)

    def visit_If(self, node: ast.If) -> ast.If:
        if ast.unparse(node.test) == "TYPE_CHECKING":
            imports = [line for line in node.body if isinstance(line, ast.ImportFrom)]
            self._absent |= {alias.asname or alias.name for line in imports for alias in line.names}
        self.generic_visit(node)
        return node

    def visit_arg(self, node: ast.arg) -> ast.arg:
        node.annotation = self._there(node.annotation)
        return node

    def _there(self, annotation: ast.expr | None) -> ast.expr | None:
        absent = isinstance(annotation, ast.Constant) and annotation.value in self._absent
        return None if absent else annotation

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        self.generic_visit(node)
        node.returns = self._there(node.returns)
        node.decorator_list.append(_check_of(node))
        return node

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.ClassDef:
        self.generic_visit(node)
        if any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list):
            node.decorator_list.insert(0, _check_of(node))
        return node


def _check_of(node: ast.stmt) -> ast.Name:
    return ast.copy_location(ast.Name(CHECKED, ast.Load()), node)


class _Loader(SourceFileLoader):
    def source_to_code(
        self, data: Any, path: Any, fullname: str | None = None, *, _optimize: int = -1
    ) -> CodeType:  # Python 3.15 passes the name as well
        tree = _Decorated().visit(ast.parse(data))
        return compile(tree, path, "exec", dont_inherit=True, optimize=_optimize)

    def path_stats(self, path: str) -> Any:
        raise OSError("the bytecode beside the source has no checks")

    def exec_module(self, module: ModuleType) -> None:
        vars(module)[CHECKED] = _checked
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

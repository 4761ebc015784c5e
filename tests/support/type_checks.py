"""Checks every call of a package against the annotations of its functions and methods.

By beartype alone: sinsjax annotates arrays as scalars, and thus has no sizes to compare between
arguments. Neither functions within others are checked, which would be decorated at each call, nor
the fields of named tuples, which hold JAX's tracers: beartype's own hook does both.
"""

import ast
import sys
from importlib.abc import MetaPathFinder
from importlib.machinery import PathFinder, SourceFileLoader

from beartype import beartype

CHECKED = "checked_by_beartype"


class _Decorated(ast.NodeTransformer):
    def visit_FunctionDef(self, node):
        node.decorator_list.append(ast.copy_location(ast.Name(CHECKED, ast.Load()), node))
        return node


class _Loader(SourceFileLoader):
    def source_to_code(self, data, path, *more, **options):
        return super().source_to_code(_Decorated().visit(ast.parse(data)), path, *more, **options)

    def path_stats(self, path):
        raise OSError("the bytecode beside the source has no checks")

    def exec_module(self, module):
        vars(module)[CHECKED] = beartype
        super().exec_module(module)


class _Finder(MetaPathFinder):
    def __init__(self, package):
        self._package = package

    def find_spec(self, name, path, target=None):
        is_checked = name.partition(".")[0] == self._package
        spec = PathFinder.find_spec(name, path, target) if is_checked else None
        if spec and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


def install(package):
    """Check the calls of a package that is yet to be imported."""
    assert package not in sys.modules
    sys.meta_path.insert(0, _Finder(package))

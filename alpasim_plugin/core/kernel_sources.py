"""Which sources decide what a kernel computes: Numba freezes constants and other kernels into its
machine code, and compares only the file that the kernel itself stands in.
"""

import ast
import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MAKERS = "alpasim_plugin.core.kernels"  # whose names make kernels
EVERYTHING = ""  # in place of a name: all that stands in a module


def sources_digest(file: str) -> str:
    """Return a SHA-256 over the content of `sources_of` a file, and over their names; of a file that
    is not simrun's over those of its folder.
    """
    real_file = os.path.realpath(file)
    root = ROOT if real_file.startswith(os.path.join(ROOT, "")) else Path(real_file).parent
    hashed = hashlib.sha256()
    for path in sorted(sources_of(file, root)):
        hashed.update(os.path.relpath(path, os.path.realpath(root)).encode())
        hashed.update(hashlib.sha256(Path(path).read_bytes()).digest())
    return hashed.hexdigest()


@lru_cache(maxsize=256)
def sources_of(file: str, root: Path = ROOT) -> frozenset[str]:
    """Return the paths of a file, of the modules below a root whose names its kernels use, and so
    on from those names.

    A module that is used as a whole (``from package import module``) counts with all its names. A
    process reads each module once.
    """
    start = os.path.realpath(file)
    module = _module(start, os.path.realpath(root))
    todo = [(start, name) for name in module.kernels or (EVERYTHING,)]
    visited: set[tuple[str, str]] = set()
    while todo:
        place = todo.pop()
        if place not in visited:
            visited.add(place)
            todo += _module(place[0], os.path.realpath(root)).used_by(place[1])
    return frozenset(path for path, _ in visited)


@dataclass(frozen=True)
class _Module:
    """The top level of a source file.

    Attributes:
        path: The file.
        bound: Names that stand in the statements which bind a name, by that name.
        imported: File and name in it of each name that is imported from below the root.
        kernels: Names of the kernels.
    """

    path: str
    bound: dict[str, set[str]]
    imported: dict[str, tuple[str, str]]
    kernels: tuple[str, ...]

    def used_by(self, name: str) -> Iterator[tuple[str, str]]:
        """Yield file and name of what the statements that bind a name use."""
        chosen = [*self.bound.values()] if name == EVERYTHING else [self.bound.get(name, set())]
        for used in set().union(*chosen):
            if used in self.imported:
                yield self.imported[used]
            elif used in self.bound:
                yield self.path, used
        if name in self.imported:  # which this module passes on
            yield self.imported[name]


@lru_cache(maxsize=256)
def _module(path: str, root: str) -> _Module:
    tree = ast.parse(Path(path).read_bytes())
    imported: dict[str, tuple[str, str]] = {}
    makers: set[str] = set()
    bound: dict[str, set[str]] = {}
    kernels: list[str] = []
    for node in tree.body:
        is_defined = isinstance(node, ast.FunctionDef | ast.ClassDef)
        below = list(ast.walk(node))
        for inner in () if is_defined else below:  # also below `if` and `try`
            if isinstance(inner, ast.Import | ast.ImportFrom):
                imported |= dict(_imports(inner, root))
            if isinstance(inner, ast.ImportFrom) and inner.module == MAKERS:
                makers |= {alias.asname or alias.name for alias in inner.names}
        named = [word for word in below if isinstance(word, ast.Name)]
        words = {word.id for word in named}
        stored = [word.id for word in named if isinstance(word.ctx, ast.Store)]
        names = [node.name] if isinstance(node, ast.FunctionDef | ast.ClassDef) else stored
        for name in names:
            bound[name] = bound.get(name, set()) | words
            if words & makers:
                kernels.append(name)
    return _Module(path, bound, imported, tuple(kernels))


def _imports(node: ast.Import | ast.ImportFrom, root: str) -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield each name that a statement imports from below the root, with its file and its name
    there.
    """
    for alias in node.names:
        if isinstance(node, ast.Import):
            module, inner = alias.name, None
        else:
            module = node.module or ""
            inner = _file_of(f"{module}.{alias.name}", root)
        file = inner or _file_of(module, root)
        if file is not None:
            is_name = isinstance(node, ast.ImportFrom) and inner is None
            yield alias.asname or alias.name, (file, alias.name if is_name else EVERYTHING)


def _file_of(module: str, root: str) -> str | None:
    path = os.path.join(root, *module.split("."))
    candidates = (f"{path}.py", os.path.join(path, "__init__.py"))
    return next((file for file in candidates if os.path.isfile(file)), None)

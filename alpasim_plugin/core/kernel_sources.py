"""Which sources decide what a kernel computes: Numba freezes constants and other kernels into its
machine code, and compares only the file that the kernel itself stands in.

The names that a source file binds, imports and uses are stored on disk under a hash of the file's
content, since parsing the sources takes a tenth of the time in which a command starts. A file with
the same content has the same names, so a stored entry never becomes stale. Which file an imported
name leads to is looked up each time.
"""

import ast
import hashlib
import json
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MAKERS = "alpasim_plugin.core.kernels"  # whose names make kernels
EVERYTHING = ""  # in place of a name: all that stands in a module
SAID = "sources"  # the folder of what sources say


def sources_digest(file: str, kept: Path | None = None) -> str:
    """Return a SHA-256 over the content of `sources_of` a file, and over their names; of a file that
    is not simrun's over those of its folder.

    Args:
        file: A source file.
        kept: Where to keep what sources say; None: nowhere.
    """
    real_file = os.path.realpath(file)
    root = ROOT if real_file.startswith(os.path.join(ROOT, "")) else Path(real_file).parent
    hashed = hashlib.sha256()
    for path in sorted(sources_of(file, root, kept)):
        hashed.update(os.path.relpath(path, os.path.realpath(root)).encode())
        hashed.update(hashlib.sha256(Path(path).read_bytes()).digest())
    return hashed.hexdigest()


@lru_cache(maxsize=256)
def sources_of(file: str, root: Path = ROOT, kept: Path | None = None) -> frozenset[str]:
    """Return the paths of a file, of the modules below a root whose names its kernels use, and so
    on from those names.

    A module that is used as a whole (``from package import module``) counts with all its names. A
    process reads each module once.
    """
    start = os.path.realpath(file)
    top = os.path.realpath(root)
    module = _module(start, top, kept)
    todo = [(start, name) for name in module.kernels or (EVERYTHING,)]
    visited: set[tuple[str, str]] = set()
    while todo:
        place = todo.pop()
        if place not in visited:
            visited.add(place)
            todo += _module(place[0], top, kept).used_by(place[1])
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
    bound: dict[str, list[str]]
    imported: dict[str, tuple[str, str]]
    kernels: tuple[str, ...]

    def used_by(self, name: str) -> Iterator[tuple[str, str]]:
        """Yield file and name of what the statements that bind a name use."""
        chosen = [*self.bound.values()] if name == EVERYTHING else [self.bound.get(name, [])]
        for used in set[str]().union(*chosen):
            if used in self.imported:
                yield self.imported[used]
            elif used in self.bound:
                yield self.path, used
        if name in self.imported:  # which this module passes on
            yield self.imported[name]


@lru_cache(maxsize=256)
def _module(path: str, root: str, kept: Path | None) -> _Module:
    text = _text_of(Path(path).read_bytes(), kept)
    imported: dict[str, tuple[str, str]] = {}
    for name, module, attribute in text.imports:
        inner = None if attribute is None else _file_of(f"{module}.{attribute}", root)
        file = inner or _file_of(module, root)
        if file is not None:
            is_name = attribute is not None and inner is None
            imported[name] = (file, attribute if is_name and attribute else EVERYTHING)
    return _Module(path, text.bound, imported, tuple(text.kernels))


@dataclass(frozen=True)
class _Text:
    """What the text of a source file says, wherever it lies.

    Attributes:
        bound: Names that stand in the statements which bind a name, by that name.
        imports: Each imported name, its module, and its name there; None where that is the module.
        kernels: Names of the kernels.
    """

    bound: dict[str, list[str]]
    imports: list[tuple[str, str, str | None]]
    kernels: list[str]


def _text_of(content: bytes, kept: Path | None) -> _Text:
    """Return what a source says, as it is kept; where nothing readable is kept, it is parsed."""
    if kept is None:
        return _parsed(content)
    file = kept / SAID / f"{hashlib.sha256(_parser() + content).hexdigest()}.json"
    try:
        return _Text(**json.loads(file.read_bytes()))
    except (OSError, ValueError, TypeError):
        text = _parsed(content)
    with suppress(OSError):  # nothing is kept in a folder that cannot be written, nor are kernels
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", dir=file.parent, delete=False) as written:
            json.dump(asdict(text), written)
        os.replace(written.name, file)
    return text


@lru_cache(maxsize=1)
def _parser() -> bytes:
    """Return what a kept text depends on besides the source: this file and Python."""
    return hashlib.sha256(Path(__file__).read_bytes() + sys.version.encode()).digest()


def _parsed(content: bytes) -> _Text:
    imports: list[tuple[str, str, str | None]] = []
    makers: set[str] = set()
    bound: dict[str, set[str]] = {}
    kernels: list[str] = []
    for node in ast.parse(content).body:
        is_defined = isinstance(node, ast.FunctionDef | ast.ClassDef)
        below = list(ast.walk(node))
        for inner in () if is_defined else below:  # also below `if` and `try`
            if isinstance(inner, ast.Import | ast.ImportFrom):
                imports += _imports(inner)
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
    return _Text({name: sorted(words) for name, words in bound.items()}, imports, kernels)


def _imports(node: ast.Import | ast.ImportFrom) -> Iterator[tuple[str, str, str | None]]:
    """Yield each name that a statement imports, its module, and its name there."""
    for alias in node.names:
        if isinstance(node, ast.Import):
            yield alias.asname or alias.name, alias.name, None
        else:
            yield alias.asname or alias.name, node.module or "", alias.name


def _file_of(module: str, root: str) -> str | None:
    path = os.path.join(root, *module.split("."))
    candidates = (f"{path}.py", os.path.join(path, "__init__.py"))
    return next((file for file in candidates if os.path.isfile(file)), None)

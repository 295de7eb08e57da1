"""The digest of a part's code: its module, and every module that it reaches by imports among the sources that may change under it."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from alpasim_plugin import OWN_PACKAGES

OWN_ROOT = str(Path(__file__).resolve().parents[3])
PARTS = os.path.join(OWN_ROOT, "alpasim_plugin", "plugins", "parts") + os.sep
INSTALLED = {"site-packages", "dist-packages"}  # folders that hold packages of many distributions

# Import statements wherever they stand: at the top, inside functions, under conditions. A line of a docstring that looks like one only
# adds a file. Imports for type checkers alone do not run.
_FROM = re.compile(rb"^[ \t]*from[ \t]+(\.*[\w.]*)[ \t]+import[ \t]+(\([^)]*\)|[^\n#]+)", re.MULTILINE)
_IMPORT = re.compile(rb"^[ \t]*import[ \t]+([^\n#]+)", re.MULTILINE)
_TYPES_ONLY = re.compile(rb"^if (?:typing\.)?TYPE_CHECKING:\n(?:[ \t]+[^\n]*\n|\n)+", re.MULTILINE)
_COMMENT = re.compile(rb"#[^\n]*")


def code_digest(file: str | Path) -> str:
    """Return a SHA-256 over a module and all modules that it reaches by imports.

    Followed are imports of modules in the part's own top-level package, in simrun's packages, and, for code that is not installed, of files
    beside it. Installed third-party libraries and the standard library are not: ``run.json`` lists the versions of those that matter.

    Args:
        file: Source file of the part's module.
    """
    digests = sorted(_read(path).digest for path in code_files(file))
    return hashlib.sha256("\n".join(digests).encode()).hexdigest()


def own_code_digest(module: str) -> str:
    """Return the `code_digest` of one of simrun's own modules, by its dotted name. Nothing is imported."""
    file = _own_file(tuple(module.split(".")))
    assert file is not None, module
    return code_digest(file)


def code_files(file: str | Path) -> set[str]:
    """Return the paths of the files that `code_digest` covers.

    Code of other people that reaches `alpasim_plugin.plugins.parts` may name any of our parts by a string, so all of ours counts for it.
    """
    found = reached(file)
    is_ours = os.path.realpath(file) in _own_sources()
    may_name_parts = any(path.startswith(PARTS) for path in found)
    return found | _own_sources() if may_name_parts and not is_ours else found


@lru_cache(maxsize=1)
def _own_sources() -> frozenset[str]:
    packages = (Path(OWN_ROOT, package) for package in OWN_PACKAGES)
    return frozenset(str(path) for package in packages for path in package.rglob("*.py"))


def reached(file: str | Path) -> set[str]:
    """Return the paths of a module and of all that it reaches by imports."""
    start = os.path.realpath(file)
    root = top_folder(start)
    seen: set[str] = set()
    todo = [start]
    while todo:
        path = todo.pop()
        if path not in seen:
            seen.add(path)
            todo += imported_files(path, root)
    return seen


def top_folder(file: str) -> str:
    """Return the folder from which a file's module is imported: that of its outermost package."""
    folder = os.path.dirname(file)
    while os.path.isfile(os.path.join(folder, "__init__.py")):
        folder = os.path.dirname(folder)
    return folder


class _Source(NamedTuple):
    digest: str  # SHA-256 of the text
    imports: tuple[str, ...]  # dotted names
    lazy: dict[str, str]  # public name -> module, of a package that imports its names on first use (`alpasim_plugin.core.lazy`)


def _read(path: str) -> _Source:
    stat = os.stat(path)
    return _parsed(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=4096)
def _parsed(path: str, mtime_ns: int, size: int) -> _Source:
    with open(path, "rb") as file:
        text = file.read()
    lazy: dict[str, str] = {}
    for match in _FROM.finditer(b"".join(_TYPES_ONLY.findall(text)) if b"lazy_names(" in text else b""):
        lazy |= {item.split(" as ")[0].strip(): match[1].decode() for item in match[2].decode().strip("()").split(",")}
    return _Source(hashlib.sha256(text).hexdigest(), tuple(dict.fromkeys(_names(_TYPES_ONLY.sub(b"", text)))), lazy)


def _names(text: bytes) -> Iterator[str]:
    """Give every dotted name that a module may import; ``from a import b`` gives ``a`` and ``a.b``."""
    for match in _FROM.finditer(text):
        module = match[1].decode()
        yield module
        for item in _COMMENT.sub(b"", match[2]).decode(errors="replace").strip("()").split(","):
            name = item.split(" as ")[0].strip()
            if name.isidentifier():
                yield f"{module}{'' if module.endswith('.') else '.'}{name}"
    for match in _IMPORT.finditer(text):
        for item in match[1].decode(errors="replace").split(","):
            yield item.split(" as ")[0].strip()


def imported_files(path: str, root: str) -> Iterable[str]:
    """Return the files that a module imports; of our own modules once, because our files do not come and go while a process runs."""
    if root != OWN_ROOT:
        return _find_imported(path, root)
    stat = os.stat(path)
    return _own_imported(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=4096)
def _own_imported(path: str, mtime_ns: int, size: int) -> tuple[str, ...]:
    return tuple(_find_imported(path, OWN_ROOT))


def _find_imported(path: str, root: str) -> Iterator[str]:
    base = next((base for base in (root, OWN_ROOT) if path.startswith(base + os.sep)), root)
    here = os.path.relpath(os.path.dirname(path), base).split(os.sep)
    top = here[0] if here != ["."] else os.path.basename(path).removesuffix(".py")
    is_shared = not INSTALLED.isdisjoint(root.split(os.sep))
    for dotted in _read(path).imports:
        dots = len(dotted) - len(dotted.lstrip("."))
        rest = [part for part in dotted[dots:].split(".") if part]
        parts = [*(part for part in here[: len(here) - dots + 1] if part != "."), *rest] if dots else rest
        own = bool(parts) and parts[0] in OWN_PACKAGES
        if not parts or not (own or parts[0] == top or not is_shared):
            continue
        for depth in range(1, len(parts) + 1):
            found = _own_file(tuple(parts[:depth])) if own else module_file(root, parts[:depth])
            if found is not None:
                yield found
        face = _own_file(tuple(parts[:-1])) if own and len(parts) > 1 else None
        home = None if face is None else _read(face).lazy.get(parts[-1])
        found = None if home is None else _own_file(tuple(home.split(".")))
        if found is not None:
            yield found


@lru_cache(maxsize=8192)
def _own_file(parts: tuple[str, ...]) -> str | None:
    return module_file(OWN_ROOT, parts)


def module_file(root: str, parts: Sequence[str]) -> str | None:
    """Return the file of a module below a folder, ``__init__.py`` of a package; None where there is none."""
    path = os.path.join(root, *parts)
    package = os.path.join(path, "__init__.py")
    if os.path.isfile(package):
        return package
    return path + ".py" if os.path.isfile(path + ".py") else None

"""The code of a part: imported from what a target names (``package.module:attribute`` or
``path/to/file.py:attribute``), and its digest.

A folder that is not installed is never on Python's path. A finder of its own (`_NamedFolders`)
serves the file that was named and what its import statements reach in its folder; nothing else
there can be imported, whoever asks for it.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import os
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from alpasim_plugin import OWN_PACKAGES
from alpasim_plugin.core.errors import InputError

OWN_ROOT = str(Path(__file__).resolve().parents[3])
PARTS = os.path.join(OWN_ROOT, "alpasim_plugin", "plugins", "parts") + os.sep
INSTALLED = {"site-packages", "dist-packages"}  # folders that hold packages of many distributions

# Import statements wherever they stand: at the top, inside functions, under conditions. A line of a
# docstring that looks like one only adds a file. Imports for type checkers alone do not run.
_FROM = re.compile(
    rb"^[ \t]*from[ \t]+(\.*[\w.]*)[ \t]+import[ \t]+(\([^)]*\)|[^\n#]+)", re.MULTILINE
)
_IMPORT = re.compile(rb"^[ \t]*import[ \t]+([^\n#]+)", re.MULTILINE)
_TYPES_ONLY = re.compile(rb"^if (?:typing\.)?TYPE_CHECKING:\n(?:[ \t]+[^\n]*\n|\n)+", re.MULTILINE)
_COMMENT = re.compile(rb"#[^\n]*")
PACKAGE = os.sep + "__init__.py"  # the file of a package, in its folder


def code_digest(file: str | Path) -> str:
    """Return a SHA-256 over a module and all modules that it reaches by imports.

    Followed are imports of modules in the part's own top-level package, in simrun's packages, and,
    for code that is not installed, of files beside it. Installed third-party libraries and the
    standard library are not: ``run.json`` lists the versions of those that matter.

    Args:
        file: Source file of the part's module.
    """
    digests = sorted(_read(path).digest for path in code_files(file))
    return hashlib.sha256("\n".join(digests).encode()).hexdigest()


def own_code_digest(module: str) -> str:
    """Return the `code_digest` of one of simrun's own modules, by its dotted name. Nothing is
    imported.
    """
    file = _own_file(tuple(module.split(".")))
    assert file is not None, module
    return code_digest(file)


@lru_cache(maxsize=1)
def package_digest() -> str:
    """Return a SHA-256 over all source files of simrun, with their names."""
    hashed = hashlib.sha256()
    for path in sorted(_own_sources()):
        with open(path, "rb") as file:
            text = file.read()
        hashed.update(os.path.relpath(path, OWN_ROOT).encode() + hashlib.sha256(text).digest())
    return hashed.hexdigest()


def code_files(file: str | Path) -> set[str]:
    """Return the paths of the files that `code_digest` covers.

    Code of other people that reaches `alpasim_plugin.core.parts` may name any of our parts by a
    string, so all of ours counts for it.
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
    lazy: dict[
        str, str
    ]  # public name -> module, of a package that imports its names on first use (`alpasim_plugin.core.lazy`)


def _read(path: str) -> _Source:
    stat = os.stat(path)
    return _parsed(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=4096)
def _parsed(path: str, mtime_ns: int, size: int) -> _Source:
    with open(path, "rb") as file:
        text = file.read()
    lazy: dict[str, str] = {}
    for match in _FROM.finditer(
        b"".join(_TYPES_ONLY.findall(text)) if b"lazy_names(" in text else b""
    ):
        lazy |= {
            item.split(" as ")[0].strip(): match[1].decode()
            for item in match[2].decode().strip("()").split(",")
        }
    return _Source(
        hashlib.sha256(text).hexdigest(),
        tuple(dict.fromkeys(_names(_TYPES_ONLY.sub(b"", text)))),
        lazy,
    )


def _names(text: bytes) -> Iterator[str]:
    """Give every dotted name that a module may import; ``from a import b`` gives ``a`` and
    ``a.b``.
    """
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
    """Return the files that a module imports; of our own modules once, because our files do not
    come and go while a process runs.
    """
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
        parts = (
            [*(part for part in here[: len(here) - dots + 1] if part != "."), *rest]
            if dots
            else rest
        )
        own = bool(parts) and parts[0] in OWN_PACKAGES
        if not parts or not (own or parts[0] == top or not is_shared):
            continue
        for depth in range(1, len(parts) + 1):
            found = _own_file(tuple(parts[:depth])) if own else module_file(root, parts[:depth])
            if found is not None:
                yield found
                if not found.endswith(PACKAGE):
                    # what is in a file is no module: two looks at the disk less for most names
                    break
        face = _own_file(tuple(parts[:-1])) if own and len(parts) > 1 else None
        home = None if face is None else _read(face).lazy.get(parts[-1])
        found = None if home is None else _own_file(tuple(home.split(".")))
        if found is not None:
            yield found


@lru_cache(maxsize=8192)
def _own_file(parts: tuple[str, ...]) -> str | None:
    return module_file(OWN_ROOT, parts)


def module_file(root: str, parts: Sequence[str]) -> str | None:
    """Return the file of a module below a folder, ``__init__.py`` of a package; None where there is
    none.
    """
    path = os.path.join(root, *parts)
    package = path + PACKAGE
    if os.path.isfile(package):
        return package
    return path + ".py" if os.path.isfile(path + ".py") else None


COMMAND = "exec:"  # what follows is a command line
DO_THIS = "write package.module:Class with the package installed or in the working directory, or file.py:Class"
_imported_code: dict[
    Path, str
] = {}  # file of a module -> its code digest when a part of it was first resolved


class _NamedFolders:
    """Find modules of folders in which a user has named one; installed modules come first, since
    this is the last finder.

    Attributes:
        files: Name of a module without dots -> its file, ``__init__.py`` of a package.
    """

    files: dict[str, str] = {}  # noqa: RUF012 - one for the process, as `sys.modules` is

    @classmethod
    def find_spec(cls, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Return the spec of a module that is served; parts of a package are found by the package
        itself.
        """
        file = cls.files.get(name)
        return None if file is None else importlib.util.spec_from_file_location(name, file)


def is_target(name: str) -> bool:
    """Tell whether a name is a target and not a registered name, an address (``scheme://``) or a
    command (``exec:``).
    """
    return ":" in name and not split_address(name)[0]


def split_address(name: str) -> tuple[str, str]:
    """Return the registered name and the address of a part that lies behind one; empty where the
    name has none.

    Example:
        >>> split_address("nre://host:50051"), split_address("exec:python drive.py http://a"), split_address("clean")
        (('nre://', 'host:50051'), ('exec:', 'python drive.py http://a'), ('', ''))
    """
    if name.startswith(COMMAND):
        return COMMAND, name.removeprefix(COMMAND)
    scheme, slashes, rest = name.partition("://")
    return (scheme + slashes, rest) if slashes else ("", "")


def absolute_target(target: str) -> str:
    """Return a target that means the same in every process: an installed module's dotted name, or
    an absolute path.

    A module that is not installed is looked for in the working directory. A folder there may bear
    the name of one of our packages (``policies/mine.py``). Ours is the importable one, so a module
    that ours does not have, or that differs from ours, is taken from the file.
    """
    module, _, attribute = target.rpartition(":")
    if module.endswith(".py"):
        return f"{Path(module).absolute()}:{attribute}"
    parts = module.split(".")
    is_own = parts[0] in OWN_PACKAGES
    if not is_own and _is_installed(parts[0]):
        return target
    file = module_file(os.getcwd(), parts)
    if file is None or (
        is_own
        and (os.path.realpath(file) == module_file(OWN_ROOT, parts) or file.endswith("__init__.py"))
    ):
        return target
    return f"{file}:{attribute}"


def load(target: str, kind: str) -> Any:
    """Import a target's module and return its attribute.

    Raises:
        InputError: The import fails, or the module has no such attribute.
    """
    name, _, attribute = target.rpartition(":")
    try:
        module = _from_file(Path(name)) if name.endswith(".py") else importlib.import_module(name)
        return getattr(module, attribute)
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # whatever a user's module raises while it is imported
        raise InputError(f"{kind} {target!r}: {type(error).__name__}: {error}", DO_THIS) from error


def make_importable(target: str) -> str:
    """Let the modules that a target names and reaches be imported in this process, and return the
    name of the first one.

    Nothing is run. A process that receives objects of such a module calls this before it unpickles
    them.

    Args:
        target: As `absolute_target` returns it.
    """
    name, _, _ = target.rpartition(":")
    if not name.endswith(".py"):
        return name
    if _NamedFolders not in sys.meta_path:
        sys.meta_path.append(_NamedFolders)
    root = top_folder(name)
    within = Path(os.path.relpath(name, root)).with_suffix("").parts
    if INSTALLED.isdisjoint(Path(root).parts):
        _serve_reached(name, root)
    in_package = within[:-1] if within[-1] == "__init__" else within
    if len(within) > 1 and _NamedFolders.files.get(in_package[0]) == module_file(
        root, in_package[:1]
    ):
        return ".".join(in_package)
    own = f"simrun_file_{hashlib.sha256(name.encode()).hexdigest()[:12]}"
    _NamedFolders.files[own] = name
    return own


def file_of(target: str) -> Path | None:
    """Return the source file of a target's module, which need not have been imported; None where it
    has none.
    """
    name, _, _ = target.rpartition(":")
    if name.endswith(".py"):
        return Path(name)
    spec = importlib.util.find_spec(name)
    return (
        Path(spec.origin)
        if spec is not None and spec.has_location and spec.origin is not None
        else None
    )


def require_unedited(file: Path, digest: str) -> None:
    """Refuse a module whose code on disk is no longer the code that this process has imported.

    Args:
        file: The module's source file; it has been imported.
        digest: Its `alpasim_plugin.core.parts.source.code_digest` now.

    Raises:
        InputError: The digest is another than when the part was first resolved in this process.
    """
    if _imported_code.setdefault(file, digest) != digest:
        raise InputError(
            f"{file}: it, or a module that it imports, was edited after this process had imported it",
            "start a new process",
        )


def _from_file(file: Path) -> ModuleType:
    if not file.is_file():
        raise FileNotFoundError(f"no such file: {file}")
    return importlib.import_module(make_importable(f"{file}:"))


def _serve_reached(file: str, root: str) -> None:
    """Serve the modules of a folder that a file's import statements reach, as far as nothing
    installed bears their names.
    """
    seen, todo = set[str](), [file]
    while todo:
        path = todo.pop()
        if path in seen:
            continue
        seen.add(path)
        top = os.path.relpath(path, root).split(os.sep)[0].removesuffix(".py")
        if top not in OWN_PACKAGES and not _is_installed(top):
            _serve(top, module_file(root, [top]))
        elif path != file:
            continue
        todo += [found for found in imported_files(path, root) if found.startswith(root + os.sep)]


def _serve(name: str, file: str | None) -> None:
    """Serve a module from a file.

    Raises:
        InputError: A module of that name was imported from another folder.
    """
    other = _NamedFolders.files.get(name, file)
    if file is None:
        return
    if other != file and name in sys.modules:
        raise InputError(
            f"{file}: a module named {name} was imported from {other} before",
            "rename one of the two",
        )
    _NamedFolders.files[name] = file


def _is_installed(name: str) -> bool:
    """Tell whether Python finds a module without the folders that were named."""
    if name in _NamedFolders.files:
        return False
    try:
        return importlib.util.find_spec(name) is not None
    except ValueError:  # a module that was made, not found: __main__
        return True

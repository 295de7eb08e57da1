"""The code of a part: imported from what a target names (``package.module:attribute`` or
``path/to/file.py:attribute``), and its digest.

A folder that is not installed is never on Python's path: only the file that was named, and the
files that it imports beside it, can be imported.
"""

import ast
import difflib
import hashlib
import importlib
import importlib.util
import inspect
import os
import sys
from collections.abc import Iterator, Sequence
from functools import lru_cache
from importlib.machinery import EXTENSION_SUFFIXES, SOURCE_SUFFIXES
from itertools import product
from pathlib import Path
from typing import Any

from alpasim_plugin import OWN_PACKAGES
from alpasim_plugin.core.errors import InputError, is_interruption
from alpasim_plugin.core.files import file_sha256, read_bytes
from alpasim_plugin.core.files.inputs import Inputs, note_files, remembered, unrecorded
from alpasim_plugin.core.parts.blame import raised

OWN_ROOT = str(Path(__file__).resolve().parents[3])
INSTALLED = {"site-packages", "dist-packages"}  # folders that hold packages of many distributions
COMMAND = "exec:"  # what follows is a command line
DO_THIS = (
    "write package.module:Class with the package installed or in the working directory, "
    "or file.py:Class"
)
IN_A_FILE = (
    "Correct the file; it can import what is installed, and what lies beside it as 'import helper'."
)
_imported_code: dict[str, str] = {}  # file -> its digest when a part that imports it was resolved
_served: dict[str, str] = {}  # module -> file, of modules that no folder on Python's path has


@lru_cache(maxsize=1)
@unrecorded()  # code enters a record as its digest
def package_digest() -> str:
    """Return a SHA-256 over all source files of simrun, with their names: its version."""
    hashed = hashlib.sha256()
    for package in OWN_PACKAGES:
        for path in sorted(Path(OWN_ROOT, package).rglob("*.py")):
            name = path.relative_to(OWN_ROOT).as_posix().encode()
            hashed.update(name + bytes.fromhex(file_sha256(path)))
    return hashed.hexdigest()


def code_digest(file: str | Path) -> str:
    """Return a SHA-256 over simrun, and over a module that is not simrun's with the `code_files` of
    it.

    Args:
        file: Source file of the part's module.
    """
    hashed = hashlib.sha256(package_digest().encode())
    modules = code_files(file)
    if not modules:
        return package_digest()
    for content in modules.values():
        hashed.update(bytes.fromhex(content))
    return hashed.hexdigest()


@unrecorded()
def code_files(file: str | Path) -> dict[str, str]:
    """Return the digest of a module that is not simrun's and of all that it imports, by path; of
    simrun's own none.

    Modules count wherever Python finds them: beside the file, on ``PYTHONPATH``, in a package that
    is installed editable. Installed third-party libraries and the standard library are left out:
    ``run.json`` lists the versions of those that matter.
    """
    path = os.path.realpath(file)
    if Path(os.path.relpath(path, OWN_ROOT)).parts[0] in OWN_PACKAGES:
        return {}
    return {module: file_sha256(module) for module in sorted(_reached(path, everywhere=True))}


@unrecorded()
def _modules_behind(target: str) -> set[str]:
    """Return the paths of a target's module and of all that it imports; of simrun's own its name."""
    name, _, _ = target.rpartition(":")
    if name.partition(".")[0] in OWN_PACKAGES:
        return {name}
    file = file_of(target)
    return set() if file is None else _reached(os.path.realpath(file), everywhere=True)


def reached(file: str | Path) -> set[str]:
    """Return the paths of a module and of all that it imports below the folder of its outermost
    package; of installed ones only those of its own package.
    """
    return _reached(os.path.realpath(file), everywhere=False)


def _reached(start: str, everywhere: bool) -> set[str]:
    """Return the paths of a module and of what it imports; ``everywhere`` follows modules that lie
    elsewhere and are not installed as well.
    """
    root = top_folder(start)
    package = Path(os.path.relpath(start, root)).parts[0].removesuffix(".py")
    is_shared = not INSTALLED.isdisjoint(Path(root).parts)
    folders: dict[str, str | None] = {}  # first name of a module that lies elsewhere -> its root
    visited: set[str] = set()
    todo = [(start, root)]
    while todo:
        path, base = todo.pop()
        if path in visited:
            continue
        visited.add(path)
        for module in _imports(path, base):
            name = module[0]
            lies_here = base == root and (
                name == package or not (is_shared or _is_installed(name, root))
            )
            folder: str | None = root if lies_here else None
            if not lies_here and everywhere:
                if name not in folders:
                    folders[name] = _folder_elsewhere(name)
                folder = folders[name]
            if folder is not None:
                lengths = range(1, len(module) + 1)
                for length, endings in product(lengths, (SOURCE_SUFFIXES, EXTENSION_SUFFIXES)):
                    file = module_file(folder, module[:length], endings)
                    if file is not None:
                        todo.append((file, folder))
    return visited


def _folder_elsewhere(name: str) -> str | None:
    """Return the folder from which Python imports a user's module, on ``PYTHONPATH`` or installed
    editable; None for simrun, installed libraries, the standard library, and what is not there.
    """
    if name in OWN_PACKAGES or name in sys.stdlib_module_names:
        return None
    try:
        spec = importlib.util.find_spec(name)
    except ValueError:  # a module that was made, not found: __main__
        return None
    places = [] if spec is None else [spec.origin or "", *(spec.submodule_search_locations or ())]
    place = next((os.path.realpath(text) for text in places if os.path.exists(text)), None)
    if place is None or not INSTALLED.isdisjoint(Path(place).parts):
        return None
    is_package = spec is not None and spec.submodule_search_locations is not None
    inner = place if os.path.isdir(place) else os.path.dirname(place)
    return os.path.dirname(inner) if is_package else inner


def top_folder(file: str) -> str:
    """Return the folder from which a file's module is imported: that of its outermost package."""
    folder = os.path.dirname(file)
    while os.path.isfile(os.path.join(folder, "__init__.py")):
        folder = os.path.dirname(folder)
    return folder


def module_file(
    root: str, parts: Sequence[str], endings: Sequence[str] = SOURCE_SUFFIXES
) -> str | None:
    """Return the file of a module below a folder, ``__init__.py`` of a package; None where there is
    none with one of these endings.
    """
    path = os.path.join(root, *parts)
    candidates = (os.path.join(path, "__init__.py"), *(f"{path}{ending}" for ending in endings))
    return next((file for file in candidates if os.path.isfile(file)), None)


def _imports(path: str, root: str) -> Iterator[list[str]]:
    """Yield the dotted name of everything that a module may import, relative ones made absolute."""
    package = list(Path(os.path.relpath(path, root)).parent.parts)
    if path.endswith(tuple(EXTENSION_SUFFIXES)):
        return  # compiled: what it imports is not seen
    try:
        tree = ast.parse(read_bytes(path))
    except (SyntaxError, ValueError):  # the import itself will say so
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name.split(".")
        elif isinstance(node, ast.ImportFrom):
            module = package[: len(package) - node.level + 1] if node.level else []
            module = [*module, *(node.module.split(".") if node.module else [])]
            for alias in node.names:
                yield [*module, alias.name]


def _is_installed(name: str, root: str | None = None) -> bool:
    """Tell whether Python finds a module without the folders that were named, elsewhere than below
    ``root``; our own packages it always does.
    """
    if name in OWN_PACKAGES:
        return True
    if name in _served:
        return False
    try:
        spec = importlib.util.find_spec(name)
    except ValueError:  # a module that was made, not found: __main__
        return True
    if spec is None or root is None:
        return spec is not None
    return os.path.realpath(spec.origin or "") != module_file(root, [name])


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
    scheme, slashes, address = name.partition("://")
    return (scheme + slashes, address) if slashes else ("", "")


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
    file = module_file(os.getcwd(), parts)
    if file is None or (not is_own and _is_installed(parts[0])):
        return target
    is_ours = os.path.realpath(file) == module_file(OWN_ROOT, parts)
    if is_own and (is_ours or file.endswith("__init__.py")):
        return target
    return f"{file}:{attribute}"


def load(target: str, kind: str) -> Any:
    """Import a target's module and return its attribute.

    Raises:
        InputError: The import fails, or the module has no such attribute.
    """
    name, _, attribute = target.rpartition(":")
    try:
        if name.endswith(".py") and not os.path.isfile(name):
            raise no_such_file(kind, Path(name))
        module_name = make_importable(target)
        with Inputs() as inputs:
            module = importlib.import_module(module_name)
            member = getattr(module, attribute, None)  # a module of a file runs here
        # Whoever loads a part is made of what its modules read when they were imported.
        note_files(remembered(_modules_behind(target), inputs.files))
    except InputError:
        raise
    except BaseException as error:  # whatever a user's module raises while it is imported
        if is_interruption(error):
            raise
        hint = IN_A_FILE if name.endswith(".py") else DO_THIS
        raise InputError(f"{kind} {target!r}: {raised(error)}", hint) from error
    if member is None:
        classes = {key: value for key, value in vars(module).items() if inspect.isclass(value)}
        own_classes = [key for key, value in classes.items() if value.__module__ == module.__name__]
        choices = own_classes or [*classes]
        near = difflib.get_close_matches(attribute, choices, 3, 0.0)
        raise InputError(
            f"{kind} {target!r}: {name} has no {attribute!r}",
            f"Name one of its classes: {', '.join(near) or 'it has none'}.",
        )
    return member


def no_such_file(kind: str, file: Path) -> InputError:
    """Return the error for a part's file that is not there; its hint names those with a name like
    it beside it.
    """
    near = difflib.get_close_matches(file.stem, [path.stem for path in file.parent.glob("*.py")])
    guess = f"Did you mean {' or '.join(f'{name}.py' for name in near)}? " if near else ""
    return InputError(
        f"{kind} {str(file)!r}: no such file", f"{guess}Name a file that exists, as FILE.py:Class."
    )


def classes_of(file: Path) -> list[str]:
    """Return the names of the classes that a file defines, without running it.

    Raises:
        InputError: It is not Python.
    """
    try:
        tree = ast.parse(read_bytes(file), str(file))
    except (SyntaxError, ValueError) as error:
        raise InputError(f"{file}: {error}", "Correct the file.") from error
    return [node.name for node in tree.body if isinstance(node, ast.ClassDef)]


def make_importable(target: str) -> str:
    """Let the modules that a target names and imports beside it be imported in this process, and
    return the name of the first one.

    Nothing is run. A process that receives objects of such a module calls this before it unpickles
    them.

    Args:
        target: As `absolute_target` returns it.

    Raises:
        InputError: A module of the same name was imported from another folder.
    """
    file, _, _ = target.rpartition(":")
    if not file.endswith(".py"):
        return file
    file = os.path.realpath(file)  # what a link leads to lies beside its own modules
    root = top_folder(file)
    if INSTALLED.isdisjoint(Path(root).parts):
        for path in sorted(reached(file) - {os.path.join(root, os.path.basename(file))}):
            if not path.endswith(".py"):
                continue  # a compiled module is found by Python alone
            top = Path(os.path.relpath(path, root)).parts[0].removesuffix(".py")
            if not _is_installed(top):
                _serve(top, module_file(root, [top]))
    parts = list(Path(os.path.relpath(file, root)).with_suffix("").parts)
    if parts[-1] == "__init__":
        parts.pop()
    if len(parts) > 1 and _served.get(parts[0]) == module_file(root, parts[:1]):
        return ".".join(parts)
    module_name = f"simrun_file_{hashlib.sha256(file.encode()).hexdigest()[:12]}"
    _serve(module_name, file)
    return module_name


def _serve(name: str, file: str | None) -> None:
    """Make a module of a file importable; it is run when it is used first.

    Raises:
        InputError: A module of that name was imported from another folder.
    """
    if file is None or not os.path.isfile(file):
        return
    other = _served.get(name, file)
    if other != file:
        raise InputError(
            f"{file}: a module named {name} was imported from {other} before",
            "rename one of the two",
        )
    spec = importlib.util.spec_from_file_location(name, file)
    if name in sys.modules or spec is None or spec.loader is None:
        return
    spec.loader = importlib.util.LazyLoader(spec.loader)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    _served[name] = file


def file_of(target: str) -> Path | None:
    """Return the source file of a target's module, which need not have been imported; None where it
    has none.
    """
    name, _, _ = target.rpartition(":")
    if name.endswith(".py"):
        return Path(name)
    spec = importlib.util.find_spec(name)
    return Path(spec.origin) if spec and spec.origin and spec.has_location else None


def require_unedited(file: Path) -> None:
    """Refuse a module that, or one of whose imports, is no longer on disk as this process has imported
    it.

    Raises:
        InputError: A file of its code is another than when a part that imports it was first resolved
            in this process.
    """
    for path, content in code_files(file).items():
        if _imported_code.setdefault(path, content) != content:
            imported_by = "" if os.path.realpath(file) == path else f", which {file} imports,"
            raise InputError(
                f"{path}{imported_by} was edited after this process imported it",
                "start a new process",
            )

"""Import what a target names: ``package.module:attribute``, or ``path/to/file.py:attribute``.

A folder that is not installed is never on Python's path. A finder of its own (`_NamedFolders`) serves the file that was named and what
its import statements reach in its folder; nothing else there can be imported, whoever asks for it.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import os
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

from alpasim_plugin import OWN_PACKAGES
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.plugins.parts.source import INSTALLED, OWN_ROOT, imported_files, module_file, top_folder

COMMAND = "exec:"  # what follows is a command line
DO_THIS = "write package.module:Class with the package installed or in the working directory, or file.py:Class"
_imported_code: dict[Path, str] = {}  # file of a module -> its code digest when a part of it was first resolved


class _NamedFolders:
    """Find modules of folders in which a user has named one; installed modules come first, since this is the last finder.

    Attributes:
        files: Name of a module without dots -> its file, ``__init__.py`` of a package.
    """

    files: dict[str, str] = {}  # noqa: RUF012 - one for the process, as `sys.modules` is

    @classmethod
    def find_spec(cls, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Return the spec of a module that is served; parts of a package are found by the package itself."""
        file = cls.files.get(name)
        return None if file is None else importlib.util.spec_from_file_location(name, file)


def is_target(name: str) -> bool:
    """Tell whether a name is a target and not a registered name, an address (``scheme://``) or a command (``exec:``)."""
    return ":" in name and not split_address(name)[0]


def split_address(name: str) -> tuple[str, str]:
    """Return the registered name and the address of a part that lies behind one; empty where the name has none.

    Example:
        >>> split_address("nre://host:50051"), split_address("exec:python drive.py http://a"), split_address("clean")
        (('nre://', 'host:50051'), ('exec:', 'python drive.py http://a'), ('', ''))
    """
    if name.startswith(COMMAND):
        return COMMAND, name.removeprefix(COMMAND)
    scheme, slashes, rest = name.partition("://")
    return (scheme + slashes, rest) if slashes else ("", "")


def absolute_target(target: str) -> str:
    """Return a target that means the same in every process: an installed module's dotted name, or an absolute path.

    A module that is not installed is looked for in the working directory. A folder there may bear the name of one of our packages
    (``policies/mine.py``). Ours is the importable one, so a module that ours does not have, or that differs from ours, is taken from the
    file.
    """
    module, _, attribute = target.rpartition(":")
    if module.endswith(".py"):
        return f"{Path(module).absolute()}:{attribute}"
    parts = module.split(".")
    is_own = parts[0] in OWN_PACKAGES
    if not is_own and _is_installed(parts[0]):
        return target
    file = module_file(os.getcwd(), parts)
    if file is None or (is_own and (os.path.realpath(file) == module_file(OWN_ROOT, parts) or file.endswith("__init__.py"))):
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
        raise InputError(f"importing a {kind}", f"{kind} {target!r}", f"{type(error).__name__}: {error}", DO_THIS) from error


def make_importable(target: str) -> str:
    """Let the modules that a target names and reaches be imported in this process, and return the name of the first one.

    Nothing is run. A process that receives objects of such a module calls this before it unpickles them.

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
    if len(within) > 1 and _NamedFolders.files.get(in_package[0]) == module_file(root, in_package[:1]):
        return ".".join(in_package)
    own = f"simrun_file_{hashlib.sha256(name.encode()).hexdigest()[:12]}"
    _NamedFolders.files[own] = name
    return own


def file_of(target: str) -> Path | None:
    """Return the source file of a target's module, which need not have been imported; None where it has none."""
    name, _, _ = target.rpartition(":")
    if name.endswith(".py"):
        return Path(name)
    spec = importlib.util.find_spec(name)
    return Path(spec.origin) if spec is not None and spec.has_location and spec.origin is not None else None


def require_unedited(file: Path, digest: str) -> None:
    """Refuse a module whose code on disk is no longer the code that this process has imported.

    Args:
        file: The module's source file; it has been imported.
        digest: Its `alpasim_plugin.plugins.parts.source.code_digest` now.

    Raises:
        InputError: The digest is another than when the part was first resolved in this process.
    """
    if _imported_code.setdefault(file, digest) != digest:
        found = "it, or a module that it imports, was edited after this process had imported it"
        raise InputError("resolving a part", str(file), found, "start a new process (in a notebook: restart the kernel)")


def _from_file(file: Path) -> ModuleType:
    if not file.is_file():
        raise FileNotFoundError(f"no such file: {file}")
    return importlib.import_module(make_importable(f"{file}:"))


def _serve_reached(file: str, root: str) -> None:
    """Serve the modules of a folder that a file's import statements reach, as far as nothing installed bears their names."""
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
        found = f"a module named {name} was imported from {other} before"
        raise InputError("importing a part", file, found, "rename one of the two")
    _NamedFolders.files[name] = file


def _is_installed(name: str) -> bool:
    """Tell whether Python finds a module without the folders that were named."""
    if name in _NamedFolders.files:
        return False
    try:
        return importlib.util.find_spec(name) is not None
    except ValueError:  # a module that was made, not found: __main__
        return True


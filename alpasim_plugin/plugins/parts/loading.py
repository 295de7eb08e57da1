"""Import what a target names: ``package.module:attribute``, or ``path/to/file.py:attribute``."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from alpasim_plugin import OWN_PACKAGES
from alpasim_plugin.core.errors import InputError

COMMAND = "exec:"  # what follows is a command line
_imported_code: dict[Path, str] = {}  # file of a module -> its code digest when a part of it was first resolved


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
    """Return a target that means the same in every process: a file's path is made absolute, a dotted name stays.

    A folder beside the user's work may bear the name of one of our packages (``policies/mine.py``). Ours is the importable one, so a
    module that ours does not have, or that differs from ours, is taken from the file.
    """
    module, _, attribute = target.rpartition(":")
    if module.endswith(".py"):
        return f"{Path(module).absolute()}:{attribute}"
    if module.split(".")[0] in OWN_PACKAGES:
        file = Path(os.getcwd(), *module.split(".")).with_suffix(".py")
        if file.is_file() and file.resolve() != _own_file(module):
            return f"{file}:{attribute}"
    return target


def load(target: str, kind: str) -> Any:
    """Import a target's module and return its attribute.

    Raises:
        InputError: The import fails, or the module has no such attribute.
    """
    name, _, attribute = target.rpartition(":")
    try:
        module = _from_file(Path(name)) if name.endswith(".py") else importlib.import_module(name)
        return getattr(module, attribute)
    except (Exception, SystemExit) as error:  # whatever a user's module raises while it is imported
        raise InputError(
            f"importing a {kind}",
            f"{kind} {target!r}",
            f"{type(error).__name__}: {error}",
            "write package.module:Class with the package on Python's path, or file.py:Class",
        ) from error


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
    """Import a file under a name of its own; files beside it can be imported too, after everything that is installed."""
    name = f"simrun_file_{hashlib.sha256(str(file).encode()).hexdigest()[:12]}"
    if name in sys.modules:
        return sys.modules[name]
    if str(file.parent) not in sys.path:
        sys.path.append(str(file.parent))
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None or not file.is_file():
        raise FileNotFoundError(f"no such file: {file}")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # before it runs, as the import system does: dataclasses and pickles look it up
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _own_file(module: str) -> Path:
    return Path(__file__).resolve().parents[3].joinpath(*module.split(".")).with_suffix(".py")

"""What is imported on demand: public names of a package, libraries that only one feature needs, and
what installed packages register.

The working directory is no installed package, whatever it holds.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from functools import lru_cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

from alpasim_plugin.core.errors import InputError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


def lazy_names(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a module's ``__getattr__`` (PEP 562).

    Args:
        package: The module's ``__name__``.
        homes: Public name -> module that defines it, relative to the package where it begins with a
            dot.
    """

    def get(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(homes[name], package), name)

    return get


def require_library(module: str, with_what: str, do_this: str) -> Any:
    """Import an optional library.

    Args:
        module: Name of its module.
        with_what, do_this: Parts of the error.

    Raises:
        InputError: It is not installed, or cannot be imported.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise InputError(
            f"{with_what}: the library {module.partition('.')[0]} cannot be imported: {error}",
            do_this,
        ) from error


def installed(group: str) -> Mapping[str, EntryPoint]:
    """Return what the installed packages register in a group of entry points, by name; nothing of
    theirs is imported.

    A folder that was received from somebody may hold a distribution's metadata, which make no
    installed package.
    """
    return {point.name: point for point in _points(group, _search_path())}


def installed_points(group: str) -> tuple[EntryPoint, ...]:
    """Return the entry points of a group; a name that two packages claim stands in it twice."""
    return _points(group, _search_path())


def installed_names(group: str, taken: Mapping[str, str]) -> dict[str, str]:
    """Return what installed packages register in a group: name to ``package.module:attribute``.
    Nothing of theirs is imported.

    Args:
        group: Entry-point group, ``simrun.policies``.
        taken: Names that are taken, with the target of each; the same target may be given again.

    Raises:
        InputError: Two packages claim one name.
    """
    targets: dict[str, str] = {}
    for point in _points(group, _search_path()):
        other = targets.get(point.name, taken.get(point.name))
        if other is not None and other != point.value:
            raise InputError(
                f"entry point {point.name!r} = {point.value!r}: the name is taken by {other}",
                "uninstall one of the two packages or rename its entry point",
            )
        targets[point.name] = point.value
    return targets


def _search_path() -> tuple[str, ...]:
    working_folder = os.path.realpath(os.getcwd())
    return tuple(
        folder for folder in sys.path if folder and os.path.realpath(folder) != working_folder
    )


@lru_cache(maxsize=64)
def _points(group: str, path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """Return the entry points of a group; of two distributions of one name the first on the path
    counts.

    Scanning the installed packages takes tens of milliseconds and changes only with the import
    path.
    """
    from importlib.metadata import distributions

    names = set[str]()
    entry_points: list[EntryPoint] = []
    for distribution in distributions(path=list(path)):
        points = distribution.entry_points.select(group=group)
        if points and distribution.name not in names:  # the name takes long to read
            names.add(distribution.name)
            entry_points += points
    return tuple(entry_points)

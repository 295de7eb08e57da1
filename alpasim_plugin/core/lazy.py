"""Imported on first use: public names of a package, so that naming one does not load all, and libraries that only one feature needs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

from alpasim_plugin.core.errors import InputError


def lazy_names(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a module's ``__getattr__`` (PEP 562).

    Args:
        package: The module's ``__name__``.
        homes: Public name -> module that defines it, relative to the package where it begins with a dot.
    """

    def get(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(homes[name], package), name)

    return get


def require_library(module: str, doing: str, with_what: str, do_this: str) -> Any:
    """Import an optional library.

    Args:
        module: Name of its module.
        doing, with_what, do_this: Parts of the error.

    Raises:
        InputError: It is not installed, or cannot be imported.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise InputError(doing, with_what, f"the library {module.partition('.')[0]} cannot be imported: {error}", do_this) from error

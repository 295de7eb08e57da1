"""Libraries that only one feature needs, imported when it is used."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from alpasim_plugin.core.errors import InputError


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

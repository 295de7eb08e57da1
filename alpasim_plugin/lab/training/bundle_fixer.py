"""The fixer that a bundle of weights is for."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.reading import kind_of
from alpasim_plugin.fixers.bundle import bundle_header


def bundle_fixer(path: str | Path) -> tuple[str, tuple[str, ...]]:
    """Return the fixer that a bundle is for and the overrides that make its settings those of the
    weights, the bundle included.

    Raises:
        InputError: Not a bundle.
    """
    _, trained_with = bundle_header(path)
    name = trained_with.pop("name")
    if not isinstance(name, str):
        raise InputError(
            f"{path}, settings in its header: name: {kind_of(name)}",
            "give a file that save_bundle wrote",
        )
    return name, (
        *(f"{key}={json.dumps(value)}" for key, value in _leaves(trained_with).items()),
        f"weights.bundle={json.dumps(str(Path(path).absolute()))}",
    )


def _leaves(data: Mapping[str, object], prefix: str = "") -> dict[str, object]:
    """Return the leaves of nested settings by dotted key."""
    out: dict[str, object] = {}
    for key, value in data.items():
        if isinstance(value, Mapping):
            out |= _leaves(value, f"{prefix}{key}.")
        else:
            out[f"{prefix}{key}"] = value
    return out

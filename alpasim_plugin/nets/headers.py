"""Headers of safetensors files, read without torch."""

from __future__ import annotations

from pathlib import Path

from safetensors import safe_open

from alpasim_plugin.io.limits import WEIGHT_BYTES
from alpasim_plugin.io.reading import check_regular, parsing


def read_metadata(path: str | Path) -> dict[str, str]:
    """Return the text entries in a safetensors file's header.

    Raises:
        InputError: No file, or anything but safetensors (a pickle, for example).
    """
    doing, do = "reading the header of a safetensors file", "give a whole .safetensors file"
    check_regular(path, doing, WEIGHT_BYTES)
    with parsing(doing, path, do, "not safetensors"), safe_open(path, framework="np") as file:
        return dict(file.metadata() or {})

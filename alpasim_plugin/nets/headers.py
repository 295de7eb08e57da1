"""Headers of safetensors files, read without torch."""

from __future__ import annotations

from pathlib import Path

from safetensors import SafetensorError, safe_open

from alpasim_plugin.errors import InputError


def read_metadata(path: str | Path) -> dict[str, str]:
    """Return the text entries in a safetensors file's header.

    Raises:
        InputError: No file, or anything but safetensors (a pickle, for example).
    """
    doing, do = "reading the header of a safetensors file", "give a whole .safetensors file"
    if not Path(path).is_file():
        raise InputError(doing, str(path), "no such file", do)
    try:
        with safe_open(path, framework="np") as file:
            return dict(file.metadata() or {})
    except (SafetensorError, ValueError) as error:
        raise InputError(doing, str(path), f"not safetensors: {error}", do) from error

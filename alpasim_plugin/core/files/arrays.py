"""Arrays: NumPy files (pickles are never read), and headers and checkpoints of weights."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib import format as npy_format

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.limits import WEIGHT_BYTES
from alpasim_plugin.core.files.reading import FETCH_AGAIN, check_regular, open_regular, parsing

if TYPE_CHECKING:
    from torch import Tensor

NO_ARRAY = "no readable NumPy array"
NO_CHECKPOINT = "not a whole checkpoint"
ONE_FILE = "Make one file of tensors of it: docs/fixers.md, Published weights"
START_ANEW = "remove the folder and start again, or put a whole copy of the file there"

Array = np.ndarray[Any, Any]


def parse_npy(data: bytes, location: Path | str, do_this: str = FETCH_AGAIN) -> Array:
    """Return the array of a ``.npy`` document.

    Raises:
        InputError: No NumPy array, one of objects, or less data than its header announces.
    """
    with parsing(location, do_this, NO_ARRAY):
        return npy_format.read_array(io.BytesIO(data), allow_pickle=False)


def open_npy(path: Path | str, do_this: str = FETCH_AGAIN) -> Array:
    """Return a ``.npy`` file as a read-only memory map; see `parse_npy` for what is refused."""
    check_regular(path, do_this=do_this)
    with parsing(path, do_this, NO_ARRAY):
        return npy_format.open_memmap(path, mode="r")


def read_npz(path: Path | str, names: Sequence[str], do_this: str = FETCH_AGAIN) -> list[Array]:
    """Return the named arrays of a ``.npz`` file; see `parse_npy` for what is refused."""
    with open_regular(path) as stream, parsing(path, do_this, NO_ARRAY):
        arrays = np.load(stream, allow_pickle=False)
        return [arrays[name] for name in names]


def read_checkpoint(path: Path, facts: str) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Return a checkpoint's header entries and its tensors.

    Args:
        path: The file.
        facts: What the run is made of; the entry ``facts`` of the header must equal it.

    Raises:
        InputError: No file, a damaged one, or one of another run.
    """
    from safetensors.torch import load_file

    metadata = read_metadata(path, START_ANEW)
    if metadata.get("facts") != facts:
        raise InputError(
            f"{path}: it was begun as {metadata.get('facts')}, this is {facts}",
            "choose another folder",
        )
    with parsing(path, START_ANEW, NO_CHECKPOINT):
        return metadata, load_file(str(path))


def refuse_shards(path: Path) -> None:
    """Refuse weights that are a folder of shards, or the index of one.

    Raises:
        InputError: They are.
    """
    if os.path.isdir(path) or path.name.endswith(".index.json"):
        raise InputError(f"{path}: a checkpoint in shards, not one file", ONE_FILE)


def read_metadata(
    path: str | Path, do_this: str = "give a whole .safetensors file"
) -> dict[str, str]:
    """Return the text entries in a safetensors file's header.

    Raises:
        InputError: No file, or anything but safetensors (a pickle, for example).
    """
    from safetensors import safe_open

    check_regular(path, WEIGHT_BYTES)
    with parsing(path, do_this, "not safetensors"), safe_open(path, framework="np") as file:
        return dict(file.metadata() or {})

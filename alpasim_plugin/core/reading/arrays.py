"""Arrays: NumPy files, whose header is compared with their size before memory is taken (pickles are
never read), and files of weights.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.lib import format as npy_format

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.limits import FILE_BYTES, WEIGHT_BYTES, Bound
from alpasim_plugin.core.reading.files import FETCH_AGAIN, check_regular, open_regular, parsing

if TYPE_CHECKING:
    from torch import Tensor

Array = np.ndarray[Any, Any]

LONGEST_HEADER = 1 << 16  # bytes; NumPy itself refuses headers of more than 10,000


def parse_npy(data: bytes, where: Path | str, do_this: str = FETCH_AGAIN) -> Array:
    """Return the array of a ``.npy`` document.

    Raises:
        InputError: No NumPy array, one of objects, or less data than its header announces.
    """
    stream = io.BytesIO(data)
    with parsing(where, do_this, "no readable NumPy array"):
        _check_header(stream, len(data), where, do_this)
        stream.seek(0)
        return np.asarray(np.load(stream, allow_pickle=False))


def open_npy(path: Path | str, do_this: str = FETCH_AGAIN, bound: Bound = FILE_BYTES) -> Array:
    """Return a ``.npy`` file as a read-only memory map; see `parse_npy` for what is refused."""
    with (
        open_regular(path, bound, do_this) as stream,
        parsing(path, do_this, "no readable NumPy array"),
    ):
        size = stream.seek(0, io.SEEK_END)
        stream.seek(0)
        # A header may claim any length; a file gives the memory for it before it looks how much
        # there is.
        _check_header(io.BytesIO(stream.read(LONGEST_HEADER)), size, path, do_this)
    with parsing(path, do_this, "no readable NumPy array"):
        array: Array = np.load(path, mmap_mode="r", allow_pickle=False)
        return array


def _check_header(stream: IO[bytes], size: int, where: Path | str, do_this: str) -> None:
    version = npy_format.read_magic(stream)
    read = (
        npy_format.read_array_header_1_0 if version == (1, 0) else npy_format.read_array_header_2_0
    )
    shape, _, dtype = read(stream)
    need = dtype.itemsize
    for side in shape:  # Python integers, which do not overflow
        need *= int(side)
    present = size - stream.tell()
    if dtype.hasobject or min(shape, default=0) < 0 or need > present:
        found = (
            "an array of Python objects"
            if dtype.hasobject
            else f"{present} bytes for {dtype} {shape} of {need}"
        )
        raise InputError(f"{where}: no readable NumPy array: {found}", do_this)


START_ANEW = "remove the folder and start again, or put a whole copy of the file there"


def read_checkpoint(path: Path, facts: str) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Return a checkpoint's header entries and its tensors.

    Args:
        path: The file.
        facts: What the run is made of; the entry ``facts`` of the header must equal it.

    Raises:
        InputError: No file, a damaged one, or one of another run.
    """
    from safetensors import safe_open
    from safetensors.torch import load_file

    check_regular(path, WEIGHT_BYTES)
    with parsing(path, START_ANEW, "not a whole checkpoint"):
        with safe_open(str(path), "np") as file:
            meta = dict(file.metadata() or {})
        begun = meta["facts"]
    if begun != facts:
        raise InputError(
            f"{path}: it was begun as {begun}, this is {facts}", "choose another folder"
        )
    with parsing(path, START_ANEW, "not a whole checkpoint"):
        return meta, load_file(str(path))


def read_metadata(path: str | Path) -> dict[str, str]:
    """Return the text entries in a safetensors file's header.

    Raises:
        InputError: No file, or anything but safetensors (a pickle, for example).
    """
    from safetensors import safe_open

    do = "give a whole .safetensors file"
    check_regular(path, WEIGHT_BYTES)
    with parsing(path, do, "not safetensors"), safe_open(path, framework="np") as file:
        return dict(file.metadata() or {})

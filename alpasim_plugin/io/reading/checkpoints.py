"""Checkpoints of training runs and fits: safetensors files whose header says what they belong to."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from safetensors import safe_open

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.limits import WEIGHT_BYTES
from alpasim_plugin.io.reading.files import check_regular, parsing

if TYPE_CHECKING:
    from torch import Tensor

START_ANEW = "remove the folder and start again, or put a whole copy of the file there"


def read_checkpoint(path: Path, doing: str, facts: str) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Return a checkpoint's header entries and its tensors.

    Args:
        path: The file.
        doing: What the caller is doing, for messages.
        facts: What the run is made of; the entry ``facts`` of the header must equal it.

    Raises:
        InputError: No file, a damaged one, or one of another run.
    """
    from safetensors.torch import load_file

    check_regular(path, doing, WEIGHT_BYTES)
    with parsing(doing, path, START_ANEW, "not a whole checkpoint"):
        with safe_open(str(path), "np") as file:
            meta = dict(file.metadata() or {})
        begun = meta["facts"]
    if begun != facts:
        raise InputError(doing, str(path), f"it was begun as {begun}, this is {facts}", "choose another folder")
    with parsing(doing, path, START_ANEW, "not a whole checkpoint"):
        return meta, load_file(str(path))

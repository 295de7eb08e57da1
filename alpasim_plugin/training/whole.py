"""Write training data whole or not at all: an interrupted process leaves nothing that looks finished."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from alpasim_plugin.errors import InfrastructureError


@contextmanager
def whole_folder(folder: Path, doing: str) -> Iterator[Path]:
    """Give a folder to write into that takes the place of ``folder`` once the block has ended well, and is removed otherwise.

    Raises:
        InfrastructureError: The disk refuses.
    """
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    try:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        yield partial
        shutil.rmtree(folder, ignore_errors=True)
        partial.replace(folder)
    except OSError as error:
        raise InfrastructureError(doing, str(folder), str(error), "make room, or choose another folder") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def save_array(path: Path, array: npt.NDArray[Any]) -> None:
    """Write one ``.npy`` file.

    Raises:
        InfrastructureError: The disk refuses.
    """
    partial = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        with partial.open("wb") as file:
            np.save(file, array)
        partial.replace(path)
    except OSError as error:
        raise InfrastructureError("writing training data", str(path), str(error), "make room, or choose another folder") from error
    finally:
        partial.unlink(missing_ok=True)

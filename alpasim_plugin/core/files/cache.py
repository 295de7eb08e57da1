"""Folders of the cache, each made once, by the first process that needs it, while the others wait.

CACHE / KIND / KEY/        what was made; it appears atomically
             / KEY.lock     held by the process that makes it
"""

import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import places
from alpasim_plugin.core.files.atomic import atomic_folder, restore_folder
from alpasim_plugin.core.files.lock import one_writer
from alpasim_plugin.core.printing import warn

DO_THIS = "free disk space, or name a writable folder in SIMRUN_CACHE"

T = TypeVar("T")


def cached(
    kind: str,
    key: str,
    make: Callable[[Path], None],
    read: Callable[[Path], T],
    title: str,
) -> T:
    """Return what ``read`` finds under a key, made first if it is not there.

    Several processes may ask at once: one makes it, the others wait. A folder that ``read`` refuses
    is made anew, with a warning.

    Args:
        kind: Sub-folder of the cache.
        key: Name by content.
        make: Fills an empty folder.
        read: Reads a filled one.
        title: What is made, for the lines on standard error.

    Raises:
        InfrastructureError: The cache cannot be written.
        InputError: What was just made cannot be read.
    """
    folder = places.cache() / kind / key
    if os.path.exists(folder):
        try:
            return read(folder)
        except InputError as error:
            warn(f"warning: {title} is damaged ({error.message}); making it again")
    with one_writer(
        folder.with_name(f"{key}.lock"), title, wait=True, waiting=warn, do_this=DO_THIS
    ):
        # of a process that was killed while it made this entry
        for left_over in folder.parent.glob(f".{key}.*.tmp"):
            shutil.rmtree(left_over)
        restore_folder(folder)
        if os.path.exists(folder):
            try:
                return read(folder)
            except InputError:
                pass  # damaged, and said above
        warn(f"{title} ...")
        began = time.perf_counter()
        with atomic_folder(folder) as partial:
            make(partial)
        warn(f"{title}: {time.perf_counter() - began:.1f} s")
        return read(folder)

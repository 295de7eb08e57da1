"""Compile loops over arrays with Numba: to machine code that is kept on disk, and that runs beside
other threads.

Machine code lies in a folder that is named by the sources which it was made of, Numba's version and
the processor: a constant that was changed in another file compiles the kernels that use it, and an
edit elsewhere compiles nothing. Folders of sources that are no more may be removed.

Numba reads its index of a folder, adds to it and writes it without a lock: of two processes that
compile one kernel for different types at once, one would overwrite the machine code of the other.
So one process at a time compiles, and the others find afterwards what it has compiled.
"""

from __future__ import annotations

import fcntl
import hashlib
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numba
from llvmlite import binding
from numba.core import event

from alpasim_plugin.core.kernel_sources import sources_digest

# As `alpasim_plugin.core.files.places` has chosen it; inside the package where it named none.
KEPT = numba.config.CACHE_DIR or Path(__file__).parents[1] / "__pycache__" / "kernels"
LOCK = ".compiling.lock"
Maker = Callable[[Callable[..., Any]], Any]


class OneCompiler(event.Listener):  # type: ignore[misc]  # Numba has no types
    """Holds a lock file while a thread of this process has Numba's lock of the compiler, which
    covers reading the cache, compiling and writing the cache.

    Where the lock file cannot be written or locked, nothing is kept beside it either.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / LOCK
        self._of_thread = threading.local()

    def on_start(self, event: event.Event) -> None:
        """Wait until no other process compiles; Numba's lock is taken several times over."""
        depth = getattr(self._of_thread, "depth", 0)
        if depth == 0:
            self._of_thread.file = self._locked_file()
        self._of_thread.depth = depth + 1

    def on_end(self, event: event.Event) -> None:
        """Let other processes compile when Numba's lock is given back for the last time."""
        self._of_thread.depth -= 1
        if self._of_thread.depth == 0 and self._of_thread.file is not None:
            self._of_thread.file.close()

    def _locked_file(self) -> BinaryIO | None:
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            file = self._path.open("ab")
            fcntl.flock(file, fcntl.LOCK_EX)
        except OSError:
            return None
        return file


event.register("numba:compiler_lock", OneCompiler(Path(KEPT)))


def kernel_maker(**options: Any) -> Maker:
    """Return what compiles a function on its first call, with options of Numba's ``njit``."""

    def compiled(function: Callable[..., Any]) -> Any:
        with _kept_in(folder_of(function.__code__.co_filename)):
            return numba.njit(cache=True, nogil=True, **options)(function)

    return compiled


def folder_of(file: str) -> Path:
    """Return the folder for the machine code of the kernels of a source file."""
    made_by = f"{numba.__version__} {binding.get_host_cpu_name()}"
    key = hashlib.sha256(f"{sources_digest(file, Path(KEPT))} {made_by}".encode()).hexdigest()
    return Path(KEPT) / f"{Path(file).stem}-{key[:16]}"


@contextmanager
def _kept_in(folder: Path) -> Iterator[None]:
    """Let what is compiled with a cache in the block be kept in a folder; Numba chooses it when a
    function is decorated.
    """
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(folder)
    try:
        yield
    finally:
        numba.config.CACHE_DIR = before


kernel = kernel_maker()
# Divides by zero as numpy does, without a branch for the exception.
float_kernel = kernel_maker(error_model="numpy")
inlined_kernel = kernel_maker(inline="always")
inlined_float_kernel = kernel_maker(error_model="numpy", inline="always")
# Sums in any order, and multiplies and adds in one step.
vector_kernel = kernel_maker(error_model="numpy", fastmath={"contract", "reassoc"})

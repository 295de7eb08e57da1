"""Compile loops over arrays with Numba: to machine code that is kept on disk, and that runs beside
other threads.

Machine code lies in a folder that is named by the sources which it was made of, Numba's version and
the processor: a constant that was changed in another file compiles the kernels that use it, and an
edit elsewhere compiles nothing. Folders of sources that are no more may be removed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numba
from llvmlite import binding

from alpasim_plugin.core.kernel_sources import sources_digest

# As `alpasim_plugin.core.files.places` has chosen it; inside the package where it named none.
KEPT = numba.config.CACHE_DIR or Path(__file__).parents[1] / "__pycache__" / "kernels"
Maker = Callable[[Callable[..., Any]], Any]


def kernel_maker(**options: Any) -> Maker:
    """Return what compiles a function on its first call, with options of Numba's ``njit``."""

    def compiled(function: Callable[..., Any]) -> Any:
        with _kept_in(folder_of(function.__code__.co_filename)):
            return numba.njit(cache=True, nogil=True, **options)(function)

    return compiled


def folder_of(file: str) -> Path:
    """Return the folder for the machine code of the kernels of a source file."""
    made_by = f"{numba.__version__} {binding.get_host_cpu_name()}"
    key = hashlib.sha256(f"{sources_digest(file)} {made_by}".encode()).hexdigest()
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

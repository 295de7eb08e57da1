"""Compile loops over arrays with Numba: to machine code that is kept on disk, and that runs beside
other threads.
"""

from numba import njit

kernel = njit(cache=True, nogil=True)
# Divides by zero as numpy does, without a branch for the exception.
float_kernel = njit(cache=True, nogil=True, error_model="numpy")
inlined_kernel = njit(cache=True, nogil=True, inline="always")

"""Where files go that nobody named: one choice, made when the package is imported, before numba is.

cache    $SIMRUN_CACHE; the user's cache folder (`platformdirs`); a private temporary folder
kernels  $NUMBA_CACHE_DIR; in the package's __pycache__; numba below the cache

Kernels are pickles, which run code when they are read. So a folder that nobody named must be this
user's own: ``sudo`` leaves the home of another user in the environment.
"""

import atexit
import os
import shutil
import tempfile
import traceback
from pathlib import Path

from platformdirs import user_cache_path

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.core.printing import warn

PACKAGE = Path(__file__).resolve().parents[2]
CACHE = "SIMRUN_CACHE"
KERNELS = "NUMBA_CACHE_DIR"
INTERPRETED = "NUMBA_DISABLE_JIT"
HINT = f"name a writable folder in {CACHE}, and one for temporary files in TMPDIR"


def cache() -> Path:
    """Return the folder of what is kept between runs; it need not exist, and one that was named may
    turn out not to be writable.
    """
    named = os.environ.get(CACHE)
    return Path(named).expanduser() if named else user_cache_path("simrun")


def kernels() -> Path:
    """Return the folder of compiled kernels, as `prepare` left it."""
    return Path(os.environ.get(KERNELS) or PACKAGE / "__pycache__" / "kernels")


def prepare() -> None:
    """Choose cache and kernels for this process and those that it starts, in the environment; call
    it before numba is imported.

    Where no folder is this user's own, a private temporary one is made, which goes with this
    process; where none can be made, kernels are not compiled.
    """
    if not os.environ.get(CACHE) and not _is_own(cache()):
        try:
            folder = tempfile.mkdtemp(prefix="simrun-cache-")
        except OSError:
            os.environ[INTERPRETED] = "1"  # or the import of a kernel would fail
            return
        os.environ[CACHE] = folder
        atexit.register(_remove, folder, os.getpid())
    named = os.environ.get(KERNELS)
    if named and not is_writable(Path(named)):
        warn(f"warning: {KERNELS} names {named}, which cannot be written")
        del os.environ[KERNELS]
    if not os.environ.get(KERNELS) and not os.access(PACKAGE, os.W_OK):
        os.environ[KERNELS] = str(cache() / "numba")


def require_kernels() -> None:
    """Refuse to compute where kernels cannot be compiled: it would take a thousand times as long,
    and some cannot run.

    Raises:
        InfrastructureError: `prepare` found no folder for them.
    """
    if os.environ.get(INTERPRETED) and not is_writable(cache()):
        raise InfrastructureError("the cache of kernels: no folder can be written", HINT)


def damaged_kernels(error: BaseException) -> InfrastructureError | None:
    """Return the error in place of one that reading a compiled kernel raised; None for others."""
    files = [frame.filename for frame in traceback.extract_tb(error.__traceback__)]
    if not any(file.endswith(os.path.join("numba", "core", "caching.py")) for file in files):
        return None
    return InfrastructureError(
        f"compiled kernels below {kernels()}: they cannot be read ({error})",
        "remove the files *.nbi and *.nbc there; they are compiled again",
    )


def temporary_folder(prefix: str) -> tempfile.TemporaryDirectory[str]:
    """Return a new folder that goes with its ``with`` block, as `tempfile.TemporaryDirectory` does.

    Raises:
        InfrastructureError: There is no folder for temporary files, or its disk is full.
    """
    try:
        return tempfile.TemporaryDirectory(prefix=prefix)
    except OSError as error:
        raise InfrastructureError(f"the folder for temporary files: {error}", HINT) from error


def is_writable(path: Path) -> bool:
    """Tell whether this user may write a folder, or make it."""
    nearest = _nearest(path)
    return os.path.isdir(nearest) and os.access(nearest, os.W_OK | os.X_OK)


def _is_own(path: Path) -> bool:
    """Tell whether a folder, or the one that it would be made in, is this user's, and nobody else
    may write it.
    """
    state = _nearest(path).stat()
    return is_writable(path) and state.st_uid == os.getuid() and not state.st_mode & 0o002


def _nearest(path: Path) -> Path:
    """Return the path, or the nearest folder above it that can be seen."""
    return next(folder for folder in (path, *path.absolute().parents) if os.path.exists(folder))


def _remove(folder: str, maker: int) -> None:
    if os.getpid() == maker:  # not a child that was forked
        shutil.rmtree(folder, ignore_errors=True)

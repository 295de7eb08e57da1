"""Where files go that nobody named: one choice, made when the package is imported, before numba is.

cache    $SIMRUN_CACHE; simrun below $XDG_CACHE_HOME or ~/.cache; a private temporary folder; nowhere
kernels  $NUMBA_CACHE_DIR; beside their source; numba below the cache

Kernels are pickles, which run code when they are read. So a
folder that nobody named must be this user's own, as must the folder that it is made in: ``sudo``
leaves the home of another user in the environment.
"""

from __future__ import annotations

import atexit
import os
import shutil
import stat
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from alpasim_plugin.core.errors import InfrastructureError

if TYPE_CHECKING:
    from tempfile import TemporaryDirectory

PACKAGE = Path(__file__).resolve().parents[1]
CACHE = "SIMRUN_CACHE"
KERNELS = "NUMBA_CACHE_DIR"
TEMPORARY = "simrun-cache-"  # then the process that made it
INTERPRETED = "NUMBA_DISABLE_JIT"
DO_THIS = f"name a writable folder in {CACHE}, and one for temporary files in TMPDIR"

_temporary: Path | None = None  # of this process
_notes: dict[str, str] = {}  # variable -> why this process set it


@dataclass(frozen=True)
class Place:
    """A folder, and why it was chosen; None where no folder can be written."""

    path: Path | None
    chosen: str

    def __str__(self) -> str:
        return f"{self.path or 'nowhere'} ({self.chosen})"


def cache() -> Place:
    """Return the folder of what is kept between runs; it need not exist, and one that was named may
    turn out not to be writable.
    """
    return (
        _named(CACHE)
        or _own_below("XDG_CACHE_HOME", ".cache")
        or Place(None, "no folder can be written")
    )


def kernels() -> Place:
    """Return the folder of compiled kernels, as `prepare` left it."""
    beside = Place(PACKAGE, "beside their source") if INTERPRETED not in _notes else None
    return (
        _named(KERNELS)
        or beside
        or Place(None, "no folder can be written: kernels are not compiled")
    )


def prepare() -> None:
    """Choose cache and kernels for this process and those that it starts, in the environment; call
    it before numba is imported.

    Where neither the home nor the source can be written, a private temporary folder is made. It
    goes with this process.
    """
    if cache().path is None:
        _set(CACHE, _make_temporary(), "a private temporary folder, as no other can be written")
    named = os.environ.get(KERNELS)
    if named and not _is_usable(Path(named)):
        print(
            f"warning: {KERNELS} names {named}, which cannot be written; another folder is used",
            file=sys.stderr,
            flush=True,
        )
        del os.environ[KERNELS]
        named = None
    if named or os.access(PACKAGE, os.W_OK):
        return
    kept = cache().path
    folder = kept if kept is not None and _is_usable(kept) else _make_temporary()
    _set(
        KERNELS,
        folder and folder / "numba",
        "below the cache" if folder == kept else "a private temporary folder",
    )
    if folder is None:
        _set(INTERPRETED, "1", "or the import of a kernel would fail")
    elif folder == _temporary:
        os.environ.setdefault("MPLCONFIGDIR", str(folder / "matplotlib"))


def nothing_is_writable() -> bool:
    """Tell whether `prepare` found no folder at all that this process can write."""
    return INTERPRETED in _notes


def require_kernels() -> None:
    """Refuse to compute where kernels cannot be compiled: it would take a thousand times as long,
    and some cannot run.

    Raises:
        InfrastructureError: `prepare` found no folder for them.
    """
    if nothing_is_writable():
        raise InfrastructureError("the cache of kernels: no folder can be written", DO_THIS)


def temporary_folder(prefix: str) -> TemporaryDirectory[str]:
    """Return a new folder that goes with its ``with`` block, as `tempfile.TemporaryDirectory` does.

    Raises:
        InfrastructureError: There is no folder for temporary files, or its disk is full.
    """
    import tempfile

    root = _temporary_root()
    try:
        return tempfile.TemporaryDirectory(prefix=prefix, dir=root)
    except OSError as error:
        raise InfrastructureError(f"{root}: {error.strerror or str(error)}", DO_THIS) from error


def _temporary_root() -> Path:
    import tempfile

    try:
        return Path(tempfile.gettempdir())
    except FileNotFoundError as error:
        raise InfrastructureError(
            "TMPDIR, /tmp, /var/tmp: none of them can be written", DO_THIS
        ) from error


def trouble_of(place: Place) -> str:
    """Say why a place cannot serve; empty where it can."""
    if place.path is None:
        return "nothing is kept"
    if not _is_usable(place.path):
        return "it cannot be written"
    found = _nearest(place.path).stat()
    is_sticky = bool(found.st_mode & stat.S_ISVTX)
    return "every user may write it" if found.st_mode & stat.S_IWOTH and not is_sticky else ""


def is_private(path: Path) -> bool:
    """Tell whether a path is a folder, not a link, that only this user can write; it is made where
    it is missing.
    """
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = path.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022


def _named(variable: str) -> Place | None:
    named = os.environ.get(variable)
    return Place(Path(named).expanduser(), _notes.get(variable, variable)) if named else None


def _own_below(variable: str, default: str) -> Place | None:
    """Return our folder below one of the user's standard folders, where this user may write it and
    owns what it lies in.
    """
    root = os.environ.get(variable, "")
    folder = Path(
        root if os.path.isabs(root) else os.path.expanduser(f"~/{default}"), "simrun"
    )  # the standard ignores relative paths
    if not folder.is_absolute() or not _is_usable(folder):
        return None
    found = _nearest(folder).stat()
    is_own = found.st_uid == os.getuid() and not found.st_mode & stat.S_IWOTH
    return (
        Place(folder, variable if os.path.isabs(root) else "below the home folder")
        if is_own
        else None
    )


def _nearest(path: Path) -> Path:
    """Return the path, or the nearest folder above it that exists."""
    return next(one for one in (path, *path.absolute().parents) if _exists(one))


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # in a folder that may not be searched
        return False


def _is_usable(path: Path) -> bool:
    """Tell whether this user may write a folder, or make it."""
    nearest = _nearest(path)
    return nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK)


def _set(variable: str, value: Path | str | None, why: str) -> None:
    if value is not None:
        os.environ[variable], _notes[variable] = str(value), why


def _make_temporary() -> Path | None:
    """Make the private folder of this process, once, after those that killed processes have
    left.
    """
    global _temporary
    if _temporary is None:
        import tempfile

        from alpasim_plugin.core.processes import is_running

        with suppress(OSError):
            for old in Path(tempfile.gettempdir()).glob(f"{TEMPORARY}*"):
                pid = old.name.removeprefix(TEMPORARY).partition("-")[0]
                if pid.isdigit() and not is_running(int(pid)) and is_private(old):
                    shutil.rmtree(old, ignore_errors=True)
            _temporary = Path(tempfile.mkdtemp(prefix=f"{TEMPORARY}{os.getpid()}-"))
            atexit.register(_remove, _temporary, os.getpid())
    return _temporary


def _remove(folder: Path, maker: int) -> None:
    if os.getpid() == maker:  # not a child that was forked
        shutil.rmtree(folder, ignore_errors=True)

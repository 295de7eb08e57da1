"""Write files atomically: under a temporary name in the same folder, then renamed, so that a reader
never sees an incomplete file.

A process that is killed leaves at most a hidden ``.NAME.PID.MACHINE.tmp`` behind, which the next
process that writes into the folder removes; what stood at the path before is untouched.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import json
import os
import platform
import re
import shutil
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from alpasim_plugin.core.errors import InfrastructureError, InputError, SimrunError

if TYPE_CHECKING:
    import numpy.typing as npt
    from torch import Tensor

DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
BACKUP = ".simrun-backup"
MOMENT_S = 0.4  # for a process between the two renames of a folder
WORKING_FOLDER = -100  # of Linux's renameat2, like the next
EXCHANGE = 2
# The number of a process, its machine, and what is different at every call.
TEMPORARY = re.compile(r"\..+\.(\d{1,9})\.([0-9a-f]{8})[0-9a-f]{8}\.tmp")
OWN_PROCESSES = "/proc/self/ns/pid"  # on Linux: where process numbers are those of this process
NO_PATH = (errno.ELOOP, errno.ENAMETOOLONG, errno.ENOTDIR, errno.EISDIR, errno.EEXIST)


def disk_error(path: Path, error: OSError, do_this: str | None = None) -> SimrunError:
    """Return the error of a failed write: of the input where no machine could write such a path,
    else of the machine. The hint follows from the cause unless ``do_this`` is given.
    """
    if error.errno in NO_PATH:
        return InputError(f"{path}: {error.strerror}", do_this or "name another path")
    if error.errno in DISK_FULL:
        hint = "free disk space and run the same command again"
    else:
        hint = "check that the folder exists and is writable, or name another one"
    return InfrastructureError(f"{path}: {error.strerror or str(error)}", do_this or hint)


def temporary_path(path: Path) -> Path:
    """Return a hidden name in the same folder, different in every process and for every call.

    At the first one in a folder, what killed processes of this machine left there is removed.
    """
    _tidy(path.parent)
    return path.with_name(f".{path.name}.{os.getpid()}.{_machine()}{os.urandom(4).hex()}.tmp")


_tidied: set[str] = set()  # folders, by this process


def _tidy(folder: Path) -> None:
    """Remove what killed processes of this machine left in a folder, once a process."""
    place = os.path.abspath(folder)
    if place in _tidied:
        return
    _tidied.add(place)
    with contextlib.suppress(OSError):  # it cannot be read: the write that follows says why
        for name in os.listdir(folder):
            if is_left_over(name):
                with contextlib.suppress(OSError):  # another process has removed it just now
                    remove(folder / name)


def is_left_over(name: str, of_any_machine: bool = False) -> bool:
    """Tell whether a file or folder has a temporary name of a process that is gone.

    Args:
        name: Without its folder.
        of_any_machine: Whoever holds the lock of a folder knows that no other machine writes there;
            else only the names of processes of this machine are recognised.
    """
    matched = TEMPORARY.fullmatch(name)
    if matched is None or not (of_any_machine or matched[2] == _machine()):
        return False
    try:
        os.kill(int(matched[1]), 0)
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):  # another user's, or no number of a process
        return False
    return False


@cache
def _machine() -> str:
    """Return eight digits that differ where process numbers mean other processes."""
    namespace = 0
    with contextlib.suppress(OSError):
        namespace = os.stat(OWN_PROCESSES).st_ino
    return f"{zlib.crc32(f'{platform.node()} {namespace}'.encode()):08x}"


@contextmanager
def atomic_file(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path to write; it is renamed to ``path`` when the block ends, and removed
    if the block raises.

    The folder must exist. The data are on the disk (fsync) before the rename.

    Raises:
        InfrastructureError: The disk refuses.

    Example:
        >>> with atomic_file("scene.png") as partial:     # doctest: +SKIP
        ...     cv2.imwrite(str(partial), image)
    """
    path = Path(path)
    partial = temporary_path(path)
    try:
        yield partial
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        raise disk_error(path, error) from error
    finally:
        # A read-only folder refuses this as well, even for a file that is not there; the write's
        # own error says so.
        with contextlib.suppress(OSError):
            partial.unlink()


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Yield a new empty folder; it replaces ``folder`` when the block ends, and is removed if the
    block raises.

    The two change places in one step where the file system can do that. Elsewhere a folder cannot be
    renamed onto an existing one: the existing one is renamed to a backup first, and where the process
    is killed between the two renames, `restore_folder` brings the backup back.

    Raises:
        InfrastructureError: The disk refuses.
    """
    partial = temporary_path(folder)
    old = _backup_of(folder)
    try:
        restore_folder(folder)
        partial.mkdir(parents=True)
        yield partial
        if not os.path.exists(folder):
            partial.replace(folder)
        elif not _change_places(partial, folder):
            remove(old)
            folder.replace(old)
            partial.replace(folder)
    except OSError as error:
        with contextlib.suppress(InfrastructureError):
            restore_folder(folder)
        raise disk_error(folder, error) from error
    finally:
        remove(partial)
        if os.path.exists(folder):
            remove(old)


def _change_places(first: Path, second: Path) -> bool:
    """Let two paths change places in one step, so that neither is ever missing; return whether this
    system and the file system can do that.
    """
    try:
        rename = ctypes.CDLL(None).renameat2
    except (AttributeError, OSError):  # another system than Linux
        return False
    paths = os.fsencode(first.absolute()), os.fsencode(second.absolute())
    return bool(rename(WORKING_FOLDER, paths[0], WORKING_FOLDER, paths[1], EXCHANGE) == 0)


def remove(path: Path) -> None:
    """Remove a file, a link, or a folder with all that it holds, if it is there."""
    if os.path.isdir(path) and not os.path.islink(path):
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _backup_of(folder: Path) -> Path:
    """Return the name of the backup of a folder that is being replaced."""
    return folder.with_name(f".{folder.name}{BACKUP}")


def restore_folder(folder: Path) -> None:
    """Bring back the backup that `atomic_folder` had made when its process was killed; whoever
    looks for a folder that is written so calls this first.

    A process that is just about to put the new folder there is given a moment.

    Raises:
        InfrastructureError: The disk refuses.
    """
    old = _backup_of(folder)
    until_s = time.monotonic() + MOMENT_S
    try:
        while os.path.exists(old) and not os.path.exists(folder):
            if time.monotonic() > until_s:
                old.replace(folder)
            time.sleep(MOMENT_S / 10)
    except FileNotFoundError:  # another process has brought it back
        return
    except OSError as error:
        raise disk_error(folder, error) from error


def restore_folders(parent: Path) -> None:
    """Bring back the backups of all folders in a folder; whoever lists folders that are written with
    `atomic_folder` calls this first. See `restore_folder`.
    """
    for old in parent.glob(f".*{BACKUP}"):
        restore_folder(old.with_name(old.name[1:].removesuffix(BACKUP)))


@contextmanager
def scratch_folder(path: Path) -> Iterator[Path]:
    """Yield a new empty folder with a temporary name beside ``path``; it is removed when the block
    ends.

    Raises:
        InfrastructureError: The disk refuses to make it.
    """
    scratch = temporary_path(path)
    try:
        scratch.mkdir(parents=True)
    except OSError as error:
        raise disk_error(scratch, error) from error
    try:
        yield scratch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file atomically; its folder is made if it does not exist.

    Raises:
        InfrastructureError: The disk refuses (full, read-only, quota).
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise disk_error(path.parent, error) from error
    with atomic_file(path) as partial:
        partial.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically; see `write_bytes`."""
    write_bytes(path, text.encode())


def write_json(path: Path, value: Any) -> None:
    """Write JSON atomically; see `write_bytes`.

    Raises:
        ValueError: NaN or infinity, which JSON does not have.
    """
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def write_array(path: Path, array: npt.NDArray[Any]) -> None:
    """Write a ``.npy`` file atomically; see `atomic_file`."""
    import numpy as np

    with atomic_file(path) as partial, partial.open("wb") as file:
        np.save(file, array)


def write_safetensors(
    path: Path | str, tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None
) -> None:
    """Write tensors as safetensors atomically; see `atomic_file`. Equal content gives equal bytes."""
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    with atomic_file(path) as partial:
        try:
            save_file(
                {name: value.detach().cpu().contiguous() for name, value in tensors.items()},
                partial,
                dict(metadata or {}),
            )
        except SafetensorError as error:  # a refused write, among others
            raise OSError(errno.EIO, str(error)) from error
        if metadata:
            _sort_metadata(partial)


def _sort_metadata(path: Path) -> None:
    """Put the metadata of a safetensors file in the order of their names; the library has them in
    another order in every process.

    The file begins with the length of its header in eight bytes, then comes the header as JSON.
    """
    with path.open("r+b") as file:
        length = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(length))
        metadata = dict(sorted(header.pop("__metadata__").items()))
        text = json.dumps(
            {"__metadata__": metadata, **header}, separators=(",", ":"), ensure_ascii=False
        )
        file.seek(8)
        file.write(text.encode().ljust(length))

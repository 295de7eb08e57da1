"""Bytes of a file: a regular file, capped in size, or a four-part error."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from alpasim_plugin.core.errors import InputError, SimrunError
from alpasim_plugin.io.limits import FILE_BYTES, Bound

FETCH_AGAIN = "fetch or write the file again; it may be damaged"
_KINDS = (
    (stat.S_ISDIR, "a folder"), (stat.S_ISFIFO, "a pipe"), (stat.S_ISSOCK, "a socket"), (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)  # fmt: skip


@contextmanager
def open_regular(path: Path | str, doing: str, bound: Bound = FILE_BYTES, do_this: str | None = None) -> Iterator[BinaryIO]:
    """Open a regular file for reading, after checking its kind and size on the open file itself.

    A pipe, socket or device is refused without waiting for its other end.

    Args:
        path: File.
        doing: What the caller is doing, for messages.
        bound: Greatest size.
        do_this: Last part of the errors; None: one that follows from the cause.

    Raises:
        InputError: Missing, unreadable, not a regular file, or larger than the bound.
    """
    try:
        # Without O_NONBLOCK the open of a pipe waits for a writer, for ever.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0))
    except FileNotFoundError as error:
        raise InputError(doing, str(path), "no such file", do_this or "check the path") from error
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise InputError(doing, str(path), f"it cannot be opened: {reason}", do_this or "check the path and its permissions") from error
    facts = os.fstat(handle)
    if not stat.S_ISREG(facts.st_mode):
        os.close(handle)
        kind = next((name for test, name in _KINDS if test(facts.st_mode)), "no regular file")
        raise InputError(doing, str(path), f"{kind}, not a file", do_this or "give a regular file")
    with os.fdopen(handle, "rb") as stream:
        if facts.st_size > bound.high:
            found = f"{facts.st_size} bytes, more than {bound.high:.0f} ({bound.name})"
            raise InputError(doing, str(path), found, "give a smaller file")
        try:
            yield stream
        except OSError as error:
            raise InputError(doing, str(path), f"it cannot be read: {error.strerror or error}", do_this or FETCH_AGAIN) from error


def exists(path: Path | str) -> bool:
    """Return whether something is at a path; a name that no file can have (too long, a null character) is at none."""
    try:
        os.stat(path)
    except (OSError, ValueError):
        return False
    return True


def read_bytes(path: Path | str, doing: str, bound: Bound = FILE_BYTES, do_this: str | None = None) -> bytes:
    """Return a file's bytes; see `open_regular`.

    Raises:
        InputError: As there, or the file grew beyond the bound while it was read.
    """
    parts: list[bytes] = []
    with open_regular(path, doing, bound, do_this) as stream:
        # As much as the file holds, not as the bound allows: a read takes the memory that it is asked for at once.
        size = os.fstat(stream.fileno()).st_size + 1
        while part := stream.read(size):
            parts.append(part)
            if sum(map(len, parts)) > bound.high:
                raise InputError(doing, str(path), f"more than {bound.high:.0f} bytes ({bound.name})", "give a smaller file")
    return b"".join(parts)


def read_text(path: Path | str, doing: str, bound: Bound = FILE_BYTES, do_this: str | None = None) -> str:
    """Return a file's text, UTF-8; see `read_bytes`.

    Raises:
        InputError: As there, or bytes that are not UTF-8.
    """
    data = read_bytes(path, doing, bound, do_this)
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(doing, str(path), f"byte {error.start} is not UTF-8", do_this or "save the file as UTF-8 text") from error


def check_regular(path: Path | str, doing: str, bound: Bound = FILE_BYTES, do_this: str | None = None) -> int:
    """Check a file that a library will open by its path; return its size in bytes. See `open_regular`."""
    with open_regular(path, doing, bound, do_this) as stream:
        return os.fstat(stream.fileno()).st_size


@contextmanager
def parsing(doing: str, where: Path | str, do_this: str = FETCH_AGAIN, what: str = "it cannot be used") -> Iterator[None]:
    """Turn whatever a parser raises into the four-part error of the file that it parses.

    The original stays the cause, so ``--debug`` shows where it was raised.

    Args:
        doing: First part.
        where: The file, or the member of a file.
        do_this: Last part.
        what: What is wrong if anything is, for the third part: "no readable parquet".

    Raises:
        InputError: The block raised anything but a `SimrunError`.
    """
    try:
        yield
    except SimrunError:
        raise
    except Exception as error:
        lines = str(error).strip().splitlines()
        reason = lines[0] if lines and not isinstance(error, KeyError) else f"{type(error).__name__} {error}"
        raise InputError(doing, str(where), f"{what}: {reason}", do_this) from error

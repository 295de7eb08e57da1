"""Digests of files, so that damage is noticed before a file is trusted.

A file with the stated size and time is taken as it is, since reading gigabytes before every command
would cost more than it finds; any other is read in full. A copy has other times: they are set back
once its content is found to be the same.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import stat
from collections.abc import Iterable
from pathlib import Path

from typing_extensions import TypedDict

MTIME_STEP_NS = 1000  # file systems keep times to a microsecond or better


class FileFacts(TypedDict):
    """What is stated of a file."""

    bytes: int
    mtime_ns: int
    sha256: str


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's content, in hexadecimal digits; OSError if it cannot be
    read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def checksums_of(folder: Path, names: Iterable[str]) -> dict[str, FileFacts]:
    """Return the facts of those of the named files that are there."""
    found: dict[str, FileFacts] = {}
    for name in names:
        path = folder / name
        if path.is_file():
            state = path.stat()
            found[name] = {
                "bytes": state.st_size,
                "mtime_ns": state.st_mtime_ns,
                "sha256": sha256_of(path),
            }
    return found


def problem_of(path: Path, facts: FileFacts, full: bool = False) -> str | None:
    """Say what is wrong with a file; None if it is the one that was written.

    Args:
        path: The file.
        facts: What was stated of it when it was written.
        full: Read its content even if size and time are as stated.
    """
    try:
        state = path.stat()
        if not stat.S_ISREG(state.st_mode):
            return "not a file"
        if state.st_size != facts["bytes"]:
            return f"{state.st_size} bytes, written with {facts['bytes']}"
        same_time = abs(state.st_mtime_ns - facts["mtime_ns"]) < MTIME_STEP_NS
        if same_time and not full:
            return None
        if sha256_of(path) != facts["sha256"]:
            return "not the content that was written"
    except FileNotFoundError:
        return "missing"
    except OSError as error:
        return f"cannot be read: {error.strerror or error}"
    if not same_time:
        with contextlib.suppress(OSError):  # a read-only folder is read in full every time
            os.utime(path, ns=(state.st_atime_ns, facts["mtime_ns"]))
    return None

"""Checksums of files, in files with a seal, so that damage is noticed before anything is trusted.

A sealed JSON file ends with the SHA-256 of everything before it; it states size, time and SHA-256
of other files. A file with the stated size and time is taken as it is, since reading gigabytes
before every command would cost more than it finds; any other is read in full. A copy has other
times: they are set back once its content is found to be the same.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import stat
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from typing_extensions import TypedDict

from alpasim_plugin.core.atomic import write_bytes
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.reading import parse_json, read_bytes

SEAL = "sha256"
_TAIL = re.compile(rb',\n "sha256": "([0-9a-f]{64})"\n}\n\Z')
TAIL_BYTES = 84
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


def write_sealed(path: Path, value: Mapping[str, Any]) -> str:
    """Write a JSON object with its seal, atomically, and return the seal.

    Raises:
        InfrastructureError: The disk refuses.
        ValueError: NaN or infinity, which JSON does not have; an empty object, or one with the key
            of the seal.
    """
    if not value or SEAL in value:
        raise ValueError(f"a sealed object needs keys other than {SEAL!r}")
    body = json.dumps(value, indent=1, allow_nan=False).removesuffix("\n}").encode()
    seal = hashlib.sha256(body).hexdigest()
    write_bytes(path, body + f',\n "{SEAL}": "{seal}"\n}}\n'.encode())
    return seal


def read_sealed(path: Path, do_this: str) -> tuple[dict[str, Any], str]:
    """Read what `write_sealed` wrote, without the seal, and the seal.

    Raises:
        InputError: The file is missing, cut, changed, or was not written by `write_sealed`.
    """
    data = read_bytes(path, do_this=do_this)
    tail = _TAIL.search(data, max(0, len(data) - TAIL_BYTES))
    if tail is None:
        raise InputError(
            f"{path}: cut, or written by another program or version: its seal is missing",
            do_this,
        )
    seal = tail[1].decode()
    if hashlib.sha256(data[: tail.start()]).hexdigest() != seal:
        raise InputError(f"{path}: not the content that was written", do_this)
    value = parse_json(data, path, do_this)
    del value[SEAL]
    return value, seal

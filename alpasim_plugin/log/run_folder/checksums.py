"""Digests of files, so that damage is noticed before a file is trusted.

A file with the stated size and time is taken as it is, since reading gigabytes before every command
would cost more than it finds; any other is read in full.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from typing_extensions import TypedDict

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.reading import file_sha256


class FileFacts(TypedDict):
    """What is stated of a file."""

    bytes: int
    mtime_ns: int
    sha256: str


def checksums_of(folder: Path, names: Iterable[str]) -> dict[str, FileFacts]:
    """Return the facts of those of the named files that are there."""
    facts: dict[str, FileFacts] = {}
    for name in names:
        path = folder / name
        if os.path.isfile(path):
            state = path.stat()
            facts[name] = FileFacts(
                bytes=state.st_size, mtime_ns=state.st_mtime_ns, sha256=file_sha256(path)
            )
    return facts


def problem_of(path: Path, facts: FileFacts, full: bool = False) -> str | None:
    """Say what is wrong with a file; None if it is the one that was written.

    Args:
        path: The file.
        facts: What was stated of it when it was written.
        full: Read its content even if size and time are as stated.
    """
    if not os.path.exists(path):
        return "missing"
    if not os.path.isfile(path):
        return "not a file"
    state = path.stat()
    if state.st_size != facts["bytes"]:
        return f"{state.st_size} bytes, written with {facts['bytes']}"
    if state.st_mtime_ns == facts["mtime_ns"] and not full:
        return None
    try:
        digest = file_sha256(path)
    except InputError as error:
        return error.message
    return None if digest == facts["sha256"] else "not the content that was written"

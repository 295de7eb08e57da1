"""Digests of files, so that damage is noticed before a file is trusted.

A log or a film with the stated size and time is taken as it is, since reading gigabytes before
every command would cost more than it finds; any other file is read in full.
"""

import hashlib
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from typing_extensions import TypedDict

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import file_sha256, read_json_as
from alpasim_plugin.core.files.atomic import write_json
from alpasim_plugin.core.json_types import JsonView
from alpasim_plugin.log.run_folder.schema import AGAIN, FILES

DIGEST = "sha256"  # member of a JSON file: the digest of the others


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


def sealed(content: JsonView) -> dict[str, Any]:
    """Return the content of a JSON file with its SHA-256 in it."""
    return {**content, DIGEST: _digest_of(content)}


def check_seal(content: JsonView, path: Path, do_this: str) -> None:
    """Compare the content of a JSON file with the digest in it, where it holds one.

    Raises:
        InputError: They differ.
    """
    if content.get(DIGEST, _digest_of(content)) != _digest_of(content):
        raise InputError(f"{path}: not the content that was written", do_this)


def _digest_of(content: JsonView) -> str:
    others = {key: value for key, value in content.items() if key != DIGEST}
    return hashlib.sha256(json.dumps(others).encode()).hexdigest()


def state_files(root: Path, names: Iterable[str]) -> None:
    """Write the facts of those of the named files that are there into ``files.json``, and keep
    those of other files.
    """
    names = list(names)
    stated = stated_files(root) if os.path.exists(root / FILES) else {}
    others = {name: facts for name, facts in stated.items() if name not in names}
    write_json(root / FILES, others | checksums_of(root, names))


def stated_files(root: Path) -> dict[str, FileFacts]:
    """Read ``files.json`` of a run folder.

    Raises:
        InputError: It is missing or damaged.
    """
    return read_json_as(dict[str, FileFacts], root / FILES, AGAIN)


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

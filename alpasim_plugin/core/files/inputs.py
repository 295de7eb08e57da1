"""What a maker reads is recorded while it reads it, and its key is made of that record.

A maker is whatever makes something that is kept: a scene, a rollout, a fitted model, an imported
drive, the pictures of ``why``, machine code. It reads files through `alpasim_plugin.core.files`
and states its settings; the record holds the files by their content and the settings by their
value::

    with Inputs() as inputs:
        inputs.setting("camera height", 1.5)
        drive = read_source(folder)
    key = inputs.key

Where files lie does not count, and neither does who reads them: every reader of this package goes
through `open_regular`, which enters what it opens into each record that is open. What opens files
by itself, such as a policy with ``open``, is not seen.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar, Token
from io import BufferedReader
from pathlib import Path

from alpasim_plugin.core.typed_json import to_plain

ARRAY = "!array"  # marks an array among settings
ABSENT = "absent"  # the content of a file that was looked for and is not there
# A file that was changed so recently may change again without another time of change.
SETTLED_NS = 2_000_000_000

_open: ContextVar[tuple[Inputs, ...]] = ContextVar("records that are open", default=())
_digests: dict[tuple[int, ...], str] = {}  # device, inode, size, times of change
_read_by: dict[str, dict[str, str]] = {}  # module -> what was read while its code ran


class Inputs:
    """The record of a maker: what it read, while the ``with`` block ran.

    Attributes:
        files: Digest of each file's content by its path, in the order of the first reading;
            `ABSENT` for one that is not there.
        settings: Values by name.

    Example:
        >>> with Inputs() as inputs:
        ...     inputs.setting("width", 640)
        >>> inputs.files, inputs.settings
        ({}, {'width': 640})
    """

    def __init__(self) -> None:
        self.files: dict[str, str] = {}
        self.settings: dict[str, object] = {}
        self._tokens: list[Token[tuple[Inputs, ...]]] = []

    def __enter__(self) -> Inputs:
        self._tokens.append(_open.set((*_open.get(), self)))
        return self

    def __exit__(self, *_: object) -> None:
        _open.reset(self._tokens.pop())

    def setting(self, name: str, value: object) -> None:
        """Enter a value that JSON can write, or an array.

        Raises:
            ValueError: Another value was entered under this name.
        """
        plain = _plain(value)
        if self.settings.setdefault(name, plain) != plain:
            raise ValueError(f"two values of the setting {name!r}")

    @property
    def key(self) -> str:
        """Give the SHA-256 over all settings, by name, and all files, by content in the order of
        the first reading: another place or name of a file makes no other key.
        """
        content = [self.settings, list(self.files.values())]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _plain(value: object) -> object:
    """Return what JSON can write; an array by its digest."""
    if hasattr(value, "tobytes") and getattr(value, "shape", ()) != ():  # of numpy, not loaded here
        content = hashlib.sha256(value.tobytes()).hexdigest()
        return {
            ARRAY: [str(getattr(value, "dtype", "")), list(getattr(value, "shape", ())), content]
        }
    if isinstance(value, Mapping) and all(isinstance(name, str) for name in value):
        return {name: _plain(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return to_plain(value)


@contextmanager
def unrecorded() -> Iterator[None]:
    """Enter nothing that the block, or a function decorated so, reads into the records that are open: it is no input, or it
    enters as a setting.
    """
    token = _open.set(())
    try:
        yield
    finally:
        _open.reset(token)


def note_opened(path: Path | str, stream: BufferedReader) -> None:
    """Enter an open file into the records; the stream stands at its beginning afterwards."""
    records = _open.get()
    if not records:
        return
    name = os.path.realpath(path)
    if all(name in record.files for record in records):
        return
    content = content_digest(stream)
    for record in records:
        record.files.setdefault(name, content)


def note_absent(path: Path | str) -> None:
    """Enter a file that was looked for and is not there."""
    for record in _open.get():
        record.files.setdefault(os.path.realpath(path), ABSENT)


def note_files(files: Mapping[str, str]) -> None:
    """Enter what was read before and is remembered: a record made by `Inputs`."""
    for record in _open.get():
        for name, content in files.items():
            record.files.setdefault(name, content)


def remembered(modules: Collection[str], files: Mapping[str, str]) -> dict[str, str]:
    """Return what code of these modules has read in this process, now and before: it may remember it, so
    that only the first of several makers reads a file.

    What modules have read together counts for each of them, since one that two parts import may
    remember for both.

    Args:
        modules: Names or paths, under which what was read is held.
        files: What was read just now: a record made by `Inputs`.
    """
    for module in modules:
        _read_by.setdefault(module, {}).update(files)
    everything = dict(files)
    for module in modules:
        everything = _read_by[module] | everything
    return everything


def content_digest(stream: BufferedReader) -> str:
    """Return the SHA-256 of an open file's content, computed once while the file stays as it is.

    A file that was changed in the last two seconds is read again: its time of change may not tell
    the next change.
    """
    state = os.fstat(stream.fileno())
    times_ns = state.st_mtime_ns, state.st_ctime_ns
    identity = (state.st_dev, state.st_ino, state.st_size, *times_ns)
    if identity in _digests:
        return _digests[identity]
    stream.seek(0)
    digest = hashlib.file_digest(stream, "sha256").hexdigest()
    stream.seek(0)
    if time.time_ns() - max(times_ns) > SETTLED_NS:
        _digests[identity] = digest
    return digest

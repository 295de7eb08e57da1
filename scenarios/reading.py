"""Reading source files: every failure names the file, every byte read enters one hash."""

from __future__ import annotations

import hashlib
import io
import json
import tarfile
import tokenize
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
import pyarrow as pa
from pyarrow import feather

from alpasim_plugin.errors import InputError
from alpasim_plugin.types import F64

MAX_FILE_BYTES = 1 << 30  # refuse to load by mistake what is no scenario
MAX_REACH_M = 10_000.0  # no recorded scene is wider; one broken coordinate must not ask for a ground grid of many gigabytes


class SourceFiles:
    """Reads the files of one recorded log and hashes what it read.

    Args:
        doing: Verb phrase for error messages, such as "reading an Argoverse 2 log".
    """

    def __init__(self, doing: str) -> None:
        self.doing = doing
        self._hash = hashlib.sha256()

    @property
    def content_hash(self) -> str:
        """Return the sha256 over names and bytes of all files read so far, in reading order."""
        return self._hash.hexdigest()

    def fail(self, path: Path | str, found: str, do_this: str) -> InputError:
        """Make the error that names a file; the caller raises it."""
        return InputError(self.doing, str(path), found, do_this)

    def near(self, where: Path | str, xyz: F64) -> F64:
        """Return local points ``(..., 3)`` after checking that they are finite and within `MAX_REACH_M` of the origin."""
        distance = float(np.abs(xyz).max(initial=0.0))  # NaN stays NaN
        if not distance <= MAX_REACH_M:
            found = "a coordinate that is not finite" if not np.isfinite(distance) else f"a point {distance / 1000:.1f} km from the drive"
            raise self.fail(where, found, "repair the coordinates of this file")
        return xyz

    def only(self, folder: Path, patterns: tuple[str, ...], what: str) -> Path:
        """Return the one file of a folder that matches one of the glob patterns, the first pattern with a match deciding.

        Raises:
            InputError: There is none, or more than one.
        """
        if not folder.is_dir():
            raise self.fail(folder, "no such folder", f"give the folder that holds {what}")
        for pattern in patterns:
            found = sorted(folder.glob(pattern))
            if len(found) == 1:
                return found[0]
            if found:
                names = ", ".join(f.name for f in found[:3])
                raise self.fail(folder, f"{len(found)} files match {pattern}: {names}", f"keep exactly one file with {what}")
        raise self.fail(folder, f"no file {' or '.join(patterns)}", f"add the file with {what}")

    def read_bytes(self, path: Path) -> bytes:
        """Read a whole file.

        Raises:
            InputError: It is missing, no file, empty, too large or unreadable.
        """
        try:
            size = path.stat().st_size
            if size > MAX_FILE_BYTES:
                raise self.fail(path, f"{size} bytes", f"give a file below {MAX_FILE_BYTES} bytes")
            data = path.read_bytes()
        except FileNotFoundError as error:
            raise self.fail(path, "no such file", "check the path") from error
        except OSError as error:
            raise self.fail(path, f"it cannot be read: {error.strerror}", "check its type and permissions") from error
        if not data:
            raise self.fail(path, "an empty file", "fetch the file again")
        self.note_bytes(path.name, data)
        return data

    def note_bytes(self, name: str, data: bytes) -> None:
        """Enter bytes that were read under a name into the hash."""
        self._hash.update(f"{name}:{len(data)}\n".encode())
        self._hash.update(data)

    def read_json(self, path: Path) -> Any:
        """Read a JSON document."""
        return self.parse_json(self.read_bytes(path), path)

    def parse_json(self, data: bytes, where: Path | str) -> Any:
        """Parse a JSON document that came out of ``where``."""
        try:
            return json.loads(data)
        except UnicodeDecodeError as error:
            raise self.fail(where, f"bytes that are not UTF-8 at offset {error.start}", "fetch the file again") from error
        except (json.JSONDecodeError, RecursionError) as error:
            raise self.fail(where, f"broken JSON: {error}", "fetch the file again; it may be truncated") from error

    def read_feather(self, path: Path, columns: tuple[str, ...]) -> dict[str, np.ndarray[Any, Any]]:
        """Read columns of a feather file (Arrow IPC).

        Raises:
            InputError: The file is damaged or truncated, or lacks a column.
        """
        data = self.read_bytes(path)
        try:
            table = feather.read_table(pa.BufferReader(data))
            table.validate(full=True)
            missing = [c for c in columns if c not in table.column_names]
            if missing:
                found = f"no column {missing[0]!r}, only {', '.join(table.column_names)}"
                raise self.fail(path, found, "use a file of the Argoverse 2 sensor set")
            return {c: table.column(c).to_numpy(zero_copy_only=False) for c in columns}
        except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise self.fail(path, f"no readable Arrow IPC file: {reason[:120]}", "fetch the file again; it may be truncated") from error

    def parse_npy(self, data: bytes, where: Path | str) -> np.ndarray[Any, Any]:
        """Parse a NumPy array without pickles."""
        try:
            array: np.ndarray[Any, Any] = np.load(io.BytesIO(data), allow_pickle=False)
        except (ValueError, EOFError, OSError, SyntaxError, tokenize.TokenError, MemoryError) as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise self.fail(where, f"no readable NumPy array: {reason}", "fetch the file again; it may be truncated") from error
        return array

    def read_tar(self, path: Path) -> dict[str, bytes]:
        """Read the regular files of an uncompressed tar, in memory, by member name."""
        data = self.read_bytes(path)
        try:
            with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as archive:
                members: dict[str, bytes] = {}
                for info in archive:
                    handle = archive.extractfile(info) if info.isfile() else None
                    if handle is not None:
                        content = handle.read()
                        if len(content) != info.size:
                            raise tarfile.ReadError(f"member {info.name} has {len(content)} of {info.size} bytes")
                        members[info.name] = content
        except (tarfile.TarError, EOFError, OSError) as error:
            raise self.fail(path, f"a damaged tar: {error}", "fetch the file again; it may be truncated") from error
        # A cut between two members leaves a readable tar: only the two empty blocks at its end show that it is complete.
        if any(data[-2 * tarfile.BLOCKSIZE :]):
            raise self.fail(path, "a damaged tar: no end-of-archive blocks", "fetch the file again; it may be truncated")
        if not members:
            raise self.fail(path, "a tar without files", "fetch the file again")
        return members

    def read_xml(self, path: Path) -> ElementTree.Element:
        """Parse an XML document; a DOCTYPE is refused, so no entity can be defined or expanded.

        Raises:
            InputError: The document is malformed or truncated, or declares a DOCTYPE.
        """
        return self.parse_xml(self.read_bytes(path), path)

    def parse_xml(self, data: bytes, path: Path | str) -> ElementTree.Element:
        """Parse an XML document that came out of ``path``; see `read_xml`."""

        def refuse(*_: Any) -> None:
            raise self.fail(path, "a DOCTYPE declaration", "remove it: entities are not accepted in scenario files")

        scout = expat.ParserCreate()
        scout.StartDoctypeDeclHandler = refuse
        try:
            scout.Parse(data, True)
            return ElementTree.fromstring(data)
        except (expat.ExpatError, ElementTree.ParseError) as error:
            raise self.fail(path, f"malformed XML: {error}", "fetch the file again; it may be truncated") from error
        except (ValueError, LookupError) as error:
            raise self.fail(path, f"an unreadable text encoding: {error}", "save the file as UTF-8") from error

"""Reading source files: every failure names the file, every byte read enters one hash."""

from __future__ import annotations

import hashlib
import io
import tarfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pyarrow as pa
from pyarrow import feather

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64
from alpasim_plugin.io import reading
from alpasim_plugin.io.limits import COORDINATE_M, MEMBERS, SOURCE_BYTES
from alpasim_plugin.io.reading.arrays import parse_npy
from alpasim_plugin.io.reading.files import parse_xml
from alpasim_plugin.io.reading.tables import Kind, check_columns

MAX_REACH_M = COORDINATE_M.high


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
        data = reading.read_bytes(path, self.doing, SOURCE_BYTES)
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
        return reading.parse_json(data, where, self.doing, "fetch the file again; it may be truncated")

    def read_feather(self, path: Path, columns: Mapping[str, Kind]) -> dict[str, np.ndarray[Any, Any]]:
        """Read columns of a feather file (Arrow IPC).

        Raises:
            InputError: The file is damaged or truncated, lacks a column, or has one of another type or with empty values.
        """
        data, do = self.read_bytes(path), "fetch the file again; it may be truncated"
        with reading.parsing(self.doing, path, do, "no readable Arrow IPC file"):
            table = feather.read_table(pa.BufferReader(data))
            table.validate(full=True)
        check_columns(table, columns, path, self.doing, "use a file of the Argoverse 2 sensor set")
        nulls = next((name for name in columns if table.column(name).null_count), None)
        if nulls is not None:
            raise self.fail(path, f"column {nulls!r} with empty values", "repair or drop these rows")
        return {c: table.column(c).to_numpy(zero_copy_only=False) for c in columns}

    def parse_npy(self, data: bytes, where: Path | str) -> np.ndarray[Any, Any]:
        """Parse a NumPy array without pickles."""
        return parse_npy(data, where, self.doing, "fetch the file again; it may be truncated")

    def read_tar(self, path: Path) -> dict[str, bytes]:
        """Read the regular files of an uncompressed tar, in memory, by member name."""
        data = self.read_bytes(path)
        damaged = reading.parsing(self.doing, path, "fetch the file again; it may be truncated", "a damaged tar")
        members: dict[str, bytes] = {}
        with damaged, tarfile.open(fileobj=io.BytesIO(data), mode="r:") as archive:
            for info in archive:
                MEMBERS.check(len(members), self.doing, path)
                handle = archive.extractfile(info) if info.isfile() else None
                if handle is not None:
                    content = handle.read()
                    if len(content) != info.size:
                        raise tarfile.ReadError(f"member {info.name} has {len(content)} of {info.size} bytes")
                    members[info.name] = content
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
        return parse_xml(data, path, self.doing)

"""Frame ASL logs: a 4-byte big-endian length before each serialised ``LogEntry``, and nothing else.

The format has no header, index or checksum. A log whose writer was killed ends inside an entry: the
reader gives everything before it and says so. Damage anywhere else is an error.
"""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from google.protobuf.message import DecodeError

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.files.atomic import disk_error
from alpasim_plugin.core.files.limits import ENTRY_BYTES, LOG_BYTES
from alpasim_plugin.core.files.reading import open_regular
from alpasim_plugin.core.interfaces import EMPTY
from alpasim_plugin.log.wire import logging_pb2

_LENGTH = struct.Struct(">I")
_COPY_AGAIN = (
    "copy the log again from where it was written; nothing after this point can be trusted"
)


class AslReader:
    """Iterate over the entries of a log, one in memory at a time.

    Attributes:
        path: The log.
        truncated: Says what of an unfinished last entry is there, once iteration has met one;
            empty otherwise.

    Example:
        >>> for entry in AslReader("rollout.asl"):  # doctest: +SKIP
        ...     print(entry.WhichOneof("log_entry"))
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.truncated = ""

    def __iter__(self) -> Iterator[logging_pb2.LogEntry]:
        """Yield the entries in file order.

        Raises:
            InputError: Missing or empty file, or damage before the last entry.
        """
        self.truncated = ""
        with open_regular(self.path, LOG_BYTES) as stream:
            index = 0
            while (body := self._next(stream, index)) is not None:
                offset = stream.tell() - len(body)
                entry = logging_pb2.LogEntry()
                try:
                    entry.ParseFromString(body)
                except DecodeError as error:
                    raise self._damaged(
                        index, offset, f"{len(body)} bytes that are no log entry"
                    ) from error
                yield entry
                index += 1
        if index == 0 and not self.truncated:
            raise InputError(f"{self.path}: an empty file", "run the rollout again")

    def _next(self, stream: BinaryIO, index: int) -> bytes | None:
        """Return the bytes of the next entry, or None at the end; notes an unfinished one.

        A length that was overwritten with a larger one reads as an unfinished entry: what follows it
        cannot be found.
        """
        offset = stream.tell()
        prefix = stream.read(_LENGTH.size)
        if not prefix:
            return None
        announced = int.from_bytes(prefix, "big")
        if len(prefix) == _LENGTH.size and not ENTRY_BYTES.holds(announced):
            raise self._damaged(index, offset, f"a length of {announced} bytes")
        body = stream.read(announced) if len(prefix) == _LENGTH.size else b""
        if body and len(body) == announced:
            return body
        self.truncated = f"{self.path}: last entry cut at byte {offset}; {index} whole entries read"
        return None

    def _damaged(self, index: int, offset: int, problem: str) -> InputError:
        return InputError(
            f"{self.path}, entry {index} at byte {offset}: {problem}",
            _COPY_AGAIN,
        )


class AslFile:
    """Write entries to ``PATH.part`` and give the file its name only when it is finished.

    As a context manager it finishes on success; on an exception the ``.part`` file stays for
    inspection, readable up to its last whole entry, and the next attempt replaces it.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.partial = self.path.with_name(self.path.name + ".part")
        self.entries = 0
        try:
            self._stream: BinaryIO | None = self.partial.open("wb")
        except OSError as error:
            raise disk_error(self.path, error) from error

    def write(self, entry: logging_pb2.LogEntry) -> None:
        """Append one entry.

        Raises:
            InfrastructureError: The disk refuses, or the file is already finished.
        """
        if self._stream is None:
            raise InfrastructureError(
                f"{self.path}: the log is already finished",
                "open a new log",
            )
        body = entry.SerializeToString()
        try:
            self._stream.write(_LENGTH.pack(len(body)))
            self._stream.write(body)
        except OSError as error:
            raise disk_error(self.path, error) from error
        self.entries += 1

    def finish(self) -> None:
        """Flush to the disk and rename; harmless if already finished.

        Raises:
            InfrastructureError: The disk refuses; the ``.part`` file stays.
        """
        if self._stream is None:
            return
        try:
            self._stream.flush()
            os.fsync(self._stream.fileno())
            self._stream.close()
            self._stream = None
            self.partial.replace(self.path)
        except OSError as error:
            raise disk_error(self.path, error) from error

    def abandon(self) -> None:
        """Close without renaming."""
        if self._stream is not None:
            # The caller is already dealing with a failure; that the last buffer of a full disk is
            # lost too adds nothing to it.
            with contextlib.suppress(OSError):
                self._stream.close()
            self._stream = None

    def __enter__(self) -> AslFile:
        return self

    def __exit__(self, *failure: object) -> None:
        if failure[0] is None:
            self.finish()
        else:
            self.abandon()


def copy_log(
    source: Path,
    target: Path,
    session_uuid: str = "",
    renderer: str = "",
    renderer_digest: str = "",
    cameras: Mapping[str, str] = EMPTY,
) -> None:
    """Copy a log under other names.

    Args:
        source: A finished log.
        target: The file to write; its folder exists.
        session_uuid: The new session id; empty keeps the log's.
        renderer: The new name of the renderer in the header; empty keeps the log's.
        renderer_digest: The digest of the renderer that has the new name; empty where it has none.
        cameras: Old name -> new name; others keep theirs.

    Raises:
        InputError: The source is damaged, or ends inside an entry.
        InfrastructureError: The disk refuses.
    """
    reader = AslReader(source)
    with AslFile(target) as out:
        for entry in reader:
            kind = entry.WhichOneof("log_entry")
            message = entry if kind is None else getattr(entry, kind)
            owner = message.session_metadata if kind == "rollout_metadata" else message
            if session_uuid and "session_uuid" in owner.DESCRIPTOR.fields_by_name:
                owner.session_uuid = session_uuid
            if renderer and kind == "rollout_metadata":
                message.version_ids.sensorsim_version.version_id = renderer
                message.version_ids.sensorsim_version.git_hash = renderer_digest
            for holder, name in _names(kind, message):
                old = getattr(holder, name)
                if old in cameras:
                    setattr(holder, name, cameras[old])
            out.write(entry)
        if reader.truncated:
            raise InputError(reader.truncated, "run the rollout again")


def _names(kind: str | None, message: Any) -> Iterator[tuple[Any, str]]:
    """Yield every place of a message that holds a camera's name, as its owner and field."""
    if kind == "available_cameras_return":
        yield from _cameras(message.available_cameras)
    elif kind == "driver_session_request":
        yield from _cameras(message.rollout_spec.vehicle.available_cameras)
    elif kind == "batch_render_request":
        for item in message.items:
            yield item, "camera_name"
            yield item.request.camera_intrinsics, "logical_id"
    elif kind == "render_request":
        yield message.camera_intrinsics, "logical_id"
    elif kind == "aggregated_render_request":
        for request in message.rgb_requests:
            yield request.camera_intrinsics, "logical_id"
    elif kind == "driver_camera_image":
        yield message.camera_image, "logical_id"


def _cameras(cameras: Any) -> Iterator[tuple[Any, str]]:
    for camera in cameras:
        yield camera, "logical_id"
        yield camera.intrinsics, "logical_id"

"""Copy a rollout log entry by entry, with another session id and other camera names where asked; nothing else changes.

An entry in which nothing is renamed keeps its bytes, also those of fields that this version does not know.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.asl import AslFile, AslReader
from alpasim_plugin.wire import logging_pb2


@dataclass(frozen=True)
class Renaming:
    """What is called otherwise.

    Attributes:
        session_uuid: The new session id; empty keeps the log's.
        cameras: Old name -> new name; others keep theirs.
    """

    session_uuid: str = ""
    cameras: Mapping[str, str] = field(default_factory=dict)

    def __call__(self, entry: logging_pb2.LogEntry) -> list[logging_pb2.LogEntry]:
        """Rename within an entry, in place; a stage of `copy_log`."""
        kind = entry.WhichOneof("log_entry")
        if kind is None:
            return [entry]
        message = getattr(entry, kind)
        owner = message.session_metadata if kind == "rollout_metadata" else message
        if self.session_uuid and "session_uuid" in owner.DESCRIPTOR.fields_by_name:
            owner.session_uuid = self.session_uuid
        if self.cameras:
            for holder, name in _names(kind, message):
                old = getattr(holder, name)
                if old in self.cameras:
                    setattr(holder, name, self.cameras[old])
        return [entry]


Stage = Callable[[logging_pb2.LogEntry], Iterable[logging_pb2.LogEntry]]


def copy_log(source: Path, target: Path, *stages: Stage) -> int:
    """Copy a log and return its number of entries.

    Args:
        source: A finished log.
        target: The file to write; its folder exists.
        stages: Each makes the entries to write of an entry; the next one receives them. Without any, the copy is equal.

    Raises:
        InputError: The source is damaged, or ends inside an entry.
        InfrastructureError: The disk refuses.
    """
    reader = AslReader(source)
    with AslFile(target) as out:
        for entry in reader:
            entries: Iterable[logging_pb2.LogEntry] = [entry]
            for stage in stages:
                entries = [made for one in entries for made in stage(one)]
            for made in entries:
                out.write(made)
        if reader.truncated is not None:
            raise InputError("copying a rollout log", str(source), str(reader.truncated), "run the rollout again")
    return out.entries


def _names(kind: str, message: Any) -> Iterator[tuple[Any, str]]:
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

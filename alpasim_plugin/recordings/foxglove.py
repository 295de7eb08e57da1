"""Foxglove's message schemas, as far as recordings use them, in JSON Schema: written from https://docs.foxglove.dev/docs/sdk/schemas.

JSON and not protobuf, because Foxglove's generated protobuf classes would bind the version of protobuf for the whole environment.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from alpasim_plugin.core.types import F64, CameraSpec

NS_PER_US, NS_PER_S = 1_000, 1_000_000_000
LINE_STRIP = 0
WARNING = 3

Schema = dict[str, Any]
Message = dict[str, Any]
Rgba = tuple[float, float, float, float]

_NUMBER: Schema = {"type": "number"}
_INTEGER: Schema = {"type": "integer"}
_TEXT: Schema = {"type": "string"}
_FLAG: Schema = {"type": "boolean"}


def _object(title: str = "", **properties: Schema) -> Schema:
    return ({"title": title} if title else {}) | {"type": "object", "properties": properties}


def _list(items: Schema) -> Schema:
    return {"type": "array", "items": items}


_TIME = _object(sec=_INTEGER, nsec=_INTEGER)
_VECTOR = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE = _object(position=_VECTOR, orientation=_QUATERNION)
_COLOR = _object(r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_LINE = _object(
    type=_INTEGER, pose=_POSE, thickness=_NUMBER, scale_invariant=_FLAG, points=_list(_VECTOR), color=_COLOR, colors=_list(_COLOR),
    indices=_list(_INTEGER),
)  # fmt: skip
_ENTITY = _object(
    timestamp=_TIME, frame_id=_TEXT, id=_TEXT, lifetime=_TIME, frame_locked=_FLAG, metadata=_list(_object(key=_TEXT, value=_TEXT)),
    cubes=_list(_object(pose=_POSE, size=_VECTOR, color=_COLOR)), lines=_list(_LINE),
)  # fmt: skip

COMPRESSED_IMAGE = _object(
    "foxglove.CompressedImage", timestamp=_TIME, frame_id=_TEXT, data={"type": "string", "contentEncoding": "base64"}, format=_TEXT
)
CAMERA_CALIBRATION = _object(
    "foxglove.CameraCalibration", timestamp=_TIME, frame_id=_TEXT, width=_INTEGER, height=_INTEGER, distortion_model=_TEXT,
    D=_list(_NUMBER), K=_list(_NUMBER), R=_list(_NUMBER), P=_list(_NUMBER),
)  # fmt: skip
FRAME_TRANSFORM = _object(
    "foxglove.FrameTransform", timestamp=_TIME, parent_frame_id=_TEXT, child_frame_id=_TEXT, translation=_VECTOR, rotation=_QUATERNION
)
SCENE_UPDATE = _object("foxglove.SceneUpdate", deletions=_list(_object(timestamp=_TIME, type=_INTEGER, id=_TEXT)), entities=_list(_ENTITY))
LOG = _object("foxglove.Log", timestamp=_TIME, level=_INTEGER, message=_TEXT, name=_TEXT, file=_TEXT, line=_INTEGER)


def metrics_schema(names: Iterable[str]) -> Schema:
    """Return the schema of a message with the metrics that have a valid value at an instant."""
    return _object("simrun.Metrics", timestamp=_TIME, **dict.fromkeys(names, _NUMBER))


def time_of(t_us: int) -> Message:
    """Return a time.

    Example:
        >>> time_of(1_500_000)
        {'sec': 1, 'nsec': 500000000}
    """
    sec, nsec = divmod(int(t_us) * NS_PER_US, NS_PER_S)
    return {"sec": sec, "nsec": nsec}


def vector(xyz: F64) -> Message:
    """Return a point or a size ``(3,)``, metres."""
    return dict(zip("xyz", map(float, xyz), strict=True))


def quaternion(quat: F64) -> Message:
    """Return a rotation from ``(4,)`` wxyz."""
    return dict(zip("wxyz", map(float, quat), strict=True))


def color(rgba: Rgba) -> Message:
    """Return a colour, each part from 0 to 1."""
    return dict(zip("rgba", rgba, strict=True))


def pose(xyz: F64, quat: F64) -> Message:
    """Return a pose."""
    return {"position": vector(xyz), "orientation": quaternion(quat)}


def cube(xyz: F64, quat: F64, size_m: Sequence[float], rgba: Rgba) -> Message:
    """Return a box: pose of its centre, world, and its length, width and height."""
    return {"pose": pose(xyz, quat), "size": vector(np.asarray(size_m, dtype=np.float64)), "color": color(rgba)}


def line(points: F64, rgba: Rgba, thickness_m: float) -> Message:
    """Return a line through ``(N, 3)`` metres."""
    return {
        "type": LINE_STRIP,
        "pose": pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])),
        "thickness": thickness_m,
        "scale_invariant": False,
        "points": [vector(point) for point in points],
        "color": color(rgba),
        "colors": [],
        "indices": [],
    }


def entity(
    t_us: int, name: str, frame: str, cubes: Sequence[Message] = (), lines: Sequence[Message] = (), facts: Mapping[str, str] | None = None
) -> Message:
    """Return an entity that stays until one of the same name replaces it."""
    return {
        "timestamp": time_of(t_us),
        "frame_id": frame,
        "id": name,
        "lifetime": time_of(0),
        "frame_locked": True,
        "metadata": [{"key": key, "value": value} for key, value in (facts or {}).items()],
        "cubes": list(cubes),
        "lines": list(lines),
    }


def scene_update(*entities: Message) -> Message:
    """Return an update of entities."""
    return {"deletions": [], "entities": list(entities)}


def frame_transform(t_us: int, parent: str, child: str, xyz: F64, quat: F64) -> Message:
    """Return the pose of a frame in another."""
    return {
        "timestamp": time_of(t_us), "parent_frame_id": parent, "child_frame_id": child, "translation": vector(xyz),
        "rotation": quaternion(quat),
    }  # fmt: skip


def compressed_image(t_us: int, frame: str, media_type: str, data: bytes) -> Message:
    """Return an encoded camera frame."""
    kind = media_type.removeprefix("image/")
    return {"timestamp": time_of(t_us), "frame_id": frame, "data": base64.b64encode(data).decode("ascii"), "format": kind}


def camera_calibration(t_us: int, frame: str, spec: CameraSpec) -> Message:
    """Return a pinhole without distortion."""
    k = [float(value) for value in np.asarray(spec.K).reshape(-1)]
    return {
        "timestamp": time_of(t_us), "frame_id": frame, "width": spec.width, "height": spec.height, "distortion_model": "", "D": [],
        "K": k, "R": np.eye(3).reshape(-1).tolist(), "P": [*k[0:3], 0.0, *k[3:6], 0.0, *k[6:9], 0.0],
    }  # fmt: skip


def log_message(t_us: int, name: str, text: str) -> Message:
    """Return an event."""
    return {"timestamp": time_of(t_us), "level": WARNING, "message": text, "name": name, "file": "", "line": 0}

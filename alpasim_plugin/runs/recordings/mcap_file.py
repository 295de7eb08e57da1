"""Write a recording as MCAP, in order of time, with Foxglove's message schemas in JSON Schema
(https://docs.foxglove.dev/docs/sdk/schemas).

JSON and not protobuf, as foxglove-sdk would write: any MCAP reader gives its messages as they are,
without Foxglove's generated classes.
"""

from __future__ import annotations

import base64
import heapq
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.atomic import atomic_file
from alpasim_plugin.core.geometry import quat_from_matrix
from alpasim_plugin.core.lazy import require_library
from alpasim_plugin.core.types import F64, Box, CameraSpec, Trajectory
from alpasim_plugin.runs.recordings.content import (
    MAP,
    ROAD_USER,
    Camera,
    Drive,
    Recording,
    Rgba,
    fainter,
    of_renderer,
    present,
)

WORLD = "world"
THICK_M, THIN_M = 0.3, 0.12
CHUNK_BYTES = 4 * 2**20

NS_PER_US, NS_PER_S = 1_000, 1_000_000_000
LINE_STRIP = 0
WARNING = 3

Schema = dict[str, Any]
Message = dict[str, Any]

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
    type=_INTEGER,
    pose=_POSE,
    thickness=_NUMBER,
    scale_invariant=_FLAG,
    points=_list(_VECTOR),
    color=_COLOR,
    colors=_list(_COLOR),
    indices=_list(_INTEGER),
)
_ENTITY = _object(
    timestamp=_TIME,
    frame_id=_TEXT,
    id=_TEXT,
    lifetime=_TIME,
    frame_locked=_FLAG,
    metadata=_list(_object(key=_TEXT, value=_TEXT)),
    cubes=_list(_object(pose=_POSE, size=_VECTOR, color=_COLOR)),
    lines=_list(_LINE),
)

COMPRESSED_IMAGE = _object(
    "foxglove.CompressedImage",
    timestamp=_TIME,
    frame_id=_TEXT,
    data={"type": "string", "contentEncoding": "base64"},
    format=_TEXT,
)
CAMERA_CALIBRATION = _object(
    "foxglove.CameraCalibration",
    timestamp=_TIME,
    frame_id=_TEXT,
    width=_INTEGER,
    height=_INTEGER,
    distortion_model=_TEXT,
    D=_list(_NUMBER),
    K=_list(_NUMBER),
    R=_list(_NUMBER),
    P=_list(_NUMBER),
)
FRAME_TRANSFORM = _object(
    "foxglove.FrameTransform",
    timestamp=_TIME,
    parent_frame_id=_TEXT,
    child_frame_id=_TEXT,
    translation=_VECTOR,
    rotation=_QUATERNION,
)
SCENE_UPDATE = _object(
    "foxglove.SceneUpdate",
    deletions=_list(_object(timestamp=_TIME, type=_INTEGER, id=_TEXT)),
    entities=_list(_ENTITY),
)
LOG = _object(
    "foxglove.Log",
    timestamp=_TIME,
    level=_INTEGER,
    message=_TEXT,
    name=_TEXT,
    file=_TEXT,
    line=_INTEGER,
)

Item = tuple[int, str, Schema, Message]  # time in microseconds, topic, schema, message


def write_mcap(recording: Recording, path: Path) -> dict[str, int]:
    """Write a recording.

    Args:
        recording: What to write.
        path: The file; replaced.

    Returns:
        Topic -> number of messages.

    Raises:
        InputError: The library ``mcap`` is not installed.
        InfrastructureError: The disk refuses.
    """
    writer_of = require_mcap()
    counts: dict[str, int] = {}
    with atomic_file(path) as partial, partial.open("wb") as stream:
        writer = writer_of.Writer(stream, chunk_size=CHUNK_BYTES)
        writer.start(profile="", library=f"simrun {recording.facts.get('simrun', '')}".strip())
        writer.add_metadata(
            "simrun",
            {**recording.facts, "recording": recording.name, "notes": "\n".join(recording.notes)},
        )
        channels: dict[str, int] = {}
        schemas: dict[str, int] = {}
        for t_us, topic, schema, message in heapq.merge(
            *_streams(recording), key=lambda item: item[0]
        ):
            if topic not in channels:
                text = json.dumps(schema)
                if text not in schemas:
                    schemas[text] = writer.register_schema(
                        schema["title"], "jsonschema", text.encode()
                    )
                channels[topic] = writer.register_channel(topic, "json", schemas[text])
            t_ns = t_us * NS_PER_US
            data = json.dumps(message, allow_nan=False, separators=(",", ":")).encode()
            writer.add_message(channels[topic], t_ns, data, t_ns, counts.get(topic, 0))
            counts[topic] = counts.get(topic, 0) + 1
        writer.finish()
    return counts


def require_mcap() -> Any:
    """Import the library; see `require_library`."""
    return require_library("mcap.writer", "--mcap", "install the extra [mcap], or pip install mcap")


def _streams(recording: Recording) -> Iterator[Iterator[Item]]:
    """Yield what is written, each part in order of time."""
    start_us, lines = recording.start_us, recording.lines
    kinds = dict.fromkeys(line.kind for line in lines)
    drawn = {
        kind: [polyline(line.points, MAP[kind], THIN_M) for line in lines if line.kind == kind]
        for kind in kinds
    }
    scene = scene_update(
        *(entity(start_us, kind, WORLD, lines=some) for kind, some in drawn.items())
    )
    yield iter([(start_us, "/map", SCENE_UPDATE, scene)])
    for number, drive in enumerate(recording.drives):
        rgba = of_renderer(number)
        yield _transforms(drive)
        yield _boxes(drive, rgba)
        first_us = int(drive.rig.t_us[0])
        path = entity(
            first_us, "path", WORLD, lines=[polyline(drive.rig.xyz, fainter(rgba, 0.6), THIN_M)]
        )
        yield iter([(first_us, f"/{drive.label}/path", SCENE_UPDATE, scene_update(path))])
        yield _plans(drive, rgba)
        yield _metrics(drive)
        yield _events(drive)
        for camera in drive.cameras:
            yield _calibration(drive, camera)
            yield _images(drive, camera)


def _transforms(drive: Drive) -> Iterator[Item]:
    rig = drive.rig
    for t_us, xyz, quat in zip(rig.t_us.tolist(), rig.xyz, rig.quat, strict=True):
        yield (
            t_us,
            "/tf",
            FRAME_TRANSFORM,
            frame_transform(t_us, WORLD, rig_frame(drive), xyz, quat),
        )


def rig_frame(drive: Drive) -> str:
    """Name the frame of the rear axle."""
    return f"{drive.label}/rig"


def camera_frame(drive: Drive, camera: Camera) -> str:
    """Name the frame of a camera: x right, y down, z forward."""
    return f"{drive.label}/{camera.name}"


def _boxes(drive: Drive, rgba: Rgba) -> Iterator[Item]:
    """Yield the ego and all road users that are there, at each step; a box whose actor is gone is
    gone with the next message.
    """
    log = drive.log
    steps = log.ego.t_us
    places = {name: present(actor.track, steps) for name, actor in log.actors.items()}
    for k, t_us in enumerate(steps.tolist()):
        users = []
        for name, actor in log.actors.items():
            at = int(places[name][k])
            if at >= 0:
                facts = {"id": name, "label": actor.label}
                users.append(
                    entity(
                        t_us,
                        f"user {name}",
                        WORLD,
                        [_cube(actor.box, actor.track, at, ROAD_USER)],
                        facts=facts,
                    )
                )
        gone = [name for name, where in places.items() if k and where[k] < 0 <= where[k - 1]]
        ego = entity(
            t_us,
            "ego",
            WORLD,
            [_cube(log.ego_box, log.ego, k, rgba)],
            facts={"renderer": drive.renderer},
        )
        update = scene_update(ego, *users)
        update["deletions"] = [
            {"timestamp": time_of(t_us), "type": 0, "id": f"user {name}"} for name in gone
        ]
        yield t_us, f"/{drive.label}/boxes", SCENE_UPDATE, update


def _cube(box: Box, track: Trajectory, at: int, rgba: Rgba) -> Message:
    size_m = vector(np.array([box.length_m, box.width_m, box.height_m]))
    return {"pose": pose(track.xyz[at], track.quat[at]), "size": size_m, "color": colour_of(rgba)}


def _plans(drive: Drive, rgba: Rgba) -> Iterator[Item]:
    for plan in sorted(drive.log.plans, key=lambda one: one.now_us):
        lines = [
            polyline(plan.trajectory.xyz, rgba, THICK_M),
            *(polyline(one.xyz, fainter(rgba, 0.35), THIN_M) for one in plan.samples),
        ]
        yield (
            plan.now_us,
            f"/{drive.label}/plan",
            SCENE_UPDATE,
            scene_update(entity(plan.now_us, "plan", WORLD, lines=lines)),
        )


def _metrics(drive: Drive) -> Iterator[Item]:
    """Yield one message an instant with the metrics that are valid then; a metric that is not has
    no value, never zero.

    An infinite value, such as the distance to the nearest road user where there is none, is left
    out too: JSON has none.
    """
    schema = _object("simrun.Metrics", timestamp=_TIME, **dict.fromkeys(drive.metrics, _NUMBER))
    at: dict[int, dict[str, float]] = {}
    for name, (t_us, value) in drive.metrics.items():
        for t, v in zip(t_us.tolist(), value.tolist(), strict=True):
            if np.isfinite(v):
                at.setdefault(t, {})[name] = v
    for t in sorted(at):
        yield t, f"/{drive.label}/metrics", schema, {"timestamp": time_of(t), **at[t]}


def _events(drive: Drive) -> Iterator[Item]:
    for t_us, text in sorted(drive.events):
        message = {
            "timestamp": time_of(t_us),
            "level": WARNING,
            "message": text,
            "name": drive.renderer,
            "file": "",
            "line": 0,
        }
        yield t_us, f"/{drive.label}/events", LOG, message


def _calibration(drive: Drive, camera: Camera) -> Iterator[Item]:
    if camera.spec is not None:
        t_us, frame = int(drive.rig.t_us[0]), camera_frame(drive, camera)
        mounted: F64 = camera.spec.T_rig_camera
        place = frame_transform(
            t_us, rig_frame(drive), frame, mounted[:3, 3], quat_from_matrix(mounted[:3, :3])
        )
        yield t_us, "/tf", FRAME_TRANSFORM, place
        yield (
            t_us,
            f"/{drive.label}/{camera.name}/calibration",
            CAMERA_CALIBRATION,
            camera_calibration(t_us, frame, camera.spec),
        )


def _images(drive: Drive, camera: Camera) -> Iterator[Item]:
    for one in camera.pictures():
        data, kind = (
            base64.b64encode(one.data).decode("ascii"),
            one.media_type.removeprefix("image/"),
        )
        message = {
            "timestamp": time_of(one.t_us),
            "frame_id": camera_frame(drive, camera),
            "data": data,
            "format": kind,
        }
        yield one.t_us, f"/{drive.label}/{camera.name}", COMPRESSED_IMAGE, message


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


def colour_of(rgba: Rgba) -> Message:
    """Return a colour, each part from 0 to 1."""
    return dict(zip("rgba", rgba, strict=True))


def pose(xyz: F64, quat: F64) -> Message:
    """Return a pose."""
    return {"position": vector(xyz), "orientation": quaternion(quat)}


def polyline(points: F64, rgba: Rgba, thickness_m: float) -> Message:
    """Return a line through ``(N, 3)`` metres."""
    return {
        "type": LINE_STRIP,
        "pose": pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])),
        "thickness": thickness_m,
        "scale_invariant": False,
        "points": [vector(point) for point in points],
        "color": colour_of(rgba),
        "colors": [],
        "indices": [],
    }


def entity(
    t_us: int,
    name: str,
    frame: str,
    cubes: Sequence[Message] = (),
    lines: Sequence[Message] = (),
    facts: Mapping[str, str] | None = None,
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
        "timestamp": time_of(t_us),
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": vector(xyz),
        "rotation": quaternion(quat),
    }


def camera_calibration(t_us: int, frame: str, spec: CameraSpec) -> Message:
    """Return a pinhole without distortion."""
    k = [float(value) for value in np.asarray(spec.K).reshape(-1)]
    return {
        "timestamp": time_of(t_us),
        "frame_id": frame,
        "width": spec.width,
        "height": spec.height,
        "distortion_model": "",
        "D": [],
        "K": k,
        "R": np.eye(3).reshape(-1).tolist(),
        "P": [*k[0:3], 0.0, *k[3:6], 0.0, *k[6:9], 0.0],
    }

"""Write one scene, policy and seed behind each renderer as a recording in MCAP, on one time line.

The messages have Foxglove's schemas (https://docs.foxglove.dev/docs/sdk/schemas) as JSON, so that
every MCAP reader gives them without generated classes. Positions are world metres, times are
microseconds of the log.
"""

from __future__ import annotations

import base64
import heapq
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from alpasim_plugin.core.atomic import atomic_file
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse, offset_trajectory, quat_from_matrix
from alpasim_plugin.core.lazy import require_library
from alpasim_plugin.core.types import F64, I64, Box, CameraSpec, RolloutLog, Trajectory
from alpasim_plugin.log import encode_image
from alpasim_plugin.log.run_folder.rows import Own, Rollout, series_by_cell
from evaluators.opening import Run
from evaluators.report.rollouts import events_of
from evaluators.viewer.cells import Logs, WatchedCell, no_frames
from evaluators.viewer.pictures import Source, sources

Kind = Literal["lane border", "road edge", "crosswalk", "recorded drive"]
Rgba = tuple[float, float, float, float]

RENDERERS: tuple[Rgba, ...] = (
    (0.04, 0.42, 0.70, 1.0),
    (0.85, 0.40, 0.08, 1.0),
    (0.0, 0.60, 0.45, 1.0),
    (0.65, 0.33, 0.60, 1.0),
    (0.65, 0.52, 0.0, 1.0),
)
MAP: dict[Kind, Rgba] = {
    "lane border": (0.75, 0.75, 0.78, 1.0),
    "road edge": (0.45, 0.48, 0.52, 1.0),
    "crosswalk": (0.60, 0.62, 0.65, 1.0),
    "recorded drive": (0.95, 0.95, 0.95, 0.8),
}
ROAD_USER: Rgba = (0.55, 0.57, 0.60, 0.8)


MEDIA = {b"\x89PNG": "image/png", b"\xff\xd8": "image/jpeg"}  # by the first bytes


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


@dataclass(frozen=True)
class Line:
    """One line of the map; ``points``: (N, 3) metres, world."""

    kind: Kind
    points: F64


@dataclass(frozen=True)
class Picture:
    """An encoded camera frame as it was kept; ``media_type`` is ``image/png`` or ``image/jpeg``."""

    t_us: int
    media_type: str
    data: bytes


@dataclass(frozen=True)
class Camera:
    """A camera that has frames.

    Attributes:
        name: Its name in the log.
        spec: Pinhole and place on the rig; None where the log does not say, as of a video alone.
        source: Where its frames are.
    """

    name: str
    spec: CameraSpec | None
    source: Source

    def pictures(self) -> Iterator[Picture]:
        """Yield its frames in order of time: those of a log byte for byte, those of a video as
        JPEG.

        Raises:
            InputError: A frame is neither PNG nor JPEG, or the video is damaged.
        """
        for image in self.source.images:
            yield Picture(
                image.end_us,
                media_type_of(image.data, f"camera {self.name!r} at {image.end_us} us"),
                image.data,
            )
        for t_us, rgb in self.source.filmed():
            yield Picture(t_us, "image/jpeg", encode_image(rgb, "jpeg"))


@dataclass(frozen=True)
class Drive:
    """One rollout.

    Attributes:
        renderer: Its name.
        label: The same for topics and frames: letters, digits and ``@+._-``, distinct from those of
            the other drives.
        log: Its log.
        rig: Poses of the rear axle on the ground, world.
        cameras: Those with frames.
        metrics: Metric -> times ``(T,)`` and values ``(T,)``; instants without a valid value are
            left out, never zero.
        events: Time and words of what its metrics count: the first contact, the first departure
            from the road.
    """

    renderer: str
    label: str
    log: RolloutLog
    rig: Trajectory
    cameras: tuple[Camera, ...]
    metrics: Own
    events: tuple[tuple[int, str], ...]


@dataclass(frozen=True)
class Recording:
    """Everything that a file holds.

    Attributes:
        name: Scene, policy and seed.
        facts: Where it comes from, as text.
        lines: The map.
        drives: One for each renderer.
        notes: What is missing, one sentence each.
    """

    name: str
    facts: Mapping[str, str]
    lines: tuple[Line, ...]
    drives: tuple[Drive, ...]
    notes: tuple[str, ...]

    @property
    def start_us(self) -> int:
        """Give the first instant of all drives."""
        return min(int(drive.log.ego.t_us[0]) for drive in self.drives)


def media_type_of(data: bytes, what: str) -> str:
    """Return the media type of an encoded image.

    Raises:
        InputError: Neither PNG nor JPEG.
    """
    for head, media_type in MEDIA.items():
        if data.startswith(head):
            return media_type
    raise InputError(
        f"{what}: an image that begins with {data[:4].hex()}",
        "store PNG or JPEG images in the log",
    )


def collect(run: Run, cell: WatchedCell, logs: Logs) -> Recording:
    """Collect a cell of a run.

    Args:
        run: The run.
        cell: One of its cells.
        logs: Its logs (`evaluators.viewer.cells.read_logs`).

    Raises:
        InputError: A log is damaged, there is none, or one has an instant before zero, which MCAP
            cannot write.
    """
    notes = [
        f"{r.renderer}: failed ({r.failure_class or 'unknown'}), so there is no rollout"
        for r in cell.rollouts
        if not r.ok
    ]
    found: list[tuple[Rollout, RolloutLog]] = []
    for rollout in cell.rollouts:
        log = logs.get(rollout.path)
        if isinstance(log, RolloutLog):
            found.append((rollout, log))
        elif log is not None:
            raise log
        elif rollout.ok:
            notes.append(f"{rollout.renderer}: its log is not there, so it is left out")
    if not found:
        raise InputError(
            f"{cell.name}: {'; '.join(notes) or 'no rollout'}",
            "export a run whose rollouts have finished, with their logs",
        )
    early = [rollout.renderer for rollout, log in found if int(log.ego.t_us[0]) < 0]
    if early:
        raise InputError(
            f"{cell.name}, {early[0]}: times before zero",
            "give a log whose clock begins at zero or later",
        )
    labels = distinct_labels([rollout.renderer for rollout, _ in found])
    drives = tuple(
        _drive(run, rollout, log, label)
        for (rollout, log), label in zip(found, labels, strict=True)
    )
    notes += [
        f"{d.renderer}: {no_frames(run.manifest(r), True, None)}"
        for d, (r, _) in zip(drives, found, strict=True)
        if not d.cameras
    ]
    content = run.scene_data(cell.scene)
    lines = () if content is None else map_lines(content, found[0][1].ego_log)
    if content is None:
        notes.append("the run has no map of the scene")
    return Recording(cell.name, _facts(run, cell), lines, drives, tuple(notes))


def _drive(run: Run, rollout: Rollout, log: RolloutLog, label: str) -> Drive:
    specs = {spec.name: spec for spec in log.info["cameras"]}
    cameras = tuple(
        Camera(one.camera, specs.get(one.camera), one) for one in sources(run, rollout, log)
    )
    series = series_by_cell(run.steps_of(rollout))
    events = tuple(
        (event.t_us, event.what) for event in events_of(rollout, series) if event.t_us is not None
    )
    rig = offset_trajectory(log.ego, inverse(log.T_rig_box))
    return Drive(
        rollout.renderer, label, log, rig, cameras, next(iter(series.values()), {}), events
    )


def _facts(run: Run, cell: WatchedCell) -> dict[str, str]:
    info = run.info
    facts = {
        "run": run.folder.resolve().name,
        "key": info.get("key"),
        "scene": cell.scene,
        "policy": cell.policy,
        "seed": cell.seed,
        "preset": info.get("preset"),
        "simrun": info.get("version"),
        "commit": (info.get("project") or {}).get("commit"),
        "content_hash": ((info.get("scenes") or {}).get(cell.scene) or {}).get("content_hash"),
    }
    return {key: str(value) for key, value in facts.items() if value not in (None, "")}


def map_lines(content: Mapping[str, Any], recorded: Trajectory) -> tuple[Line, ...]:
    """Return the map that a run keeps, which is flat, laid at the height of the nearest point of
    the recorded drive.

    Args:
        content: ``scenes/SCENE.json``.
        recorded: Rig poses of the recorded drive, world, at least one.
    """
    found: dict[bytes, Line] = {}

    def add(kind: Kind, line: Sequence[Sequence[float]] | None) -> None:
        if line is not None and len(line) >= 2:
            xy = np.asarray(line, dtype=np.float64)[:, :2]
            found.setdefault(
                xy.tobytes(), Line(kind, np.column_stack([xy, heights(xy, recorded.xyz)]))
            )  # lanes share borders

    for lane in content.get("lanes") or []:
        add("lane border", lane.get("left"))
        add("lane border", lane.get("right"))
    for edge in content.get("road_edges") or []:
        add("road edge", edge)
    for ring in content.get("crosswalks") or []:
        add("crosswalk", [*ring, ring[0]])
    return (*found.values(), Line("recorded drive", recorded.xyz))


def heights(xy: F64, recorded: F64) -> F64:
    """Return ``(N,)`` the height of the recorded point nearest to each of ``(N, 2)``.

    Example:
        >>> heights(np.array([[0.0, 5.0], [9.0, 0.0]]), np.array([[0.0, 0.0, 1.0], [10.0, 0.0, 2.0]])).tolist()
        [1.0, 2.0]
    """
    gaps = ((xy[:, None] - recorded[None, :, :2]) ** 2).sum(axis=2)  # (N, R)
    nearest: F64 = recorded[gaps.argmin(axis=1), 2]
    return nearest


def distinct_labels(names: Sequence[str]) -> list[str]:
    """Return names of letters, digits and ``@+._-`` alone, all different.

    Example:
        >>> distinct_labels(["3dgs", "nre://host:1", "nre///host/1"])
        ['3dgs', 'nre_host_1', 'nre_host_1-2']
    """
    labels: list[str] = []
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9@+._-]+", "_", name).strip("_") or "renderer"
        tries = (plain, *(f"{plain}-{k}" for k in range(2, len(names) + 2)))
        labels.append(next(one for one in tries if one not in labels))
    return labels


def present(track: Trajectory, t_us: I64) -> I64:
    """Return the index ``(T,)`` of each instant among a track's own, -1 where the body is not
    there.
    """
    at = np.searchsorted(track.t_us, t_us)
    inside = at < len(track)
    same = np.zeros(len(t_us), dtype=bool)
    same[inside] = track.t_us[at[inside]] == t_us[inside]
    return np.where(same, at, -1).astype(np.int64)


def of_renderer(number: int) -> Rgba:
    """Return the colour of the n-th renderer."""
    return RENDERERS[number % len(RENDERERS)]


def fainter(rgba: Rgba, alpha: float) -> Rgba:
    """Return a colour that lets more through."""
    return (*rgba[:3], alpha)


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

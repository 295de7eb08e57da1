"""Write a recording as MCAP with Foxglove's schemas, in order of time."""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.geometry import quat_from_matrix
from alpasim_plugin.core.lazy import require_library
from alpasim_plugin.core.types import F64, Box, Trajectory
from alpasim_plugin.io.atomic import atomic_file
from alpasim_plugin.recordings import foxglove as fg
from alpasim_plugin.recordings.content import DOING, MAP, ROAD_USER, Camera, Drive, Line, Recording, fainter, of_renderer, present

WORLD = "world"
THICK_M, THIN_M = 0.3, 0.12
CHUNK_BYTES = 4 * 2**20

Item = tuple[int, str, fg.Schema, fg.Message]  # time in microseconds, topic, schema, message


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
    with atomic_file(path, "writing an MCAP file") as partial, partial.open("wb") as stream:
        writer = writer_of.Writer(stream, chunk_size=CHUNK_BYTES)
        writer.start(profile="", library=f"simrun {recording.facts.get('simrun', '')}".strip())
        writer.add_metadata("simrun", {**recording.facts, "recording": recording.name, "notes": "\n".join(recording.notes)})
        channels: dict[str, int] = {}
        schemas: dict[str, int] = {}
        for t_us, topic, schema, message in heapq.merge(*_streams(recording), key=lambda item: item[0]):
            if topic not in channels:
                text = json.dumps(schema)
                if text not in schemas:
                    schemas[text] = writer.register_schema(schema["title"], "jsonschema", text.encode())
                channels[topic] = writer.register_channel(topic, "json", schemas[text])
            t_ns = t_us * fg.NS_PER_US
            data = json.dumps(message, allow_nan=False, separators=(",", ":")).encode()
            writer.add_message(channels[topic], t_ns, data, t_ns, counts.get(topic, 0))
            counts[topic] = counts.get(topic, 0) + 1
        writer.finish()
    return counts


def require_mcap() -> Any:
    """Import the library; see `require_library`."""
    return require_library("mcap.writer", DOING, "--mcap", "install the extra [mcap], or pip install mcap")


def _streams(recording: Recording) -> Iterator[Iterator[Item]]:
    """Yield what is written, each part in order of time."""
    yield iter([(recording.start_us, "/map", fg.SCENE_UPDATE, _map(recording.start_us, recording.lines))])
    for number, drive in enumerate(recording.drives):
        rgba = of_renderer(number)
        yield _transforms(drive)
        yield _boxes(drive, rgba)
        yield iter([_driven_path(drive, rgba)])
        yield _plans(drive, rgba)
        yield _metrics(drive)
        yield ((t_us, f"/{drive.label}/events", fg.LOG, fg.log_message(t_us, drive.renderer, text)) for t_us, text in sorted(drive.events))
        for camera in drive.cameras:
            yield _calibration(drive, camera)
            yield _images(drive, camera)


def _map(t_us: int, lines: Sequence[Line]) -> fg.Message:
    kinds = dict.fromkeys(line.kind for line in lines)
    drawn = {kind: [fg.line(line.points, MAP[kind], THIN_M) for line in lines if line.kind == kind] for kind in kinds}
    return fg.scene_update(*(fg.entity(t_us, kind, WORLD, lines=some) for kind, some in drawn.items()))


def _transforms(drive: Drive) -> Iterator[Item]:
    rig = drive.rig
    for t_us, xyz, quat in zip(rig.t_us.tolist(), rig.xyz, rig.quat, strict=True):
        yield t_us, "/tf", fg.FRAME_TRANSFORM, fg.frame_transform(t_us, WORLD, rig_frame(drive), xyz, quat)


def rig_frame(drive: Drive) -> str:
    """Name the frame of the rear axle."""
    return f"{drive.label}/rig"


def camera_frame(drive: Drive, camera: Camera) -> str:
    """Name the frame of a camera: x right, y down, z forward."""
    return f"{drive.label}/{camera.name}"


def _boxes(drive: Drive, rgba: fg.Rgba) -> Iterator[Item]:
    """Yield the ego and all road users that are there, at each step; a box whose actor is gone is gone with the next message."""
    log = drive.log
    steps = log.ego.t_us
    places = {name: present(actor.track, steps) for name, actor in log.actors.items()}
    for k, t_us in enumerate(steps.tolist()):
        users = []
        for name, actor in log.actors.items():
            at = int(places[name][k])
            if at >= 0:
                facts = {"id": name, "label": actor.label}
                users.append(fg.entity(t_us, f"user {name}", WORLD, [_cube(actor.box, actor.track, at, ROAD_USER)], facts=facts))
        gone = [name for name, where in places.items() if k and where[k] < 0 <= where[k - 1]]
        ego = fg.entity(t_us, "ego", WORLD, [_cube(log.ego_box, log.ego, k, rgba)], facts={"renderer": drive.renderer})
        update = fg.scene_update(ego, *users)
        update["deletions"] = [{"timestamp": fg.time_of(t_us), "type": 0, "id": f"user {name}"} for name in gone]
        yield t_us, f"/{drive.label}/boxes", fg.SCENE_UPDATE, update


def _cube(box: Box, track: Trajectory, at: int, rgba: fg.Rgba) -> fg.Message:
    return fg.cube(track.xyz[at], track.quat[at], (box.length_m, box.width_m, box.height_m), rgba)


def _driven_path(drive: Drive, rgba: fg.Rgba) -> Item:
    t_us = int(drive.rig.t_us[0])
    path = fg.entity(t_us, "path", WORLD, lines=[fg.line(drive.rig.xyz, fainter(rgba, 0.6), THIN_M)])
    return t_us, f"/{drive.label}/path", fg.SCENE_UPDATE, fg.scene_update(path)


def _plans(drive: Drive, rgba: fg.Rgba) -> Iterator[Item]:
    for plan in sorted(drive.log.plans, key=lambda one: one.now_us):
        lines = [fg.line(plan.trajectory.xyz, rgba, THICK_M), *(fg.line(one.xyz, fainter(rgba, 0.35), THIN_M) for one in plan.samples)]
        yield plan.now_us, f"/{drive.label}/plan", fg.SCENE_UPDATE, fg.scene_update(fg.entity(plan.now_us, "plan", WORLD, lines=lines))


def _metrics(drive: Drive) -> Iterator[Item]:
    """Yield one message an instant with the metrics that are valid then; a metric that is not has no value, never zero.

    An infinite value, such as the distance to the nearest road user where there is none, is left out too: JSON has none.
    """
    schema = fg.metrics_schema(drive.metrics)
    at: dict[int, dict[str, float]] = {}
    for name, (t_us, value) in drive.metrics.items():
        for t, v in zip(t_us.tolist(), value.tolist(), strict=True):
            if np.isfinite(v):
                at.setdefault(t, {})[name] = v
    for t in sorted(at):
        yield t, f"/{drive.label}/metrics", schema, {"timestamp": fg.time_of(t), **at[t]}


def _calibration(drive: Drive, camera: Camera) -> Iterator[Item]:
    if camera.spec is not None:
        t_us, frame = int(drive.rig.t_us[0]), camera_frame(drive, camera)
        mounted: F64 = camera.spec.T_rig_camera
        place = fg.frame_transform(t_us, rig_frame(drive), frame, mounted[:3, 3], quat_from_matrix(mounted[:3, :3]))
        yield t_us, "/tf", fg.FRAME_TRANSFORM, place
        yield t_us, f"/{drive.label}/{camera.name}/calibration", fg.CAMERA_CALIBRATION, fg.camera_calibration(t_us, frame, camera.spec)


def _images(drive: Drive, camera: Camera) -> Iterator[Item]:
    for one in camera.pictures():
        message = fg.compressed_image(one.t_us, camera_frame(drive, camera), one.media_type, one.data)
        yield one.t_us, f"/{drive.label}/{camera.name}", fg.COMPRESSED_IMAGE, message

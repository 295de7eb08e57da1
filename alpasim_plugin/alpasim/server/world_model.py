"""AlpaSim's video-model service, ``WorldModelService``: whole chunks of frames, by the renderer and
the fixer of `simrun serve`.

A session receives the map and the cameras, then for each chunk the rig's poses and the road users.
The scene is found by the clip's id in the names of the map's tables; our renderer draws it, and the
fixer goes over the frames one after another, so that chunks of any length give the same frames. The
first chunk has 5 frames (1 + 4 k), every later one 8 (4 k): one frame for each pose.

Extrinsics are in sensor axes here (x forward, y left, z up), unlike in the renderer service. The
recorded first frame and the prompts are checked and not used: what is drawn is the scene of the
renderer, not a continuation of the recording.
"""

from __future__ import annotations

import threading
import time
import uuid
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any

import numpy as np

from alpasim_plugin.alpasim.server.caches import FixerCache, SceneCache, SceneEntry
from alpasim_plugin.alpasim.server.hosting import Sessions
from alpasim_plugin.alpasim.server.status import CallTime, Failures, UnknownScene, answering
from alpasim_plugin.alpasim.server.views import Lens, read_lens, read_pose
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import interpolate
from alpasim_plugin.core.reading import parsing
from alpasim_plugin.core.reading.images import check_image
from alpasim_plugin.core.types import F64, U8, Actor, CameraSpec, RenderRequest
from alpasim_plugin.fixers.semantic_map.draw import draw_map
from alpasim_plugin.fixers.semantic_map.prepare import actor_boxes, prepare_map
from alpasim_plugin.log.images import encode_image
from alpasim_plugin.log.wire import common_pb2, video_model_pb2

DOING = "serving AlpaSim's video-model service"
FLU_FROM_CAMERA = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
SAME_SIZE_M = 2e-3  # sizes of boxes come in float32
MAX_FRAMES, MAX_MEMBERS = 64, 256


@dataclass
class Session:
    """One rollout.

    Attributes:
        scene_id, seed: What is drawn; key of the fixer's noise.
        cameras: Name, lens and pinhole of every view.
        with_map, with_rgb: Which frames to return.
        past: The fixer's, by camera.
        end_us: Time of the last frame.
        last: The last chunk's request and answer: the same request again is answered alike.
    """

    scene_id: str
    seed: int
    cameras: list[tuple[str, Lens, CameraSpec]]
    with_map: bool
    with_rgb: bool
    past: dict[str, Any] = field(default_factory=dict)
    end_us: int | None = None
    last: tuple[bytes, video_model_pb2.VideoChunkReturn] | None = None
    lock: threading.Lock = field(default_factory=threading.Lock)


class WorldModel(Failures):
    """The service.

    Args:
        scenes: Scenes with renderers.
        fixers: Fixes; None: frames are given as rendered.
        busy: Held while something is computed, shared with the renderer service.
        version: The triple to report.
        threads: Threads of the map rasteriser.
        expiry_s: Sessions unused for so long are forgotten.
        clock: Monotonic seconds.
    """

    def __init__(
        self,
        scenes: SceneCache,
        fixers: FixerCache | None,
        busy: threading.Lock,
        version: common_pb2.VersionId,
        threads: int | None = None,
        expiry_s: float = 900.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__()
        self._scenes, self._fixers, self._busy, self._version, self._threads = (
            scenes,
            fixers,
            busy,
            version,
            threads,
        )
        self.sessions: Sessions[Session] = Sessions(expiry_s, clock=clock)

    @answering
    def get_version(self, request: common_pb2.Empty, context: Any) -> common_pb2.VersionId:
        """Return the triple."""
        return self._version

    @answering
    def start_session(
        self, request: video_model_pb2.SessionRequest, context: Any
    ) -> video_model_pb2.SessionId:
        """Begin a rollout; a seed of 0 is a seed like any other, so that the same session gives the
        same frames.
        """
        specs = request.camera_specs
        mounts = request.rig_to_camera
        frames = request.initial_frames
        if not specs or not len(specs) == len(mounts) == len(frames):
            raise InputError(
                f"a session request: {len(specs)} camera_specs, {len(mounts)} rig_to_camera, {len(frames)} initial_frames",
                "send one of each for every view",
            )
        names = [spec.logical_id for spec in specs]
        if len(set(names)) < len(names):
            raise InputError(
                f"a session request: cameras {names}", "give every view its own logical_id"
            )
        scene_id = self._scene_of(clip_of(request.static_world_map.hdmap_parquets))
        cameras = []
        for spec, mount, frame in zip(specs, mounts, frames, strict=True):
            what = f"camera {spec.logical_id!r}"
            check_image(frame.data, f"{what}, its initial frame")
            lens = read_lens(spec, spec.resolution_w, spec.resolution_h)
            cameras.append(
                (
                    spec.logical_id,
                    lens,
                    lens.spec(spec.logical_id, read_pose(mount, what) @ FLU_FROM_CAMERA),
                )
            )
        self._scenes.get(
            scene_id, CallTime(context)
        )  # built now: a chunk has no deadline, but a rollout waits for it
        session = Session(
            scene_id,
            request.random_seed,
            cameras,
            request.debug_options.return_hdmap_frames,
            not request.debug_options.skip_video_generation,
        )
        name = uuid.uuid4().hex
        self.sessions.open(name, session)
        return video_model_pb2.SessionId(session_id=name)

    @answering
    def close_session(
        self, request: video_model_pb2.SessionCloseRequest, context: Any
    ) -> common_pb2.Empty:
        """End a rollout; a session that is unknown or closed is fine."""
        self.sessions.close(request.session_id)
        return common_pb2.Empty()

    @answering
    def render_video_chunk(
        self, request: video_model_pb2.VideoChunkRequest, context: Any
    ) -> video_model_pb2.VideoChunkReturn:
        """Return one frame for every pose, of every camera."""
        left = CallTime(context)
        session = self.sessions.get(request.session_id.session_id)
        if session is None:
            raise UnknownScene(
                f"session {request.session_id.session_id!r}: it is unknown, closed or expired",
                "start a session first",
            )
        with left.holding(session.lock):
            data = request.SerializeToString(deterministic=True)
            if session.last is None or session.last[0] != data:
                session.last = data, self._chunk(session, request, left)
            return session.last[1]

    def _chunk(
        self, session: Session, request: video_model_pb2.VideoChunkRequest, left: CallTime
    ) -> video_model_pb2.VideoChunkReturn:
        poses = request.rig_trajectory.poses
        check_length(len(poses), session.end_us is None)
        times = [pose.timestamp_us for pose in poses]
        before = [*([] if session.end_us is None else [session.end_us]), *times[:-1]]
        if any(
            b >= t for b, t in zip(before, times[-len(before) :] if before else [], strict=True)
        ):
            raise InputError(
                f"session of {session.scene_id!r}: times {times} after {session.end_us}",
                "give times that increase",
            )
        entry = self._scenes.get(session.scene_id, left)
        rig = [read_pose(pose.pose, f"rig pose at {pose.timestamp_us} us") for pose in poses]
        boxes = boxes_by_time(entry, request.dynamic_state.actors, times)
        outputs, past = [], dict(session.past)
        for camera in session.cameras:
            output = video_model_pb2.CameraOutput(camera_logical_id=camera[0])
            for t_us, T_world_rig, at in zip(times, rig, boxes, strict=True):
                with left.holding(self._busy):
                    rgb, sdmap = self._frame(session, entry, camera, t_us, T_world_rig, at, past)
                if session.with_rgb:
                    output.rgb_frames.append(as_jpeg(rgb))
                if session.with_map:
                    output.hdmap_condition_frames.append(as_jpeg(sdmap))
            outputs.append(output)
        session.past, session.end_us = (
            past,
            times[-1],
        )  # only when all went well: a failed chunk can be asked for again
        return video_model_pb2.VideoChunkReturn(camera_outputs=outputs)

    def _frame(
        self,
        session: Session,
        entry: SceneEntry,
        camera: tuple[str, Lens, CameraSpec],
        t_us: int,
        T_world_rig: F64,
        boxes: dict[str, F64],
        past: dict[str, Any],
    ) -> tuple[U8, U8]:
        name, lens, pinhole = camera
        pose = T_world_rig @ pinhole.T_rig_camera
        needs_map = self._fixers is not None and self._fixers.needs_map
        sdmap: U8 = np.zeros((lens.height, lens.width, 3), np.uint8)
        if needs_map or session.with_map:
            scene_map = entry.scene_map or prepare_map(entry.scenario.lane_map)
            sdmap = lens.image(
                draw_map(
                    scene_map,
                    pinhole,
                    pose,
                    actor_boxes(boxes, entry.scenario.actors),
                    threads=self._threads,
                )
            )
        if not session.with_rgb:
            return sdmap, sdmap
        frame = lens.frame(
            entry.render(RenderRequest(t_us, pinhole, np.stack([pose, pose]), boxes))
        )
        if self._fixers is None:
            return frame.rgb, sdmap
        fixer = self._fixers.of(session.scene_id, session.seed)
        frame, past[name] = fixer.advance(frame, sdmap if needs_map else None, past.get(name))
        return frame.rgb, sdmap

    def _scene_of(self, clip: str) -> str:
        known = set(self._scenes.ids)
        for scene_id in (clip, f"clipgt-{clip}"):
            if scene_id in known:
                return scene_id
        raise UnknownScene(
            f"clip {clip!r}: none of the {len(known)} known scenes is it",
            "add the scene's file to --scenes",
        )


def clip_of(archive: bytes) -> str:
    """Return the clip's id from the names of a zipped map: ``CLIP.TABLE.parquet``.

    Raises:
        InputError: No ZIP, or names that are not those of one clip.
    """
    what = f"{len(archive)} bytes that are no ZIP"
    with (
        parsing("the map of a session", "send zipped parquet tables", what),
        zipfile.ZipFile(BytesIO(archive)) as zipped,
    ):
        names = zipped.namelist()[:MAX_MEMBERS]
    clips = {
        name.removesuffix(".parquet").rpartition(".")[0]
        for name in names
        if name.endswith(".parquet")
    }
    if len(clips) != 1 or "" in clips:
        raise InputError(
            f"the map of a session: {len(names)} members of clips {sorted(clips)[:3]}",
            "send members named CLIP.TABLE.parquet, all of one clip",
        )
    return clips.pop()


def check_length(frames: int, first: bool) -> None:
    """Raise `InputError` unless a chunk has 5, 9, 13, ... frames at first and 4, 8, 12, ...
    later.
    """
    if not 0 < frames <= MAX_FRAMES or frames % 4 != (1 if first else 0):
        rule = (
            "1 + 4 k in the first chunk (5, 9, 13)" if first else "4 k in a later chunk (8, 12, 16)"
        )
        raise InputError(f"a chunk: {frames} poses", f"ask for {rule}, at most {MAX_FRAMES}")


def boxes_by_time(
    entry: SceneEntry, actors: Sequence[Any], times: Sequence[int]
) -> list[dict[str, F64]]:
    """Return the box poses by actor at every frame's time. The wire has no ids: a road user is the
    scene's of its size, the nearest first.

    Raises:
        InputError: A road user of a size that the scene does not have, or more of them.
    """
    free = {actor.actor_id: actor for actor in entry.scenario.actors if not actor.is_static}
    out: list[dict[str, F64]] = [
        {
            a.actor_id: interpolate(a.track, t)
            for a in entry.scenario.actors
            if a.is_static and a.track.t_us[0] <= t <= a.track.t_us[-1]
        }
        for t in times
    ]
    for index, given in enumerate(actors):
        poses = {
            p.timestamp_us: read_pose(p.pose, f"actor {index} at {p.timestamp_us} us")
            for p in given.trajectory.poses
        }
        if not poses:
            continue
        size = np.array([given.bbox_dims.size_x, given.bbox_dims.size_y, given.bbox_dims.size_z])
        alike = [
            actor for actor in free.values() if np.abs(sizes(actor) - size).max() < SAME_SIZE_M
        ]
        if not alike:
            raise InputError(
                f"scene {entry.scenario.scene_id!r}: road user {index} of {np.round(size, 3).tolist()} m",
                "render with the scene file that the runtime uses",
            )
        t_us, pose = next(iter(poses.items()))
        one = min(alike, key=lambda actor: (away(actor, t_us, pose), actor.actor_id))
        del free[one.actor_id]
        for boxes, t in zip(out, times, strict=True):
            if t in poses:
                boxes[one.actor_id] = poses[t]
    return out


def sizes(actor: Actor) -> F64:
    """Return length, width and height of an actor."""
    return np.array([actor.box.length_m, actor.box.width_m, actor.box.height_m])


def away(actor: Actor, t_us: int, pose: F64) -> float:
    """Return the distance, in the plane, from where an actor's track is at a time; its nearest end
    where it is not there then.
    """
    t = int(np.clip(t_us, actor.track.t_us[0], actor.track.t_us[-1]))
    return float(np.linalg.norm(interpolate(actor.track, t)[:2, 3] - pose[:2, 3]))


def as_jpeg(rgb: U8) -> video_model_pb2.Image:
    """Encode a frame."""
    return video_model_pb2.Image(data=encode_image(rgb, "jpeg"), format=video_model_pb2.JPEG)

"""Camera frames for a log that has none: AlpaSim's aggregation stops where no log has an image, and a policy without cameras sees none.

The rollout's own renderer renders the main camera along the logged poses. The policy never saw these frames, so the drive is the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from alpasim_plugin.core.geometry import inverse, offset_trajectory, se3
from alpasim_plugin.core.types import F64, CameraSpec, RenderRequest, RolloutLog, Trajectory
from alpasim_plugin.log.images import encode_image
from alpasim_plugin.log.schema import wire_camera, wire_image, wire_render_request
from alpasim_plugin.plugins.interfaces import Renderer
from alpasim_plugin.runtime.guards import checked_frames
from alpasim_plugin.runtime.loop_state import shutter_poses
from alpasim_plugin.wire import logging_pb2, sensorsim_pb2


class AddedFrames:
    """Adds a camera and its frames to a log; a stage of `alpasim_plugin.log.asl.copy_log`.

    Args:
        rollout: The log as read.
        camera: The camera to add.
        interval_us: Time from frame to frame; the first is at the log's render start.
        make_renderer: Makes the rollout's renderer; called once, at the first frame.

    Attributes:
        frames: How many were added.
    """

    def __init__(self, rollout: RolloutLog, camera: CameraSpec, interval_us: int, make_renderer: Callable[[], Renderer]) -> None:
        self._rollout, self._camera, self._make = rollout, camera, make_renderer
        self._requests = logged_requests(rollout, camera, interval_us)
        self._index = {request.t_us: i for i, request in enumerate(self._requests)}
        self._renderer: Renderer | None = None
        self._waiting: list[RenderRequest] = []
        self._blocks = 0
        self.frames = 0

    def __call__(self, entry: logging_pb2.LogEntry) -> list[logging_pb2.LogEntry]:
        """Return the entry, with its cameras extended, and the frames that are due after it."""
        kind = entry.WhichOneof("log_entry")
        if kind == "available_cameras_return":
            entry.available_cameras_return.available_cameras.append(wire_camera(self._camera))
        elif kind == "driver_session_request":
            entry.driver_session_request.rollout_spec.vehicle.available_cameras.append(wire_camera(self._camera))
        elif kind == "actor_poses" and int(entry.actor_poses.timestamp_us) in self._index:
            return [entry, *self._render(self._index[int(entry.actor_poses.timestamp_us)])]
        return [entry]

    def _render(self, i: int) -> list[logging_pb2.LogEntry]:
        """Return the entries of the frames that are ready: those of a whole block, for a renderer that works in blocks."""
        renderer = self._renderer = self._renderer or self._make()
        self._waiting.append(replace(self._requests[i], ahead=self._requests[i + 1 : i + 1 + renderer.lookahead]))
        if renderer.block is not None and len(self._waiting) < renderer.block.frames(self._blocks):
            return []
        requests, self._waiting = self._waiting, []
        self._blocks += 1
        out = []
        for request, frame in zip(requests, checked_frames(renderer, requests), strict=True):
            one = wire_render_request(self._rollout.scene_id, request, "jpeg")
            item = sensorsim_pb2.BatchRGBRenderRequestItem(camera_name=self._camera.name, request=one)
            out.append(logging_pb2.LogEntry(batch_render_request=sensorsim_pb2.BatchRGBRenderRequest(items=[item])))
            image, start_us = encode_image(frame.rgb, "jpeg"), request.t_us - self._camera.shutter_us
            own = wire_image(self._rollout.session_uuid, self._camera.name, start_us, request.t_us, image)
            out.append(logging_pb2.LogEntry(driver_camera_image=own))
        self.frames += len(requests)
        return out


def logged_requests(rollout: RolloutLog, camera: CameraSpec, interval_us: int) -> list[RenderRequest]:
    """Return the requests for a camera along a log's poses, one every ``interval_us`` from its render start."""
    rig = offset_trajectory(rollout.ego, inverse(rollout.T_rig_box))
    due = [int(t) for t in rig.t_us if t >= rollout.render_start_us and (t - rollout.render_start_us) % interval_us == 0]
    actors: dict[int, dict[str, F64]] = {t: {} for t in due}
    for name, actor in rollout.actors.items():
        poses = se3(actor.track.xyz, actor.track.quat)
        for t, pose in zip(actor.track.t_us.tolist(), poses, strict=True):
            if t in actors:
                actors[t][name] = pose
    out = []
    for t in due:
        upto = int(np.searchsorted(rig.t_us, t, side="right"))
        history = Trajectory(rig.t_us[:upto], rig.xyz[:upto], rig.quat[:upto])
        out.append(RenderRequest(t, camera, shutter_poses(history, camera, t), actors[t]))
    return out

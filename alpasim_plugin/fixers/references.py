"""Recorded frames as references of a fixer: which of them a frame receives. `fixers.ground` carries
them into its view.

Whoever has a reconstruction has the photographs it was fitted to. A reference is such a photograph,
carried into the view by the render's own depth and by the poses that the reconstruction believes;
pixels of a road user move with its box. Both are as wrong as the reconstruction is, so each
reference comes with a validity mask, and the fixer learns how much of it to use.

A recording is known in full before a rollout begins: frames that were recorded after the present
time are references as well, unless ``past`` asks for earlier ones alone. Nothing of the rollout's
own future is looked at.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from alpasim_plugin.core.geometry import se3
from alpasim_plugin.core.shutter import bands
from alpasim_plugin.core.types import (
    F64,
    I64,
    U8,
    Actor,
    DevicePlanes,
    Frame,
    RecordedFrame,
    RenderRequest,
    Scenario,
    Trajectory,
)
from alpasim_plugin.fixers.ground import carry, window_px, with_users
from alpasim_plugin.fixers.settings import FixerSettings
from alpasim_plugin.fixers.warp import RecordedImage, WarpTarget
from alpasim_plugin.gaussians.raster.rasterize_cpu import thread_count

KEPT_FRAMES = 24  # decoded recorded frames that a session keeps
SECOND_M, TURN_M = (
    0.5,
    10.0,
)  # a second apart counts as so many metres, and so does a view that is turned by a radian
FARTHEST_M = 25.0  # a recorded frame from farther away is no reference
# the distance of a frame that the last image had counts as this share of it, so that references
# do not flicker
STAY = 0.75
# a recorded frame from longer before or after is no reference: light, and what stands about, has
# changed
SPAN_S = 6.0


class ReferenceIndex:
    """The recorded frames of a scene by pose and time.

    Args:
        recorded: Of all cameras, any order.
    """

    def __init__(self, recorded: Sequence[RecordedFrame]) -> None:
        self.recorded = tuple(recorded)
        T = np.array([frame.T_world_camera for frame in recorded]).reshape(-1, 4, 4)
        self._centres, self._axes = T[:, :3, 3], T[:, :3, 2]
        self._t_us: I64 = np.array([frame.t_us for frame in recorded], np.int64)
        self._focal_px = np.array([frame.K[0, 0] for frame in recorded])

    def choose(
        self,
        T_world_camera: F64,
        t_us: int,
        count: int,
        last: Sequence[int] = (),
        past: bool = False,
        focal_px: float = 1.0,
    ) -> tuple[int, ...]:
        """Return the nearest recorded frames, nearest first.

        The distance is that of the cameras' centres, plus `SECOND_M` a second and `TURN_M` a radian
        between the optical axes. A frame that shows a surface with a quarter of the view's pixels
        counts as four times as far.

        Args:
            T_world_camera: ``(4, 4)`` of the view.
            t_us: Its time.
            count: Frames at most.
            last: What the same camera received for its last frame: these stay a little longer.
            past: Only frames recorded before ``t_us``.
            focal_px: Of the view.
        """
        if not count or not self.recorded:
            return ()
        moved = np.linalg.norm(self._centres - T_world_camera[:3, 3], axis=1)
        turned = np.arccos(np.clip(self._axes @ T_world_camera[:3, 2], -1, 1))
        apart_s = np.abs(self._t_us - t_us) * 1e-6
        distance = moved + TURN_M * turned + SECOND_M * apart_s
        distance *= np.maximum(focal_px / self._focal_px, 1) ** 2
        distance[list(last)] *= STAY
        usable = (moved <= FARTHEST_M) & (turned < np.pi / 3) & (apart_s <= SPAN_S)
        if past:
            usable &= self._t_us < t_us
        order = np.argsort(np.where(usable, distance, np.inf), kind="stable")[:count]
        return tuple(int(i) for i in order if usable[i])


class ReferenceSession:
    """The references of one rollout's frames.

    Args:
        recorded: What the renderer declares.
        actors: The scenario's, for the sizes of their boxes.
        ego_log: Of the rig; the ground of a view is that of the pose nearest to its camera.
        count: References of a frame, at most.
        which: ``all`` of the recording, or only what was recorded before the frame's time.
        hysteresis: Whether a camera keeps its references a little longer than they are nearest.
            Without it the references of a view do not depend on what came before, as a server of
            several drives needs.
        threads: Threads that carry them.
    """

    def __init__(
        self,
        recorded: Sequence[RecordedFrame],
        actors: Sequence[Actor],
        ego_log: Trajectory,
        count: int,
        which: Literal["all", "past"] = "all",
        hysteresis: bool = True,
        threads: int = 1,
    ) -> None:
        self.index, self.count, self.past, self.hysteresis = (
            ReferenceIndex(recorded),
            count,
            which == "past",
            hysteresis,
        )
        self.threads = threads
        self._boxes, self._ego_log = {actor.actor_id: actor.box for actor in actors}, ego_log
        self._last: dict[str, tuple[int, ...]] = {}
        self._recorded: OrderedDict[int, RecordedImage] = OrderedDict()
        self._uploaded: dict[int, Any] = {}  # those of them that lie on a device

    def of(self, request: RenderRequest, frame: Frame) -> tuple[U8, ...]:
        """Return the references of a rendered frame, nearest first; none without depth.

        Args:
            request: What was rendered.
            frame: The render, whose depth carries the recorded frames into its view.
        """
        if frame.depth is None:
            return ()
        chosen, T_world_rig = self._choose(request)
        images = [self._recorded_image(i) for i in chosen]
        out = tuple(np.zeros((*frame.depth.shape, 4), np.uint8) for _ in images)
        self._put(
            out,
            request,
            frame.depth,
            lambda target: carry(images, target, T_world_rig, self.threads),
        )
        return out

    def _put(
        self, out: Any, request: RenderRequest, depth: Any, carried: Callable[[WarpTarget], Any]
    ) -> None:
        """Write recorded frames, carried into each band of a view ``(H, W)``, into ``out``."""
        around = window_px(
            request.camera.K
        )  # what `carry` decides of a pixel depends on those around it
        for band in bands(request):
            top = max(band.rows.start - around, 0)
            K = request.camera.K.copy()
            K[1, 2] -= top
            near = depth[top : band.rows.stop + around]
            target = WarpTarget(K, band.T_world_camera, near, band.actors, self._boxes)
            own = slice(band.rows.start - top, band.rows.stop - top), band.columns
            for whole, part in zip(out, carried(target), strict=True):
                band.put(whole, part[own])

    def added(self, request: RenderRequest, frame: Frame, on_device: bool) -> Frame:
        """Return a rendered frame with its references.

        Args:
            request: What was rendered.
            frame: The render.
            on_device: Whether those of a frame that a device drew may stay there.
        """
        if on_device and frame.pending is not None:
            return frame.changed(on_device=self._on_device(request, frame.pending))
        return frame.changed(references=self.of(request, frame))

    def _on_device(self, request: RenderRequest, planes: DevicePlanes) -> DevicePlanes:
        """Return the planes of a rendered frame with its references, both on their device."""
        from alpasim_plugin.fixers import device_carry

        chosen, T_world_rig = self._choose(request)
        if not chosen:
            return planes
        device = planes.rgb.device
        for i in chosen:
            recorded = self._recorded_image(i)
            if i not in self._uploaded:
                self._uploaded[i] = device_carry.upload_image(recorded, device)
        images = [self._uploaded[i] for i in chosen]

        def carried(drawn: DevicePlanes) -> Mapping[str, Any]:
            out = drawn.rgb.new_zeros((len(images), *drawn.size, 4))
            self._put(
                out,
                request,
                drawn.depth,
                lambda target: device_carry.carry_on_device(images, target, T_world_rig),
            )
            return {"references": out}

        return planes.changed(carried)

    def _choose(self, request: RenderRequest) -> tuple[tuple[int, ...], F64]:
        """Return which recorded frames a view receives, and the rig's pose nearest to it."""
        T_world_camera, camera = request.T_world_camera[1], request.camera.name
        last = self._last.get(camera, ())
        focal_px = float(request.camera.K[0, 0])
        chosen = self.index.choose(
            T_world_camera, request.t_us, self.count, last, self.past, focal_px
        )
        if self.hysteresis:
            self._last[camera] = chosen
        at = int(np.linalg.norm(self._ego_log.xyz - T_world_camera[:3, 3], axis=1).argmin())
        return chosen, se3(self._ego_log.xyz[at], self._ego_log.quat[at])

    def _recorded_image(self, i: int) -> RecordedImage:
        if i not in self._recorded:
            frame = self.index.recorded[i]
            recorded = RecordedImage(frame.K, frame.T_world_camera, *frame.read(), frame.actors)
            self._recorded[i] = with_users(recorded, self._boxes)
            if len(self._recorded) > KEPT_FRAMES:
                dropped, _ = self._recorded.popitem(last=False)
                self._uploaded.pop(dropped, None)
        self._recorded.move_to_end(i)
        return self._recorded[i]


def session_of(
    settings: FixerSettings,
    scenario: Scenario,
    recorded: Sequence[RecordedFrame],
    threads: int | None = None,
    hysteresis: bool = True,
) -> ReferenceSession | None:
    """Return the references of a scenario's rollout as a fixer's settings have them; None where
    there are none. See `ReferenceSession`.
    """
    if not (settings.references and recorded):
        return None
    of = recorded, scenario.actors, scenario.ego_log, settings.references, settings.recording
    return ReferenceSession(*of, hysteresis, thread_count(threads))

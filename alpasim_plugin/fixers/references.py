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

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np

from alpasim_plugin.cameras.lens import (
    blackened,
    exposed_bands,
    focal_px_of,
    intrinsics_on_axis,
    lens_camera,
)
from alpasim_plugin.cameras.shutter import Band, joined
from alpasim_plugin.core.devices import batched
from alpasim_plugin.core.geometry import se3
from alpasim_plugin.core.types import (
    F64,
    I64,
    Actor,
    CameraSpec,
    DevicePlanes,
    Frame,
    RecordedFrame,
    RenderRequest,
    Scenario,
    Trajectory,
)
from alpasim_plugin.fixers.ground import carry, window_px, with_users
from alpasim_plugin.fixers.settings import FixerSettings
from alpasim_plugin.fixers.views import planes_of
from alpasim_plugin.fixers.warp import RecordedImage, WarpTarget, recorded_lens
from alpasim_plugin.gaussians.lens_camera import blind_part, lens_rays
from alpasim_plugin.gaussians.raster.lens_on_device import rays_on_device
from alpasim_plugin.gaussians.raster.stages import map_on_threads, thread_count

# Decoded recorded frames that a session keeps, at least; of many cameras, those of so many instants.
KEPT_FRAMES = 24
KEPT_INSTANTS = 4
SECOND_M = 0.5  # as so many metres counts a second apart
TURN_M = 10.0  # as so many metres counts a view that is turned by a radian
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
        self._centres = T[:, :3, 3]
        self._axes = T[:, :3, 2]
        self._t_us: I64 = np.array([frame.t_us for frame in recorded], dtype=np.int64)
        self._focal_px = np.array(
            [focal_px_of(recording_camera(frame, (1, 1)))[0] for frame in recorded]
        )
        self._lenses: dict[tuple[int, str], list[int]] = {}
        for i, frame in enumerate(recorded):
            self._lenses.setdefault((frame.t_us, lens_camera(frame.camera)), []).append(i)

    def lens(self, i: int) -> list[int]:
        """Return a frame and those of the other pinholes of its lens, of the same instant, in the
        order in which they look away from it.
        """
        frame = self.recorded[i]
        ahead = self._axes @ self._axes[i]
        lens_frames = self._lenses[frame.t_us, lens_camera(frame.camera)]
        return [i, *sorted((j for j in lens_frames if j != i), key=lambda j: -ahead[j])]

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


def recording_camera(frame: RecordedFrame, size: tuple[int, int]) -> CameraSpec:
    """Return the camera of a recorded frame of a width and height."""
    return CameraSpec(frame.camera, *size, frame.K, np.eye(4), 0, frame.lens)


View = tuple[RenderRequest, Sequence[Any], F64]  # its recorded frames, and a rig's pose near by
Placed = tuple[Sequence[Any], WarpTarget, F64]  # the same with a window of the view


class Window(NamedTuple):
    """Rows of a view, and of what is carried into them its own part."""

    band: Band
    target: WarpTarget
    inner: tuple[slice, slice]


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
        self._boxes = {actor.actor_id: actor.box for actor in actors}
        self._ego_log = ego_log
        self._last: dict[str, tuple[int, ...]] = {}
        cameras = len({frame.camera for frame in recorded})
        self._kept = max(KEPT_FRAMES, KEPT_INSTANTS * cameras)
        self._recorded: OrderedDict[int, RecordedImage] = OrderedDict()
        self._uploaded: dict[int, Any] = {}  # those of them that lie on a device

    def added(
        self, requests: Sequence[RenderRequest], frames: Sequence[Frame], on_device: bool = False
    ) -> list[Frame]:
        """Return the rendered frames of an instant with their references, nearest first; none
        without depth.

        Args:
            requests: What was rendered.
            frames: The renders, whose depth carries the recorded frames into their views.
            on_device: Whether those of frames that a device drew may stay there.
        """
        device_planes = planes_of(frames) if on_device else []
        stays = len(device_planes) == len(frames)
        chosen = [self._choose(request) for request in requests]
        recorded = self._recorded_images([i for indices, _ in chosen for i in indices])
        images: Mapping[int, Any] = recorded
        if stays:
            import torch

            from alpasim_plugin.fixers.device_carry import upload_image

            images = self._uploaded
            for i in recorded.keys() - images.keys():
                self._uploaded[i] = upload_image(recorded[i], device_planes[0].rgb.device)
        views = [
            (request, self._whole_lenses(indices, images), T_world_rig)
            for request, (indices, T_world_rig) in zip(requests, chosen, strict=True)
        ]
        carry_all = _carry_on_device if stays else self._carry_on_host
        carried = self._carried(views, device_planes if stays else frames, carry_all)
        if not stays:
            return [
                frame.changed(references=references)
                for frame, references in zip(frames, carried, strict=True)
            ]

        def with_references(index: int) -> Frame:
            def references(planes: DevicePlanes) -> Mapping[str, Any]:
                images = carried[index]
                if planes is not device_planes[index]:  # drawn again
                    (images,) = self._carried([views[index]], [planes], carry_all)
                return {"references": torch.stack(list(images)) if images else None}

            return frames[index].changed(on_device=device_planes[index].changed(references))

        return [with_references(index) for index in range(len(frames))]

    def _windows(self, request: RenderRequest, depth: Any) -> list[Window]:
        """Return the windows of a view ``(H, W)`` into which recorded frames are carried."""
        # What `carry` decides of a pixel depends on those around it.
        K_view = intrinsics_on_axis(request.camera)
        around = window_px(K_view)
        rays = None
        rays_there = None
        if request.camera.lens is not None:
            rays = lens_rays(request.camera).ray.reshape(*depth.shape, 3)
            if not isinstance(depth, np.ndarray):
                rays_there = rays_on_device(request.camera, str(depth.device))[:3]
        windows = []
        for band in exposed_bands(request):
            top = max(band.rows.start - around, 0)
            rows = slice(top, band.rows.stop + around)
            K = K_view.copy()
            K[1, 2] -= top
            view = K, band.T_world_camera, depth[rows], band.actors, self._boxes
            target = WarpTarget(
                *view,
                rays=None if rays is None else rays[rows],
                rays_on_device=None if rays_there is None else rays_there[:, rows],
            )
            inner = slice(band.rows.start - top, band.rows.stop - top), band.columns
            windows.append(Window(band, target, inner))
        return windows

    def _carried(
        self, views: Sequence[View], renders: Sequence[Any], carry_all: Callable[[Any], Any]
    ) -> list[tuple[Any, ...]]:
        """Return the recorded frames in each view ``(H, W, 4)``; none without depth."""
        cuts = [
            self._windows(request, render.depth) if images and render.depth is not None else []
            for (request, images, _), render in zip(views, renders, strict=True)
        ]
        placed = [
            (images, window.target, T_world_rig)
            for (_, images, T_world_rig), windows in zip(views, cuts, strict=True)
            for window in windows
        ]
        parts = iter(carry_all(placed))
        return [
            _whole(request, windows, [next(parts) for _ in windows])
            for (request, *_), windows in zip(views, cuts, strict=True)
        ]

    def _carry_on_host(self, placed: Sequence[Placed]) -> list[Any]:
        threads = max(1, self.threads // max(1, len(placed)))
        carry_one = partial(carry, threads=threads)
        return map_on_threads(self.threads, lambda view: carry_one(*view), placed)

    def _choose(self, request: RenderRequest) -> tuple[tuple[int, ...], F64]:
        """Return which recorded frames a view receives, and the rig's pose nearest to it."""
        T_world_camera = request.T_world_camera[1]
        camera = request.camera.name
        last = self._last.get(camera, ())
        focal_px = focal_px_of(request.camera)[0]
        chosen = self.index.choose(
            T_world_camera, request.t_us, self.count, last, self.past, focal_px
        )
        if self.hysteresis:
            self._last[camera] = chosen
        nearest = int(np.linalg.norm(self._ego_log.xyz - T_world_camera[:3, 3], axis=1).argmin())
        return chosen, se3(self._ego_log.xyz[nearest], self._ego_log.quat[nearest])

    def _read(self, i: int) -> RecordedImage:
        frame = self.index.recorded[i]
        rgb, depth = frame.read()
        height, width = depth.shape
        lens = recorded_lens(recording_camera(frame, (width, height)))
        pose = frame.K, frame.T_world_camera
        recorded = RecordedImage(*pose, rgb, depth, frame.actors, lens=lens)
        return with_users(recorded, self._boxes)

    def _whole_lenses(self, numbers: Sequence[int], images: Mapping[int, Any]) -> list[Any]:
        """Return recorded frames that have those of the other pinholes of their lens."""
        lenses = [[images[j] for j in self.index.lens(i)] for i in numbers]
        return [
            replace(first, others=tuple(others)) if others else first for first, *others in lenses
        ]

    def _recorded_images(self, chosen: Sequence[int]) -> dict[int, RecordedImage]:
        """Return recorded frames and those of their lenses by number; those that are not kept are
        read.
        """
        numbers = [j for i in chosen for j in self.index.lens(i)]
        new = [i for i in dict.fromkeys(numbers) if i not in self._recorded]
        self._recorded.update(zip(new, map_on_threads(self.threads, self._read, new), strict=True))
        for i in numbers:
            self._recorded.move_to_end(i)
        out = {i: self._recorded[i] for i in numbers}
        while len(self._recorded) > self._kept:
            dropped, _ = self._recorded.popitem(last=False)
            self._uploaded.pop(dropped, None)
        return out


def _carry_on_device(placed: Sequence[Placed]) -> list[Any]:
    from alpasim_plugin.fixers.device_carry import CarriedView, carry_on_device, size_of

    return batched([CarriedView(*view) for view in placed], size_of, carry_on_device)


def _whole(
    request: RenderRequest, windows: Sequence[Window], parts: Sequence[Sequence[Any]]
) -> tuple[Any, ...]:
    """Return each recorded frame in a view, of those in its windows."""
    views = [
        [image[window.inner] for image in part] for window, part in zip(windows, parts, strict=True)
    ]
    exposed = [window.band for window in windows]
    images = [joined(request, exposed, parts) for parts in zip(*views, strict=True)]
    return tuple(_seen(request.camera, image) for image in images)


def _seen(camera: CameraSpec, image: Any) -> Any:
    """Return an image of a camera that is black where its lens sees nothing."""
    if camera.lens is None:
        return image
    if isinstance(image, np.ndarray):
        return blackened(image, blind_part(camera))
    return image * (rays_on_device(camera, str(image.device))[3:] > 0).permute(1, 2, 0)


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
    arguments = recorded, scenario.actors, scenario.ego_log, settings.references, settings.recording
    return ReferenceSession(*arguments, hysteresis, thread_count(threads))

"""Where frames come from before they are fixed: our own renderer, or any server of AlpaSim's
renderer service.

An upstream's images come without opacity, which the fixer reads as trust: from 0.98 on an opaque
pixel is kept against a large change without support, below 0.9 the generator is free, below 0.5
noise enters. So the estimate of a whole frame falls linearly from 1 to `FAR` while the rig moves
away from the recorded path, from `NEAR_M` to `FAR_M` (a reconstruction knows what the recording
saw), and a mask lowers it further where it is dark:

    opacity(pixel) = min(path(distance), mask(pixel) / 255)
"""

import logging
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import cv2
import grpc
import numpy as np

from alpasim_plugin.alpasim.server.caches import (
    SceneCache,
    SceneEntry,
    front_camera,
    scene_camera,
)
from alpasim_plugin.alpasim.server.map_gate import beside, contradiction
from alpasim_plugin.alpasim.server.shutters import exposure_of, lens_exposure
from alpasim_plugin.alpasim.server.status import CallTime, UpstreamFault
from alpasim_plugin.alpasim.server.views import View, camera_of, read_sides, straight_of
from alpasim_plugin.cameras.lens import Lens, blind_of, joined, require_sight
from alpasim_plugin.cameras.shutter import at_share
from alpasim_plugin.core.errors import InputError, SimrunError
from alpasim_plugin.core.files.images import read_image
from alpasim_plugin.core.geometry import interpolate, inverse, project
from alpasim_plugin.core.types import F32, F64, U8, Bool, CameraSpec, Frame, RenderRequest
from alpasim_plugin.fixers.semantic_map.draw import draw_exposed_maps
from alpasim_plugin.fixers.semantic_map.prepare import actor_boxes
from alpasim_plugin.gaussians.lens_camera import blind_part, lens_rays
from alpasim_plugin.log.images import decode_image
from alpasim_plugin.log.schema import read_trajectory, read_transform
from alpasim_plugin.log.wire import sensorsim_pb2

# Distance from the recorded path where trust begins to fall, and where it has fallen.
NEAR_M = 0.25
FAR_M = 3.0
FAR = 0.6  # above 0.5: a hole is never invented
MAP_OFF = "map-off"
log = logging.getLogger("simrun.serve")
MOST_NAMES = 4096  # scenes and cameras of an upstream that are remembered

Request = sensorsim_pb2.RGBRenderRequest


def path_reliability(path_xy: F64, xy: F64) -> float:
    """Return the trust in a frame seen from ``xy`` ``(2,)`` beside the recorded path ``(N, 2)``,
    metres.

    Example:
        >>> path = np.array([[0.0, 0.0], [100.0, 0.0]])
        >>> [round(path_reliability(path, np.array([50.0, y])), 3) for y in (0.1, 1.625, -9.0)]
        [1.0, 0.8, 0.6]
    """
    away = abs(project(path_xy, xy)[1])
    share = min(max((away - NEAR_M) / (FAR_M - NEAR_M), 0.0), 1.0)
    return 1.0 - share * (1.0 - FAR)


def read_masks(named: Mapping[str, Path]) -> dict[str, U8]:
    """Read grey masks ``(H, W)`` by camera: 255 is trusted.

    Raises:
        InputError: A file that is no image.
    """
    return {camera: read_image(path, flag=cv2.IMREAD_GRAYSCALE) for camera, path in named.items()}


def trusted_opacity(trust: float, mask: U8 | None, height: int, width: int) -> F32:
    """Return the opacity ``(H, W)`` that stands for a frame's trust."""
    out = np.full((height, width), trust, dtype=np.float32)
    if mask is not None:
        out = np.minimum(
            out,
            cv2.resize(mask, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
            / 255.0,
        )
    return out


@dataclass(frozen=True)
class Rendered:
    """A frame before it is fixed, with its semantic map where the fixer takes one."""

    frame: Frame
    sdmap: Any  # (H, W, 3) uint8, of the host or of a device
    blind: Bool | None = None  # (H, W) where the lens sees nothing


class FrameSource(Protocol):
    """Gives frames for requests."""

    def render(
        self, requests: Sequence[Request], views: Sequence[View], left: CallTime
    ) -> list[Rendered]:
        """Return one frame a request, in order."""


def boxes_at(entry: SceneEntry, view: View) -> dict[str, F64]:
    """Return every road user's box pose at shutter end: those of the request, and the scene's
    static ones, which requests leave out.

    Raises:
        InputError: A track that the scene does not have.
    """
    actors_by_id = {actor.actor_id: actor for actor in entry.scenario.actors}
    foreign = sorted(set(view.objects) - set(actors_by_id))
    if foreign:
        problem = f"track {foreign[0]!r}" + (
            f" and {len(foreign) - 1} more" if len(foreign) > 1 else ""
        )
        raise InputError(
            f"scene {view.scene_id!r}: {problem}, not in the scene",
            "render with the scene file that the runtime uses",
        )
    poses = {}
    for actor_id, actor in actors_by_id.items():
        if (
            actor.is_static
            and actor_id not in view.objects
            and actor.track.t_us[0] <= view.t_us <= actor.track.t_us[-1]
        ):
            poses[actor_id] = interpolate(actor.track, view.t_us)
    return poses | {track: pair[1] for track, pair in view.objects.items()}


def requests_of(
    entry: SceneEntry, request: Request, view: View, T_rig_camera: F64, sides: Sequence[Lens]
) -> list[RenderRequest]:
    """Return what is to be drawn by each pinhole that covers the request's lens; a camera of the
    scene bears the scene's name of it.

    Raises:
        InputError: A track that the scene does not have.
    """
    actors = boxes_at(entry, view)
    name = name_in_scene(entry, view)
    requests = []
    for side in sides:
        camera = side.spec(name, T_rig_camera, view.t_us - view.start_us)
        T = view.T_world_camera @ side.T_lens_pinhole
        exposure = exposure_of(request.camera_intrinsics, view, side, actors)
        requests.append(RenderRequest(view.t_us, camera, T, actors, exposure=exposure))
    return requests


def lens_request(
    entry: SceneEntry, request: Request, view: View, T_rig_camera: F64
) -> RenderRequest:
    """Return what is to be drawn of a request through its lens.

    Raises:
        InputError: A track that the scene does not have.
    """
    actors = boxes_at(entry, view)
    camera = replace(
        camera_of(request.camera_intrinsics, view.width, view.height),
        name=name_in_scene(entry, view),
        T_rig_camera=T_rig_camera,
        shutter_us=view.t_us - view.start_us,
    )
    exposure = lens_exposure(request.camera_intrinsics, view, actors)
    return RenderRequest(view.t_us, camera, view.T_world_camera, actors, exposure=exposure)


def name_in_scene(entry: SceneEntry, view: View) -> str:
    """Return the scene's name of a view's camera; the caller's where it is none of the scene's."""
    stored_camera = scene_camera(entry.scenario, view.camera)
    return stored_camera.name if stored_camera else view.camera


def drawn_map(entry: SceneEntry, request: RenderRequest, device: Any = "cpu") -> Any:
    """Return the semantic map as the request's lens sees it; None where the fixer takes none."""
    if entry.scene_map is None:
        return None
    actors = entry.scenario.actors
    (image,) = draw_exposed_maps(entry.scene_map, [request], actors, device=device)
    return image


def with_fitting_map(
    rendered: Rendered,
    entry: SceneEntry,
    request: RenderRequest,
    image: U8,
    view: View,
) -> Rendered:
    """Take the map away from a frame that contradicts it, with an event ``map-off`` and a line in
    the log.

    Args:
        rendered: With a map.
        entry: Its scene.
        request: The pinhole, poses and road users of ``image``.
        image: The frame as that pinhole shows it.
        view: For the log.
    """
    assert entry.scene_map is not None, "a frame with a map is of a scene with one"
    T, actors = (
        at_share(request, 0.5)
        if request.exposure is not None
        else (request.T_world_camera[1], request.actors)
    )
    beside_m = beside(entry.scenario.ego_log.xyz, T @ inverse(request.camera.T_rig_camera), T)
    conflict = contradiction(
        entry.scene_map,
        request.camera,
        T,
        actor_boxes(actors, entry.scenario.actors),
        image,
        beside_m,
    )
    if conflict is None:
        return rendered
    title = f"scene {view.scene_id!r}, camera {view.camera!r} at {view.t_us} us"
    found_at = f"{abs(conflict.offset_m)} m {'left' if conflict.offset_m > 0 else 'right'} of where the map has it"
    log.warning(
        "%s: the map is off: lane markings agree %.2f with the map and %.2f %s",
        title,
        conflict.unmoved,
        conflict.best,
        found_at,
    )
    frame = rendered.frame.changed(events=(*rendered.frame.events, MAP_OFF))
    return replace(rendered, frame=frame, sdmap=None)


def _straight_ahead(pinholes: Sequence[Lens]) -> int:
    """Return the number of the pinhole that looks straight ahead."""
    return max(range(len(pinholes)), key=lambda i: float(pinholes[i].T_lens_pinhole[2, 2]))


def with_straight_map(
    rendered: Rendered, entry: SceneEntry, spec: Any, through_lens: RenderRequest, view: View
) -> Rendered:
    """Check the map of a frame as `with_fitting_map`, in the pinhole that shows what its lens sees.

    Args:
        rendered: With a map.
        entry: Its scene.
        spec: The lens, as the request names it.
        through_lens: The lens, poses and road users of the frame.
        view: For the log.
    """
    image = rendered.frame.rgb
    height, width = image.shape[:2]
    straight = straight_of(spec, width, height)
    mount = mount_of(entry, view)
    camera = CameraSpec(through_lens.camera.name, *straight.size, straight.K, mount)
    in_pinhole = replace(through_lens, camera=camera)
    return with_fitting_map(rendered, entry, in_pinhole, straight.image(image), view)


class LocalSource:
    """Render scenes here, through the lens and with the shutter of the request.

    Args:
        scenes: Scenes with their renderers.
        busy: Held while something is computed: renderers are no more than one at a time.
    """

    def __init__(
        self,
        scenes: SceneCache,
        busy: threading.Lock,
    ) -> None:
        self._scenes = scenes
        self._busy = busy

    def render(
        self, requests: Sequence[Request], views: Sequence[View], left: CallTime
    ) -> list[Rendered]:
        """Return one frame a request, in order.

        Raises:
            InputError: A lens or a track that cannot be rendered; an unknown scene.
            RendererError: The renderer broke its contract.
        """
        return [
            self._render(request, view, left) for request, view in zip(requests, views, strict=True)
        ]

    def _render(self, request: Request, view: View, left: CallTime) -> Rendered:
        """Render the request's lens, or the pinholes that cover it where the renderer draws these
        alone; and check the semantic map.
        """
        spec = request.camera_intrinsics
        camera = camera_of(spec, view.width, view.height)
        if camera.lens is not None:
            require_sight(camera, lens_rays(camera))
        entry = self._scenes.get(view.scene_id, left)
        through_lens = lens_request(entry, request, view, mount_of(entry, view))
        if camera.lens is not None and not entry.draws_lenses:
            return self._render_cover(entry, request, through_lens, view, left)
        with left.holding(self._busy):
            (frame,) = entry.render([through_lens], entry.reads_device)
            sdmap = drawn_map(entry, through_lens, frame.device if entry.reads_device else "cpu")
        rendered = Rendered(frame.changed(camera=view.camera), sdmap, blind_part(camera))
        if sdmap is None:
            return rendered
        return with_straight_map(rendered, entry, spec, through_lens, view)

    def _render_cover(
        self,
        entry: SceneEntry,
        request: Request,
        through_lens: RenderRequest,
        view: View,
        left: CallTime,
    ) -> Rendered:
        """Render the pinholes that cover the request's lens, and join them; the semantic map is
        checked in the one that looks straight ahead.
        """
        pinholes = read_sides(request.camera_intrinsics, view.width, view.height)
        requests = requests_of(entry, request, view, mount_of(entry, view), pinholes)
        with left.holding(self._busy):
            frames = entry.render(requests, entry.reads_device)
            frame = joined(requests[0].camera.name, pinholes, frames)
            sdmap = drawn_map(entry, through_lens)
        rendered = Rendered(frame.changed(camera=view.camera), sdmap, blind_of(pinholes))
        if sdmap is None:
            return rendered
        ahead = _straight_ahead(pinholes)
        return with_fitting_map(rendered, entry, requests[ahead], frames[ahead].rgb, view)

    def scan(self, view: View, cameras: Sequence[CameraSpec], left: CallTime) -> list[Frame]:
        """Return frames with depth of several cameras at the view's place, at its shutter end.

        Args:
            view: Whose camera is a sensor, x forwards, y left, z up; its size does not count.
            cameras: Placed on the sensor.
            left: Of the caller.

        Raises:
            InputError: A track that the scene does not have; an unknown scene.
            RendererError: The renderer broke its contract.
        """
        entry = self._scenes.get(view.scene_id, left)
        boxes = boxes_at(entry, view)
        requests = [
            RenderRequest(view.t_us, camera, view.T_world_camera @ camera.T_rig_camera, boxes)
            for camera in cameras
        ]
        with left.holding(self._busy):
            return entry.render(requests)


class UpstreamSource:
    """Ask another server of the renderer service, and estimate how far its frames can be trusted.

    Args:
        stub: Of ``SensorsimService`` at the upstream.
        scenes: Scenes for maps and recorded paths; None: no map, and the path is asked of the
            upstream.
        masks: Grey masks by camera.
        as_png: Ask for PNG whatever the caller asked for, so that the image is not compressed
            twice.
    """

    def __init__(
        self,
        stub: Any,
        scenes: SceneCache | None,
        masks: Mapping[str, U8] | None = None,
        as_png: bool = True,
    ) -> None:
        self._stub, self._scenes, self._masks = stub, scenes, masks or {}
        self._as_png = as_png
        self._has_batch = True
        self._paths: dict[str, F64] = {}
        self._mounts: dict[tuple[str, str], F64] = {}

    def render(
        self, requests: Sequence[Request], views: Sequence[View], left: CallTime
    ) -> list[Rendered]:
        """Return one frame a request, in order.

        Raises:
            grpc.RpcError: The upstream failed.
            UpstreamFault: It sent no image, or another number of them.
            InputError: An unknown scene, or no recorded path to estimate the reliability from.
        """
        cameras = [view.camera for view in views]
        names = (
            cameras if len(set(cameras)) == len(cameras) else [str(i) for i in range(len(cameras))]
        )
        images = self._images([self._asked(request) for request in requests], names, left)
        return [
            self.rendered(request, view, data, left)
            for request, view, data in zip(requests, views, images, strict=True)
        ]

    def render_aggregated(
        self, request: sensorsim_pb2.AggregatedRenderRequest, left: CallTime
    ) -> sensorsim_pb2.AggregatedRenderReturn:
        """Return the upstream's answer to a call for frames, lidar spins and its data for the
        driver; its images are those of `ReceivedImages`.

        Raises:
            grpc.RpcError: The upstream failed.
            UpstreamFault: It sent another number of images.
        """
        upstream_request = sensorsim_pb2.AggregatedRenderRequest()
        upstream_request.CopyFrom(request)  # fields of newer versions are kept
        del upstream_request.rgb_requests[:]
        upstream_request.rgb_requests.extend(self._asked(frame) for frame in request.rgb_requests)
        reply: sensorsim_pb2.AggregatedRenderReturn
        reply = self._stub.render_aggregated(upstream_request, timeout=left.left_s())
        if len(reply.rgb_returns) != len(request.rgb_requests):
            raise UpstreamFault(
                f"the upstream's aggregated answer: {len(reply.rgb_returns)} images for {len(request.rgb_requests)}",
                "see the upstream's log",
            )
        return reply

    def _asked(self, request: Request) -> Request:
        if not self._as_png:
            return request
        upstream_request = Request()
        upstream_request.CopyFrom(request)  # fields of newer versions are kept
        upstream_request.image_format = sensorsim_pb2.PNG
        return upstream_request

    def _images(
        self, requests: Sequence[Request], names: Sequence[str], left: CallTime
    ) -> list[bytes]:
        if len(requests) > 1 and self._has_batch:
            item = sensorsim_pb2.BatchRGBRenderRequestItem
            batch = sensorsim_pb2.BatchRGBRenderRequest(
                items=[item(camera_name=n, request=r) for n, r in zip(names, requests, strict=True)]
            )
            try:
                reply = self._stub.batch_render_rgb(batch, timeout=left.left_s())
            except grpc.RpcError as error:
                if error.code() != grpc.StatusCode.UNIMPLEMENTED:
                    raise
                self._has_batch = False  # older servers have render_rgb alone
            else:
                return batch_images(reply, names)
        return [
            self._stub.render_rgb(request, timeout=left.left_s()).image_bytes
            for request in requests
        ]

    def rendered(self, request: Request, view: View, data: bytes, left: CallTime) -> Rendered:
        """Return the frame of an encoded image that the upstream sent for a request; see
        `render`.
        """
        rgb = decoded(data, f"scene {view.scene_id!r}, camera {view.camera!r} at {view.t_us} us")
        height, width = rgb.shape[:2]
        alpha = trusted_opacity(
            self._trust_in(view, left), self._masks.get(view.camera), height, width
        )
        rendered = Rendered(Frame(view.t_us, view.camera, rgb, alpha), None)
        if self._scenes is not None:
            entry = self._scenes.get(view.scene_id, left)
            bare_request = Request(camera_intrinsics=without_windshield(request.camera_intrinsics))
            sized = replace(view, width=width, height=height)
            through_lens = lens_request(entry, bare_request, sized, np.eye(4))
            sdmap = drawn_map(entry, through_lens)
            if sdmap is not None:
                spec = bare_request.camera_intrinsics
                with_map = replace(rendered, sdmap=sdmap)
                rendered = with_straight_map(with_map, entry, spec, through_lens, view)
        return rendered

    def _trust_in(self, view: View, left: CallTime) -> float:
        T_world_rig = view.T_world_camera[1] @ inverse(self._mount(view, left))
        return path_reliability(self._path(view, left), T_world_rig[:2, 3])

    def _path(self, view: View, left: CallTime) -> F64:
        if view.scene_id not in self._paths:
            forget_if_many(self._paths)
            if self._scenes is not None:
                path = self._scenes.get(view.scene_id, left).scenario.ego_log.xyz
            else:
                path_request = sensorsim_pb2.AvailableTrajectoriesRequest(scene_id=view.scene_id)
                listed = self._stub.get_available_trajectories(
                    path_request, timeout=left.left_s()
                ).available_trajectories
                if not listed or len(listed[0].trajectory.poses) < 2:
                    raise InputError(
                        f"scene {view.scene_id!r}: the upstream lists no recorded path",
                        "give --scenes with the scene's file",
                    )
                path = read_trajectory(
                    listed[0].trajectory, f"recorded path of scene {view.scene_id!r}"
                ).xyz
            self._paths[view.scene_id] = path[:, :2]
        return self._paths[view.scene_id]

    def _mount(self, view: View, left: CallTime) -> F64:
        key = view.scene_id, view.camera
        if key not in self._mounts:
            forget_if_many(self._mounts)
            camera_request = sensorsim_pb2.AvailableCamerasRequest(scene_id=view.scene_id)
            for camera in self._stub.get_available_cameras(
                camera_request, timeout=left.left_s()
            ).available_cameras:
                self._mounts[view.scene_id, camera.logical_id] = read_transform(
                    camera.rig_to_camera, f"mount of {camera.logical_id!r}"
                )
            # a camera of the runtime's own: its place counts instead of the rig's
            self._mounts.setdefault(key, np.eye(4))
        return self._mounts[key]


@dataclass(frozen=True)
class ReceivedImages:
    """Give the frames of images that an upstream has sent already.

    Attributes:
        source: Of the upstream.
        images: Encoded, by the key of their view.
    """

    source: UpstreamSource
    images: Mapping[bytes, bytes]

    def render(
        self, requests: Sequence[Request], views: Sequence[View], left: CallTime
    ) -> list[Rendered]:
        """Return one frame a request, in order; see `UpstreamSource.render`."""
        return [
            self.source.rendered(request, view, self.images[view.key], left)
            for request, view in zip(requests, views, strict=True)
        ]


def forget_if_many(values_by_name: dict[Any, Any]) -> None:
    """Empty what is remembered by names that come from requests, before it grows without end."""
    if len(values_by_name) >= MOST_NAMES:
        values_by_name.clear()


def mount_of(entry: SceneEntry, view: View) -> F64:
    """Return the mounting of the scene's camera that a view names, else of its front one: renderers
    that follow the recorded path want the rig.
    """
    scenario = entry.scenario
    return (scene_camera(scenario, view.camera) or front_camera(scenario)).T_rig_camera


def batch_images(reply: sensorsim_pb2.BatchRGBRenderReturn, names: Sequence[str]) -> list[bytes]:
    """Return the images of a batch in the order of ``names``.

    Raises:
        UpstreamFault: An image is missing, there twice, or marked as failed.
    """
    items_by_camera = {item.camera_name: item for item in reply.items}
    bad = [
        item.error_message or f"item {item.camera_name!r} has success = false"
        for item in reply.items
        if not item.success
    ]
    if bad or len(reply.items) != len(names) or set(items_by_camera) != set(names):
        problem = bad[0] if bad else f"{len(reply.items)} items for {len(names)}"
        raise UpstreamFault(f"the upstream's batch: {problem}", "see the upstream's log")
    return [items_by_camera[name].result.image_bytes for name in names]


def decoded(data: bytes, title: str) -> U8:
    """Decode an upstream's image.

    Raises:
        UpstreamFault: It is not whole.
    """
    whole = (
        data.rstrip(b"\0").endswith(b"\xff\xd9")
        if data[:2] == b"\xff\xd8"
        else b"IEND" in data[-16:]
    )
    try:
        if not whole:
            raise InputError(
                f"{title}: {len(data)} bytes that are no whole PNG or JPEG",
                "see the upstream's log",
            )
        return decode_image(data, title)
    except SimrunError as error:
        raise UpstreamFault(
            f"{title}: the upstream's image: {error.message}", "see the upstream's log"
        ) from error


def without_windshield(spec: sensorsim_pb2.CameraSpec) -> sensorsim_pb2.CameraSpec:
    """Return intrinsics without the windshield's bending: the semantic map is drawn without it."""
    out = sensorsim_pb2.CameraSpec()
    out.CopyFrom(spec)
    out.ClearField("bivariate_windshield_model_param")
    return out

"""AlpaSim's renderer service, ``SensorsimService``: every call of it, over our renderer or over an
upstream's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from typing import Any

import grpc
import numpy as np

from alpasim_plugin.alpasim.server.caches import KEPT_SCENES, SceneCache, advertised
from alpasim_plugin.alpasim.server.frames import FrameServer
from alpasim_plugin.alpasim.server.sources import LocalSource, ReceivedImages, UpstreamSource
from alpasim_plugin.alpasim.server.status import CallTime, Failures, Unimplemented, answering
from alpasim_plugin.alpasim.server.views import read_view
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import intrinsics, rigid
from alpasim_plugin.core.types import F32, F64, U8, Bool, CameraSpec
from alpasim_plugin.log.schema import wire_trajectory
from alpasim_plugin.log.wire import common_pb2, sensorsim_pb2

SCAN_PX = 900, 604  # of an image of a quarter of the horizon: 0.13 degrees a pixel in its middle
SCAN_MOST_M = 200.0
ONE_SURFACE = 0.05  # neighbouring depths that differ by a smaller share are of one surface,
# as are those whose step is at most so many times the smaller one beside it: a plane far away has
# even steps
EVEN_STEP = 1.5


Call = Callable[[Any, Any, Any], Any]


def forwarded(call: Call) -> Call:
    """Let the upstream answer a call where there is one."""

    @wraps(call)
    def answer(service: Sensorsim, request: Any, context: Any) -> Any:
        if service.upstream is not None:
            return service.forward(call.__name__, request, context)
        return call(service, request, context)

    return answer


def forwarded_verbatim(call: Call) -> Call:
    """Let the upstream answer a call where its images are handed on as they are."""

    @wraps(call)
    def answer(service: Sensorsim, request: Any, context: Any) -> Any:
        if service.verbatim:
            return service.forward(call.__name__, request, context)
        return call(service, request, context)

    return answer


class Sensorsim(Failures):
    """The service.

    Args:
        frames: Answers the render calls.
        version: Returns the triple to report, given the upstream's.
        scenes: The scenes; None: all questions about scenes go to the upstream.
        upstream: Stub of the upstream's service; None: there is none.
        verbatim: Hand every call on as it came, without a fixer in between: images come back bit by
            bit.
    """

    def __init__(
        self,
        frames: FrameServer,
        version: Callable[[common_pb2.VersionId | None], common_pb2.VersionId],
        scenes: SceneCache | None,
        upstream: Any = None,
        verbatim: bool = False,
    ) -> None:
        super().__init__()
        self.frames = frames
        self._version = version
        self._scenes = scenes
        self.upstream = upstream
        self.verbatim = verbatim

    def forward(self, name: str, request: Any, context: Any) -> Any:
        """Hand a call on to the upstream and return its answer."""
        return getattr(self.upstream, name)(request, timeout=CallTime(context).left_s())

    @answering
    @forwarded_verbatim
    def render_rgb(
        self, request: sensorsim_pb2.RGBRenderRequest, context: Any
    ) -> sensorsim_pb2.RGBRenderReturn:
        """Render one frame."""
        left = CallTime(context)
        return sensorsim_pb2.RGBRenderReturn(image_bytes=self.frames.answers([request], left)[0])

    @answering
    @forwarded_verbatim
    def batch_render_rgb(
        self, request: sensorsim_pb2.BatchRGBRenderRequest, context: Any
    ) -> sensorsim_pb2.BatchRGBRenderReturn:
        """Render one frame of several cameras: one item each, under the names of the request."""
        left = CallTime(context)
        names = [item.camera_name for item in request.items]
        if len(set(names)) < len(names):
            raise InputError(f"a batch of {names}: a camera name twice", "send one item a camera")
        images = self.frames.answers([item.request for item in request.items], left)
        item = sensorsim_pb2.BatchRGBRenderReturnItem
        result = sensorsim_pb2.RGBRenderReturn
        made = [
            item(camera_name=n, result=result(image_bytes=i), success=True)
            for n, i in zip(names, images, strict=True)
        ]
        return sensorsim_pb2.BatchRGBRenderReturn(items=made)

    @answering
    @forwarded_verbatim
    def render_aggregated(
        self, request: sensorsim_pb2.AggregatedRenderRequest, context: Any
    ) -> sensorsim_pb2.AggregatedRenderReturn:
        """Render frames and lidar spins together; over an upstream lidar and its data for the
        driver are handed on.
        """
        left = CallTime(context)
        requests = list(request.rgb_requests)
        source = self.frames.source
        if not isinstance(source, UpstreamSource):
            scans = [self._scan(scan_request, left) for scan_request in request.lidar_requests]
            images = self.frames.answers(requests, left)
            return sensorsim_pb2.AggregatedRenderReturn(
                rgb_returns=_returns(images), lidar_returns=scans
            )
        keys = [read_view(frame_request).key for frame_request in requests]
        reply = source.render_aggregated(request, left)
        received = [item.image_bytes for item in reply.rgb_returns]
        images_by_key = dict(zip(keys, received, strict=True))
        images = self.frames.answers(requests, left, ReceivedImages(source, images_by_key))
        del reply.rgb_returns[:]
        reply.rgb_returns.extend(_returns(images))
        return reply

    @answering
    @forwarded
    def render_lidar(
        self, request: sensorsim_pb2.LidarRenderRequest, context: Any
    ) -> sensorsim_pb2.LidarRenderReturn:
        """Return a lidar's points: from the depth of our renderer, or as the upstream answers."""
        return self._scan(request, CallTime(context))

    def _scan(
        self, request: sensorsim_pb2.LidarRenderRequest, left: CallTime
    ) -> sensorsim_pb2.LidarRenderReturn:
        if request.lidar_config.lidar_type not in LIDARS or not isinstance(
            self.frames.source, LocalSource
        ):
            raise Unimplemented(
                f"a lidar of type {request.lidar_config.lidar_type}",
                "use --upstream with a server that has it",
            )
        lidar = LIDARS[request.lidar_config.lidar_type]
        cameras = lidar.cameras()
        view = read_view(
            sensorsim_pb2.RGBRenderRequest(
                scene_id=request.scene_id,
                resolution_w=SCAN_PX[0],
                resolution_h=SCAN_PX[1],
                frame_start_us=request.frame_start_us,
                frame_end_us=request.frame_end_us,
                sensor_pose=request.sensor_pose,
                dynamic_objects=request.dynamic_objects,
            )
        )
        frames = self.frames.source.scan(view, cameras, left)
        depths = [frame.depth for frame in frames if frame.depth is not None]
        if len(depths) < len(frames):
            raise Unimplemented(
                "a lidar of a renderer without depth", "use --upstream with a server that has it"
            )
        xyz, brightness = points_of(lidar.rays(), cameras, depths, [frame.rgb for frame in frames])
        return sensorsim_pb2.LidarRenderReturn(
            num_points=len(xyz),
            point_xyzs_buffer=xyz.astype("<f4").tobytes(),
            point_intensities_buffer=brightness.astype("<f4").tobytes(),
        )

    @answering
    def get_version(self, request: common_pb2.Empty, context: Any) -> common_pb2.VersionId:
        """Return the triple."""
        return self._version(
            None if self.upstream is None else self.forward("get_version", request, context)
        )

    @answering
    def get_available_scenes(
        self, request: common_pb2.Empty, context: Any
    ) -> common_pb2.AvailableScenesReturn:
        """Return the scene ids: those of ``--scenes``, and only those that the upstream has as
        well.
        """
        if self.upstream is None:
            return common_pb2.AvailableScenesReturn(scene_ids=self._own_scenes.ids)
        theirs: common_pb2.AvailableScenesReturn
        theirs = self.forward("get_available_scenes", request, context)
        if self._scenes is None or self.verbatim:
            return theirs
        upstream_ids = set(theirs.scene_ids)
        return common_pb2.AvailableScenesReturn(
            scene_ids=[i for i in self._scenes.ids if i in upstream_ids or "*" in upstream_ids]
        )

    @answering
    @forwarded
    def get_loaded_scenes(
        self, request: common_pb2.Empty, context: Any
    ) -> sensorsim_pb2.LoadedScenesReturn:
        """Return the scenes in memory; each serves any number of rollouts."""
        entry = sensorsim_pb2.LoadedSceneEntry
        scenes = [
            entry(scene_id=name, loaded_instance_count=1, reusable_instance_count=1)
            for name in self._own_scenes.loaded
        ]
        return sensorsim_pb2.LoadedScenesReturn(scenes=scenes, loaded_instance_capacity=KEPT_SCENES)

    @answering
    def prefetch_scene(
        self, request: sensorsim_pb2.ScenePrefetchRequest, context: Any
    ) -> common_pb2.Empty:
        """Load and build a scene before its first frame is asked for; the call is forwarded to an
        upstream that implements it.
        """
        if self._scenes is not None:
            self._scenes.get(request.scene_id, CallTime(context))
        if self.upstream is not None:
            try:
                self.forward("prefetch_scene", request, context)
            except grpc.RpcError as error:
                if error.code() != grpc.StatusCode.UNIMPLEMENTED:
                    raise
        return common_pb2.Empty()

    @answering
    @forwarded
    def get_available_cameras(
        self, request: sensorsim_pb2.AvailableCamerasRequest, context: Any
    ) -> sensorsim_pb2.AvailableCamerasReturn:
        """Return a scene's cameras."""
        entry = self._own_scenes.get(request.scene_id, CallTime(context))
        return sensorsim_pb2.AvailableCamerasReturn(available_cameras=advertised(entry.scenario))

    @answering
    @forwarded
    def get_available_trajectories(
        self, request: sensorsim_pb2.AvailableTrajectoriesRequest, context: Any
    ) -> sensorsim_pb2.AvailableTrajectoriesReturn:
        """Return a scene's recorded ego path, local to rig."""
        entry = self._own_scenes.get(request.scene_id, CallTime(context))
        recorded = wire_trajectory(
            entry.scenario.ego_log, f"recorded path of scene {request.scene_id!r}"
        )
        listed = sensorsim_pb2.AvailableTrajectoriesReturn.AvailableTrajectory(trajectory=recorded)
        return sensorsim_pb2.AvailableTrajectoriesReturn(available_trajectories=[listed])

    @answering
    @forwarded
    def get_available_ego_masks(
        self, request: common_pb2.Empty, context: Any
    ) -> sensorsim_pb2.AvailableEgoMasksReturn:
        """Return the ego masks: the upstream's; our own renderer shows no part of the ego."""
        return sensorsim_pb2.AvailableEgoMasksReturn()

    @property
    def _own_scenes(self) -> SceneCache:
        assert self._scenes is not None, "a server without an upstream has scenes"
        return self._scenes


def _returns(images: Sequence[bytes]) -> list[sensorsim_pb2.RGBRenderReturn]:
    return [sensorsim_pb2.RGBRenderReturn(image_bytes=image) for image in images]


@dataclass(frozen=True)
class Lidar:
    """Where a lidar looks: every row at every azimuth. Rows are those of the data sheet as far as
    it is even, not a device's calibration.

    Attributes:
        rows_deg: Elevations.
        azimuths_deg: From the left of straight ahead.
        looks_deg: Azimuths of the images that cover them.
    """

    rows_deg: F64
    azimuths_deg: F64
    looks_deg: tuple[float, ...]

    def rays(self) -> F64:
        """Return directions ``(N, 3)``: x forwards, y left, z up."""
        up, left = (
            np.deg2rad(angles_deg).ravel()
            for angles_deg in np.meshgrid(self.rows_deg, self.azimuths_deg, indexing="ij")
        )
        return np.stack([np.cos(up) * np.cos(left), np.cos(up) * np.sin(left), np.sin(up)], axis=1)

    def cameras(self) -> list[CameraSpec]:
        """Return the cameras of the images, 90 degrees wide, placed on the sensor."""
        width, height = SCAN_PX
        K = intrinsics(width / 2, width / 2, width / 2, height / 2)
        out: list[CameraSpec] = []
        for look in np.deg2rad(self.looks_deg):
            c = np.cos(look)
            s = np.sin(look)
            T = rigid([[s, 0, c], [-c, 0, s], [0, -1, 0]])
            out.append(CameraSpec(f"scan{len(out)}", width, height, K, T))
        return out


LIDARS = {
    sensorsim_pb2.PANDAR128: Lidar(
        np.r_[np.linspace(-25, -6.5, 36), np.linspace(-6, 2, 65), np.linspace(2.5, 15, 27)],
        np.arange(-180, 180, 0.2),
        (0.0, 90.0, 180.0, 270.0),
    ),
    sensorsim_pb2.AT128: Lidar(
        np.linspace(-12.5, 12.9, 128), np.arange(-60, 60, 0.1), (-30.0, 30.0)
    ),
}


def points_of(
    rays: F64, cameras: Sequence[CameraSpec], depths: Sequence[F32], images: Sequence[U8]
) -> tuple[F64, F64]:
    """Return where rays meet the surfaces of depth images, ``(P, 3)`` metres in the sensor's
    frame, and how bright it is there ``(P,)``.

    Inverse depth is linear in an image of a plane, so it is interpolated between the four pixels
    around a ray where they are of one surface; elsewhere the nearest pixel counts. Rays without a
    surface, or beyond `SCAN_MOST_M`, give no point.

    Args:
        rays: ``(N, 3)`` of length 1.
        cameras: Placed on the sensor.
        depths: ``(H, W)`` of each, metres along the axis; 0 without a surface.
        images: ``(H, W, 3)`` of each.
    """
    axes = np.array([camera.T_rig_camera[:3, 2] for camera in cameras])
    nearest = np.argmax(rays @ axes.T, axis=1)
    points = []
    bright = []
    for index, (camera, depth, image) in enumerate(zip(cameras, depths, images, strict=True)):
        camera_rays = rays[nearest == index]
        p = camera_rays @ camera.T_rig_camera[:3, :3]
        # pixel centres lie at halves
        u, v = (camera.K[i, i] * p[:, i] / p[:, 2] + camera.K[i, 2] - 0.5 for i in (0, 1))
        column, row = (
            np.clip(np.floor(x).astype(np.int64), 0, n - 2)
            for x, n in ((u, camera.width), (v, camera.height))
        )
        a = np.clip(u - column, 0, 1)
        b = np.clip(v - row, 0, 1)
        inverse = np.divide(1.0, depth, out=np.full(depth.shape, np.nan), where=depth > 0)
        down = _is_one_surface(inverse)
        right = _is_one_surface(inverse.T).T
        smooth = (
            down[row, column] & down[row, column + 1] & right[row, column] & right[row + 1, column]
        )
        around = np.stack([inverse[row + i, column + j] for i in (0, 1) for j in (0, 1)])
        weights = np.stack([(1 - b) * (1 - a), (1 - b) * a, b * (1 - a), b * a])
        single = np.take_along_axis(around, weights.argmax(axis=0)[None], axis=0)[0]
        z = 1.0 / np.where(smooth, (weights * around).sum(axis=0), single)
        length = z / p[:, 2]
        hit = length <= SCAN_MOST_M  # not where it is NaN, without a surface
        points.append(camera_rays[hit] * length[hit, None])
        bright.append(image[row + (b > 0.5), column + (a > 0.5)][hit].mean(axis=1) / 255.0)
    return np.concatenate(points), np.concatenate(bright)


def _is_one_surface(inverse: F64) -> Bool:
    """Tell ``(H - 1, W)`` which neighbours down an image of inverse depth are of one surface:
    alike, or in even steps.
    """
    step = np.abs(np.diff(inverse, axis=0))
    beside = np.pad(step, ((1, 1), (0, 0)), constant_values=np.nan)
    alike = step <= ONE_SURFACE * np.fmax(inverse[1:], inverse[:-1])
    return alike | (step <= EVEN_STEP * np.fmin(beside[:-2], beside[2:]))

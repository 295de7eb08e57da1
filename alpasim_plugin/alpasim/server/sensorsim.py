"""AlpaSim's renderer service, ``SensorsimService``: every call of it, over our renderer or over an upstream's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import grpc

from alpasim_plugin.alpasim.server.caches import SceneCache, advertised
from alpasim_plugin.alpasim.server.frames import FrameServer
from alpasim_plugin.alpasim.server.status import CallTime, Failures, answering
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.schema import wire_trajectory
from alpasim_plugin.wire import common_pb2, sensorsim_pb2

DOING = "serving AlpaSim's renderer service"
T = TypeVar("T")


class Sensorsim(Failures):
    """The service.

    Args:
        frames: Answers the render calls.
        version: Returns the triple to report, given the upstream's.
        scenes: The scenes; None: all questions about scenes go to the upstream.
        upstream: Stub of the upstream's service; None: there is none.
        verbatim: Hand every call on as it came, without a fixer in between: images come back bit by bit.
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
        self.frames, self._version, self._scenes, self._upstream, self._verbatim = frames, version, scenes, upstream, verbatim

    @answering
    def render_rgb(self, request: sensorsim_pb2.RGBRenderRequest, context: Any) -> sensorsim_pb2.RGBRenderReturn:
        """Render one frame."""
        left = CallTime(context)
        if self._verbatim:
            return self._pass("render_rgb", request, context, sensorsim_pb2.RGBRenderReturn)
        return sensorsim_pb2.RGBRenderReturn(image_bytes=self.frames.answers([request], left)[0])

    @answering
    def batch_render_rgb(self, request: sensorsim_pb2.BatchRGBRenderRequest, context: Any) -> sensorsim_pb2.BatchRGBRenderReturn:
        """Render one frame of several cameras: one item each, under the names of the request."""
        left = CallTime(context)
        names = [item.camera_name for item in request.items]
        if len(set(names)) < len(names):
            raise InputError(DOING, f"a batch of {names}", "a camera name twice", "send one item a camera")
        if self._verbatim:
            return self._pass("batch_render_rgb", request, context, sensorsim_pb2.BatchRGBRenderReturn)
        images = self.frames.answers([item.request for item in request.items], left)
        item, result = sensorsim_pb2.BatchRGBRenderReturnItem, sensorsim_pb2.RGBRenderReturn
        made = [item(camera_name=n, result=result(image_bytes=i), success=True) for n, i in zip(names, images, strict=True)]
        return sensorsim_pb2.BatchRGBRenderReturn(items=made)

    @answering
    def render_aggregated(self, request: sensorsim_pb2.AggregatedRenderRequest, context: Any) -> sensorsim_pb2.AggregatedRenderReturn:
        """Render frames and lidar spins together; lidar and the renderer's data for the driver are the upstream's."""
        left = CallTime(context)
        if self._verbatim:
            return self._pass("render_aggregated", request, context, sensorsim_pb2.AggregatedRenderReturn)
        if self._upstream is None:
            if request.lidar_requests:
                raise NotHere("lidar")
            return sensorsim_pb2.AggregatedRenderReturn(rgb_returns=self._returns(request, left))
        reply = self._pass("render_aggregated", request, context, sensorsim_pb2.AggregatedRenderReturn)
        if request.rgb_requests:
            del reply.rgb_returns[:]
            reply.rgb_returns.extend(self._returns(request, left))
        return reply

    def _returns(self, request: sensorsim_pb2.AggregatedRenderRequest, left: CallTime) -> list[sensorsim_pb2.RGBRenderReturn]:
        return [sensorsim_pb2.RGBRenderReturn(image_bytes=i) for i in self.frames.answers(list(request.rgb_requests), left)]

    @answering
    def render_lidar(self, request: sensorsim_pb2.LidarRenderRequest, context: Any) -> sensorsim_pb2.LidarRenderReturn:
        """Hand a lidar request on to the upstream."""
        return self._pass("render_lidar", request, context, sensorsim_pb2.LidarRenderReturn)

    @answering
    def get_version(self, request: common_pb2.Empty, context: Any) -> common_pb2.VersionId:
        """Return the triple."""
        return self._version(None if self._upstream is None else self._pass("get_version", request, context, common_pb2.VersionId))

    @answering
    def get_available_scenes(self, request: common_pb2.Empty, context: Any) -> common_pb2.AvailableScenesReturn:
        """Return the scene ids: those of ``--scenes``, and only those that the upstream has as well."""
        if self._upstream is None:
            assert self._scenes is not None
            return common_pb2.AvailableScenesReturn(scene_ids=self._scenes.ids)
        theirs = self._pass("get_available_scenes", request, context, common_pb2.AvailableScenesReturn)
        if self._scenes is None or self._verbatim:
            return theirs
        known = set(theirs.scene_ids)
        return common_pb2.AvailableScenesReturn(scene_ids=[i for i in self._scenes.ids if i in known or "*" in known])

    @answering
    def get_loaded_scenes(self, request: common_pb2.Empty, context: Any) -> sensorsim_pb2.LoadedScenesReturn:
        """Return the scenes in memory; each serves any number of rollouts."""
        if self._upstream is not None:
            return self._pass("get_loaded_scenes", request, context, sensorsim_pb2.LoadedScenesReturn)
        assert self._scenes is not None
        entry = sensorsim_pb2.LoadedSceneEntry
        scenes = [entry(scene_id=name, loaded_instance_count=1, reusable_instance_count=1) for name in self._scenes.loaded]
        return sensorsim_pb2.LoadedScenesReturn(scenes=scenes, loaded_instance_capacity=self._scenes.kept)

    @answering
    def prefetch_scene(self, request: sensorsim_pb2.ScenePrefetchRequest, context: Any) -> common_pb2.Empty:
        """Load and build a scene before its first frame is asked for; the call is forwarded to an upstream that implements it."""
        if self._scenes is not None:
            self._scenes.get(request.scene_id, CallTime(context))
        if self._upstream is not None:
            try:
                self._upstream.prefetch_scene(request, timeout=CallTime(context).left_s())
            except grpc.RpcError as error:
                if error.code() != grpc.StatusCode.UNIMPLEMENTED:
                    raise
        return common_pb2.Empty()

    @answering
    def get_available_cameras(self, request: sensorsim_pb2.AvailableCamerasRequest, context: Any) -> sensorsim_pb2.AvailableCamerasReturn:
        """Return a scene's cameras."""
        if self._upstream is not None:
            return self._pass("get_available_cameras", request, context, sensorsim_pb2.AvailableCamerasReturn)
        assert self._scenes is not None
        entry = self._scenes.get(request.scene_id, CallTime(context))
        return sensorsim_pb2.AvailableCamerasReturn(available_cameras=advertised(entry.scenario))

    @answering
    def get_available_trajectories(
        self, request: sensorsim_pb2.AvailableTrajectoriesRequest, context: Any
    ) -> sensorsim_pb2.AvailableTrajectoriesReturn:
        """Return a scene's recorded ego path, local to rig."""
        if self._upstream is not None:
            return self._pass("get_available_trajectories", request, context, sensorsim_pb2.AvailableTrajectoriesReturn)
        assert self._scenes is not None
        entry = self._scenes.get(request.scene_id, CallTime(context))
        recorded = wire_trajectory(entry.scenario.ego_log, f"recorded path of scene {request.scene_id!r}")
        listed = sensorsim_pb2.AvailableTrajectoriesReturn.AvailableTrajectory(trajectory=recorded)
        return sensorsim_pb2.AvailableTrajectoriesReturn(available_trajectories=[listed])

    @answering
    def get_available_ego_masks(self, request: common_pb2.Empty, context: Any) -> sensorsim_pb2.AvailableEgoMasksReturn:
        """Return the ego masks: the upstream's; our own renderer shows no part of the ego."""
        if self._upstream is not None:
            return self._pass("get_available_ego_masks", request, context, sensorsim_pb2.AvailableEgoMasksReturn)
        return sensorsim_pb2.AvailableEgoMasksReturn()

    def _pass(self, name: str, request: Any, context: Any, reply: type[T]) -> T:
        if self._upstream is None:
            raise NotHere(name)
        given = getattr(self._upstream, name)(request, timeout=CallTime(context).left_s())
        assert isinstance(given, reply), "a stub parses what its method returns"
        return given


class NotHere(grpc.RpcError):  # type: ignore[misc]  # grpc has no types
    """A call that only an upstream can answer."""

    def __init__(self, what: str) -> None:
        super().__init__(what)
        self._what = what

    def code(self) -> Any:
        """Return UNIMPLEMENTED."""
        return grpc.StatusCode.UNIMPLEMENTED

    def details(self) -> str:
        """Say what is missing."""
        return f"{self._what} needs an --upstream that has it"

"""AlpaSim's renderer service, ``SensorsimService``: every call of it, over our renderer or over an
upstream's.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import grpc

from alpasim_plugin.alpasim.server.caches import KEPT_SCENES, SceneCache, advertised
from alpasim_plugin.alpasim.server.frames import FrameServer
from alpasim_plugin.alpasim.server.status import CallTime, Failures, Unimplemented, answering
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.schema import wire_trajectory
from alpasim_plugin.log.wire import common_pb2, sensorsim_pb2

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
        item, result = sensorsim_pb2.BatchRGBRenderReturnItem, sensorsim_pb2.RGBRenderReturn
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
        """Render frames together; an upstream's lidar and its data for the driver are handed on."""
        left = CallTime(context)
        if self.upstream is None:
            for lidar in request.lidar_requests:
                self.render_lidar(lidar, context)
            return sensorsim_pb2.AggregatedRenderReturn(rgb_returns=self._returns(request, left))
        reply: sensorsim_pb2.AggregatedRenderReturn
        reply = self.forward("render_aggregated", request, context)
        if request.rgb_requests:
            del reply.rgb_returns[:]
            reply.rgb_returns.extend(self._returns(request, left))
        return reply

    def _returns(
        self, request: sensorsim_pb2.AggregatedRenderRequest, left: CallTime
    ) -> list[sensorsim_pb2.RGBRenderReturn]:
        return [
            sensorsim_pb2.RGBRenderReturn(image_bytes=i)
            for i in self.frames.answers(list(request.rgb_requests), left)
        ]

    @answering
    @forwarded
    def render_lidar(
        self, request: sensorsim_pb2.LidarRenderRequest, context: Any
    ) -> sensorsim_pb2.LidarRenderReturn:
        """Return a lidar's points as the upstream answers; our own renderer has no lidar.

        Raises:
            Unimplemented: There is no upstream.
        """
        raise Unimplemented(
            "a lidar: our renderer draws cameras alone", "use --upstream with a server that has it"
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
        known = set(theirs.scene_ids)
        return common_pb2.AvailableScenesReturn(
            scene_ids=[i for i in self._scenes.ids if i in known or "*" in known]
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

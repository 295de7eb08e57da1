"""``--renderer nre://HOST:PORT``: any service behind AlpaSim's SensorsimService renders;
``onefixer+nre://...`` fixes what it sends.

The wire has no opacity and no depth, so a fixer takes every pixel as seen.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from alpasim_plugin.alpasim.client.channel import READY_S, Address, Service, encoding_of
from alpasim_plugin.alpasim.client.driver import cameras_of
from alpasim_plugin.core.errors import InputError, RendererError
from alpasim_plugin.core.files import some_of
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.types import Frame, RenderRequest, Scenario
from alpasim_plugin.log.images import decode_image
from alpasim_plugin.log.schema import wire_render_request
from alpasim_plugin.log.wire import common_pb2, sensorsim_pb2

OPTIONS = ("scene", "cameras", "encoding")


class NreRenderer(Renderer):
    """A renderer behind AlpaSim's SensorsimService. All cameras of an instant go in one batch, as
    AlpaSim sends them.

    Args:
        scenario: What is rendered; the service must have a scene of its id, or of the id in
            ``scene``.
        address: ``HOST:PORT[?scene=ID&cameras=THEIRS:OURS,...&encoding=png|jpeg]``.
    """

    is_remote = True

    def __init__(self, scenario: Scenario, address: str) -> None:
        place = Address.parse("nre", address, OPTIONS)
        self._encoding = encoding_of(f"nre://{address}", place.options.get("encoding", "png"))
        self._scene = place.options.get("scene", scenario.scene_id)
        self._service = Service("SensorsimService", place.target, RendererError, retries=True)
        self._version = self._service.version()
        scenes = self._service.call("get_available_scenes", common_pb2.Empty(), READY_S).scene_ids
        if "*" not in scenes and self._scene not in scenes:
            raise InputError(
                f"{self._service.target}: no scene {self._scene!r} among its {len(scenes)}: {some_of(sorted(scenes))}",
                "give the service that scene, or name one of its own with ?scene=ID",
            )
        text = place.options.get("cameras")
        if text is not None:
            self._names = {
                camera.name: theirs for theirs, camera in cameras_of(scenario, text).items()
            }
        else:
            request = sensorsim_pb2.AvailableCamerasRequest(scene_id=self._scene)
            service_cameras = {
                camera.logical_id
                for camera in self._service.call(
                    "get_available_cameras", request, READY_S
                ).available_cameras
            }
            scenario_cameras = {camera.name for camera in scenario.cameras}
            self._names = (
                {}
                if scenario_cameras <= service_cameras
                else {
                    camera.name: theirs
                    for theirs, camera in cameras_of(scenario, None).items()
                    if theirs in service_cameras
                }
            )

    @staticmethod
    def check_address(address: str) -> None:
        """Refuse what is no address, before a run begins."""
        Address.parse("nre", address, OPTIONS)

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame."""
        return self.render_batch([request])[0]

    def render_batch(self, requests: Sequence[RenderRequest]) -> Sequence[Frame]:
        """Render all requests of an instant.

        Raises:
            RendererError: The service fails, leaves out a camera, or sends what is no image.
        """
        if not requests:
            return []
        items = []
        for request in requests:
            name = self._names.get(request.camera.name, request.camera.name)
            message = wire_render_request(self._scene, request, self._encoding, name)
            items.append(sensorsim_pb2.BatchRGBRenderRequestItem(camera_name=name, request=message))
        answer = self._service.call(
            "batch_render_rgb",
            sensorsim_pb2.BatchRGBRenderRequest(items=items),
            at_us=requests[0].t_us,
        )
        got = {item.camera_name: item for item in answer.items}
        wanted = [item.camera_name for item in items]
        if sorted(got) != sorted(wanted) or len(answer.items) != len(wanted):
            raise RendererError(
                f"{self._service.target}: cameras {[item.camera_name for item in answer.items]} for {wanted}",
                "make the service answer each camera of a batch once",
            )
        return [
            self._frame(got[name], request) for name, request in zip(wanted, requests, strict=True)
        ]

    def facts(self) -> Mapping[str, Any]:
        """Return what the service is, for the rollout's manifest."""
        return {
            "service": f"{self._version.version_id} at {self._service.target}",
            "git_hash": self._version.git_hash,
        }

    def _frame(self, item: sensorsim_pb2.BatchRGBRenderReturnItem, request: RenderRequest) -> Frame:
        if not item.success:
            raise RendererError(
                f"{self._service.target}: camera {item.camera_name!r}: {item.error_message}",
                "see the service's log",
            )
        try:
            rgb = decode_image(
                item.result.image_bytes, f"camera {item.camera_name!r} at {request.t_us} us"
            )
        except InputError as error:
            raise RendererError(
                f"{self._service.target}: {error.message}",
                "see the service's log",
            ) from error
        return Frame(request.t_us, request.camera.name, rgb)

"""A client of the renderer service, as AlpaSim's runtime is one: it waits for the server and asks
again after what may pass.

``onefixer-bridge HOST:PORT [SCENE]`` asks a service what it is, from AlpaSim's environment, before
a long run.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable
from typing import Any

import grpc

from ...log.wire import common_pb2, sensorsim_pb2
from ...log.wire.services import OPTIONS, Stub

PAUSES_S = (0.5, 2.0)  # before the second and the third attempt
BACKEND = "Stopped waiting for backend"


class RendererClient:
    """Talk to a renderer service.

    Args:
        address: ``HOST:PORT``.
        timeout_s: Longest time of a render.
    """

    def __init__(self, address: str, timeout_s: float = 300.0) -> None:
        self.address = address
        self._timeout_s = timeout_s
        self._channel = grpc.insecure_channel(address, list(OPTIONS))
        self.stub = Stub(self._channel, "SensorsimService")

    def __enter__(self) -> RendererClient:
        return self

    def __exit__(self, *_: object) -> None:
        self._channel.close()

    def version(self, wait_s: float = 30.0) -> common_pb2.VersionId:
        """Return the version triple; waits for the server."""
        return self.stub.get_version(common_pb2.Empty(), timeout=wait_s, wait_for_ready=True)

    def scenes(self) -> list[str]:
        """Return the scene ids."""
        return list(
            self.stub.get_available_scenes(common_pb2.Empty(), timeout=self._timeout_s).scene_ids
        )

    def cameras(self, scene_id: str) -> list[sensorsim_pb2.AvailableCamerasReturn.AvailableCamera]:
        """Return a scene's cameras."""
        asked = sensorsim_pb2.AvailableCamerasRequest(scene_id=scene_id)
        return list(
            self.stub.get_available_cameras(asked, timeout=self._timeout_s).available_cameras
        )

    def render(self, requests: Iterable[sensorsim_pb2.RGBRenderRequest]) -> dict[str, bytes]:
        """Render one frame of several cameras; return the encoded images by camera.

        Raises:
            grpc.RpcError: The server refused, or was away three times.
            ValueError: An answer that AlpaSim's runtime would refuse as well.
        """
        item = sensorsim_pb2.BatchRGBRenderRequestItem
        batch = sensorsim_pb2.BatchRGBRenderRequest(
            items=[item(camera_name=r.camera_intrinsics.logical_id, request=r) for r in requests]
        )
        reply = self._again(batch)
        names = sorted(i.camera_name for i in reply.items)
        if names != sorted(i.camera_name for i in batch.items) or not all(
            i.success for i in reply.items
        ):
            raise ValueError(
                f"{self.address} answered {names} for {[i.camera_name for i in batch.items]}, or without success"
            )
        return {i.camera_name: i.result.image_bytes for i in reply.items}

    def _again(self, batch: sensorsim_pb2.BatchRGBRenderRequest) -> Any:
        for pause in (*PAUSES_S, None):
            try:
                return self.stub.batch_render_rgb(
                    batch, timeout=self._timeout_s, wait_for_ready=True
                )
            except grpc.RpcError as error:
                passing = error.code() == grpc.StatusCode.UNAVAILABLE or BACKEND in (
                    error.details() or ""
                )
                if pause is None or not passing:
                    raise
                time.sleep(pause)
        raise AssertionError("the last attempt returns or raises")


def main(arguments: list[str] | None = None) -> int:
    """Print version, scenes and cameras; return 0, 2 on wrong usage, or 4 if the service cannot be
    asked.
    """
    given = sys.argv[1:] if arguments is None else arguments
    if len(given) not in (1, 2) or given[0].startswith("-"):
        print("usage: onefixer-bridge HOST:PORT [SCENE]", file=sys.stderr)
        return 2
    try:
        with RendererClient(given[0]) as client:
            version = client.version()
            scenes = client.scenes()
            api = version.grpc_api_version
            print(
                f"version {version.version_id}\nhash    {version.git_hash}\nwire    {api.major}.{api.minor}.{api.patch}"
            )
            print(
                f"scenes  {len(scenes)}: {', '.join(scenes[:5])}{' ...' if len(scenes) > 5 else ''}"
            )
            for camera in client.cameras(given[1] if len(given) > 1 else scenes[0]):
                size = camera.intrinsics.resolution_w, camera.intrinsics.resolution_h
                print(
                    f"camera  {camera.logical_id}: {size[0]} x {size[1]}, {camera.intrinsics.WhichOneof('camera_param')}"
                )
    except grpc.RpcError as error:
        print(f"error: {given[0]}: {error.code().name}: {error.details()}", file=sys.stderr)
        return 4
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""``onefixer-bridge HOST:PORT [SCENE]`` asks a renderer service what it is, from AlpaSim's
environment, before a long run.
"""

import sys

import grpc

from ...log.wire import common_pb2, sensorsim_pb2
from ...log.wire.services import Stub, channel_options

WAIT_S = 30.0  # for a server that starts
TIMEOUT_S = 300.0  # of a call that may load a scene


def main(arguments: list[str] | None = None) -> int:
    """Print version, scenes and cameras; return 0, 2 on wrong usage, or 4 if the service cannot be
    asked.
    """
    words = sys.argv[1:] if arguments is None else arguments
    if len(words) not in (1, 2) or words[0].startswith("-"):
        print("usage: onefixer-bridge HOST:PORT [SCENE]", file=sys.stderr)
        return 2
    try:
        with grpc.insecure_channel(words[0], channel_options(words[0])) as channel:
            service = Stub(channel, "SensorsimService")
            empty = common_pb2.Empty()
            version = service.get_version(empty, timeout=WAIT_S, wait_for_ready=True)
            scenes = list(service.get_available_scenes(empty, timeout=TIMEOUT_S).scene_ids)
            api = version.grpc_api_version
            print(
                f"version {version.version_id}\nhash    {version.git_hash}\nwire    {api.major}.{api.minor}.{api.patch}"
            )
            print(
                f"scenes  {len(scenes)}: {', '.join(scenes[:5])}{' ...' if len(scenes) > 5 else ''}"
            )
            scene = words[1] if len(words) > 1 else scenes[0]
            camera_request = sensorsim_pb2.AvailableCamerasRequest(scene_id=scene)
            cameras = service.get_available_cameras(
                camera_request, timeout=TIMEOUT_S
            ).available_cameras
            for camera in cameras:
                size = camera.intrinsics.resolution_w, camera.intrinsics.resolution_h
                print(
                    f"camera  {camera.logical_id}: {size[0]} x {size[1]}, {camera.intrinsics.WhichOneof('camera_param')}"
                )
    except grpc.RpcError as error:
        print(f"error: {words[0]}: {error.code().name}: {error.details()}", file=sys.stderr)
        return 4
    return 0


if __name__ == "__main__":
    sys.exit(main())

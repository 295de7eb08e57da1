"""``onefixer-bridge HOST:PORT [SCENE]``: ask a renderer service what it is, from AlpaSim's environment, before a long run."""

from __future__ import annotations

import sys

import grpc

from .client import RendererClient


def main(arguments: list[str] | None = None) -> int:
    """Print version, scenes and cameras; return 0, 2 on wrong usage, or 4 if the service cannot be asked."""
    given = sys.argv[1:] if arguments is None else arguments
    if len(given) not in (1, 2) or given[0].startswith("-"):
        print("usage: onefixer-bridge HOST:PORT [SCENE]", file=sys.stderr)
        return 2
    try:
        with RendererClient(given[0]) as client:
            version, scenes = client.version(), client.scenes()
            api = version.grpc_api_version
            print(f"version {version.version_id}\nhash    {version.git_hash}\nwire    {api.major}.{api.minor}.{api.patch}")
            print(f"scenes  {len(scenes)}: {', '.join(scenes[:5])}{' ...' if len(scenes) > 5 else ''}")
            for camera in client.cameras(given[1] if len(given) > 1 else scenes[0]):
                size = camera.intrinsics.resolution_w, camera.intrinsics.resolution_h
                print(f"camera  {camera.logical_id}: {size[0]} x {size[1]}, {camera.intrinsics.WhichOneof('camera_param')}")
    except grpc.RpcError as error:
        print(f"error: {given[0]}: {error.code().name}: {error.details()}", file=sys.stderr)
        return 4
    return 0


if __name__ == "__main__":
    sys.exit(main())

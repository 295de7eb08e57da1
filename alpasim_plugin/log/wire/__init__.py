"""The wire messages, and the paths under which AlpaSim knows the services.

The messages live in private proto packages (``simrun.wire.*``): two files that both define
``common.Vec3`` cannot share a process, and a user may well have AlpaSim's own package installed.
Nothing on the wire depends on the package of a message; only the service path does, and
`SERVICE_PATHS` gives it. This package stands alone: it imports protobuf and grpc, and nothing of
the project.
"""

from .protos import (
    common_pb2,
    controller_pb2,
    egodriver_pb2,
    health_pb2,
    logging_pb2,
    physics_pb2,
    reflection_pb2,
    runtime_pb2,
    sensorsim_pb2,
    traffic_pb2,
    video_model_pb2,
)

#: Every message module, in order of name.
MODULES = (
    common_pb2,
    controller_pb2,
    egodriver_pb2,
    health_pb2,
    logging_pb2,
    physics_pb2,
    reflection_pb2,
    runtime_pb2,
    sensorsim_pb2,
    traffic_pb2,
    video_model_pb2,
)

#: Full gRPC path prefix of each service as its clients dial it, by the name of our compiled
#: service.
SERVICE_PATHS = {
    "SensorsimService": "/nre.grpc.protos.sensorsim.SensorsimService/",
    "EgodriverService": "/egodriver.EgodriverService/",
    "VDCService": "/controller.VDCService/",
    "PhysicsService": "/physics.PhysicsService/",
    "TrafficService": "/traffic.TrafficService/",
    "RuntimeService": "/RuntimeService/",
    "WorldModelService": "/omnidreams.video_model.WorldModelService/",
    "Health": "/grpc.health.v1.Health/",
    "ServerReflection": "/grpc.reflection.v1.ServerReflection/",
}

#: Version of AlpaSim's wire interface that these messages speak: what `common.VersionId` reports.
API_VERSION = (0, 54, 0)

#: What AlpaSim's drivers, evaluation and presets call the main camera.
FRONT_WIDE = "camera_front_wide_120fov"


def api_version() -> common_pb2.VersionId.APIVersion:
    """Return `API_VERSION` as a message."""
    major, minor, patch = API_VERSION
    return common_pb2.VersionId.APIVersion(major=major, minor=minor, patch=patch)


__all__ = [
    "API_VERSION",
    "FRONT_WIDE",
    "MODULES",
    "SERVICE_PATHS",
    "api_version",
    "common_pb2",
    "controller_pb2",
    "egodriver_pb2",
    "health_pb2",
    "logging_pb2",
    "physics_pb2",
    "reflection_pb2",
    "runtime_pb2",
    "sensorsim_pb2",
    "traffic_pb2",
    "video_model_pb2",
]

"""Give the compiled wire messages, and the paths under which AlpaSim knows our services.

The messages live in private proto packages (``simrun.wire.*``): two files that both define ``common.Vec3`` cannot share a process,
and a user may well have AlpaSim's own package installed. Nothing on the wire depends on the package of a message; only the service
path does, and `SERVICE_PATHS` gives it.
"""

from __future__ import annotations

from alpasim_plugin.errors import InfrastructureError

try:
    from alpasim_plugin.alpasim.protos import (
        common_pb2,
        controller_pb2,
        egodriver_pb2,
        logging_pb2,
        physics_pb2,
        runtime_pb2,
        sensorsim_pb2,
        traffic_pb2,
        video_model_pb2,
    )
except ImportError as missing:
    raise InfrastructureError(
        "loading the wire messages",
        "alpasim_plugin.alpasim.protos",
        f"compiled modules are missing or do not load ({missing})",
        "run `python setup.py build_protos` in the checkout (needs grpcio-tools), or install with pip",
    ) from missing

#: Full gRPC path prefix of each service as AlpaSim's runtime dials it, by the name of our compiled service.
SERVICE_PATHS = {
    "SensorsimService": "/nre.grpc.protos.sensorsim.SensorsimService/",
    "EgodriverService": "/egodriver.EgodriverService/",
    "VDCService": "/controller.VDCService/",
    "PhysicsService": "/physics.PhysicsService/",
    "TrafficService": "/traffic.TrafficService/",
    "RuntimeService": "/RuntimeService/",
    "WorldModelService": "/omnidreams.video_model.WorldModelService/",
}

__all__ = [
    "SERVICE_PATHS",
    "common_pb2",
    "controller_pb2",
    "egodriver_pb2",
    "logging_pb2",
    "physics_pb2",
    "runtime_pb2",
    "sensorsim_pb2",
    "traffic_pb2",
    "video_model_pb2",
]

"""A driver of AlpaSim's EgodriverService that goes straight on from a session's newest pose; as a
program it serves at the address in ``SIMRUN_POLICY_ADDRESS``.

With ``needs-its-folder`` it ends where the folder of its code cannot be written.
"""

import os
import sys
import threading
from concurrent import futures
from pathlib import Path

import grpc

from alpasim_plugin.log.wire import common_pb2, egodriver_pb2
from alpasim_plugin.log.wire.services import handlers


class StraightDriver:
    """Goes on at 5 m/s along x.

    Args:
        sessions_apart: Whether each session has a pose of its own; else the newest of any counts.
    """

    def __init__(self, sessions_apart=True):
        self._apart = sessions_apart
        self._poses = {}

    def get_version(self, request, context):
        return common_pb2.VersionId(version_id="straight")

    def start_session(self, request, context):
        return common_pb2.SessionRequestStatus()

    def close_session(self, request, context):
        return common_pb2.Empty()

    def submit_image_observation(self, request, context):
        return common_pb2.Empty()

    def submit_egomotion_observation(self, request, context):
        self._poses[self._key(request)] = request.trajectory.poses[-1].pose
        return common_pb2.Empty()

    def submit_route(self, request, context):
        return common_pb2.Empty()

    def drive(self, request, context):
        pose = self._poses[self._key(request)]
        answer = egodriver_pb2.DriveResponse()
        for step in range(51):
            at = answer.trajectory.poses.add(timestamp_us=request.time_now_us + 100_000 * step)
            at.pose.CopyFrom(pose)
            at.pose.vec.x += 0.5 * step
        return answer

    def _key(self, request):
        return request.session_uuid if self._apart else ""


def main():
    folder = Path(__file__).parent
    if "needs-its-folder" in sys.argv and not os.access(folder, os.W_OK):
        sys.exit(f"cannot write to {folder}")
    server = grpc.server(futures.ThreadPoolExecutor(4))
    server.add_generic_rpc_handlers((handlers("EgodriverService", StraightDriver()),))
    server.add_insecure_port(os.environ["SIMRUN_POLICY_ADDRESS"])
    server.start()
    threading.Event().wait()


if __name__ == "__main__":
    main()

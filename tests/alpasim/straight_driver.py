"""A driver of AlpaSim's EgodriverService that goes straight on from a session's newest pose; as a
program it serves at the address in ``SIMRUN_POLICY_ADDRESS``.

With ``needs-folder=FOLDER`` it ends where that folder cannot be written; with
``writes-to=FILE`` it writes to a file at each session's start; with ``counts-in=FILE`` it counts its
processes in a file, and each drives 1 m/s faster than the one before.
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
        written: A file that it writes to at the start of a session.
        speed_mps: Its speed.
    """

    def __init__(self, sessions_apart=True, written=None, speed_mps=5.0):
        self._apart = sessions_apart
        self._written = written
        self._speed_mps = speed_mps
        self._poses = {}

    def get_version(self, request, context):
        return common_pb2.VersionId(version_id="straight")

    def start_session(self, request, context):
        if self._written is not None:
            Path(self._written).write_text(request.session_uuid)
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
            at.pose.vec.x += 0.1 * self._speed_mps * step
        return answer

    def _key(self, request):
        return request.session_uuid if self._apart else ""


def main():
    options = dict(word.split("=", 1) for word in sys.argv[1:] if "=" in word)
    folder = options.get("needs-folder")
    if folder is not None and not os.access(folder, os.W_OK):
        sys.exit(f"cannot write to {folder}")
    speed_mps = 5.0
    if "counts-in" in options:
        with open(options["counts-in"], "a+") as counter:
            counter.write(".")
            speed_mps += counter.tell()
    server = grpc.server(futures.ThreadPoolExecutor(4))
    driver = StraightDriver(written=options.get("writes-to"), speed_mps=speed_mps)
    server.add_generic_rpc_handlers((handlers("EgodriverService", driver),))
    server.add_insecure_port(os.environ["SIMRUN_POLICY_ADDRESS"])
    server.start()
    threading.Event().wait()


if __name__ == "__main__":
    main()

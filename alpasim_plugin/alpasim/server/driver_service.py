"""AlpaSim's EgodriverService in front of a policy of ours."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from alpasim_plugin import __version__
from alpasim_plugin.alpasim.server.driving import Driving
from alpasim_plugin.alpasim.server.status import answering
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.plugins.interfaces import Policy
from alpasim_plugin.wire import api_version, common_pb2, egodriver_pb2

DOING = "serving a policy"


class DriverService:
    """The service; sessions are independent, and a policy of its own drives each.

    Args:
        name: Of the policy, for `get_version`.
        digest: Of its code and weights; None: it has none.
        make: Makes a session's policy for a scenario.
        scenario_of: Returns what a policy is made for, by scene id.
        most_sessions: How many may be open at a time.

    Attributes:
        drives_s: Seconds of every answered query with a plan.
        counts: Calls, and failed ones, by name.
    """

    def __init__(
        self,
        name: str,
        digest: str | None,
        make: Callable[[Scenario], Policy],
        scenario_of: Callable[[str], Scenario],
        most_sessions: int = 64,
    ) -> None:
        self._name, self._digest = name, digest
        self._make, self._scenario_of, self._most = make, scenario_of, most_sessions
        self._sessions: dict[str, Driving] = {}
        self._lock = threading.Lock()
        self.drives_s: list[float] = []
        self.counts: Counter[str] = Counter()

    @answering
    def get_version(self, request: common_pb2.Empty, context: Any) -> common_pb2.VersionId:
        """Name the policy and the digest of its code and weights."""
        digest = (self._digest or "undigested")[:40]
        return common_pb2.VersionId(version_id=f"simrun-{__version__}+{self._name}", git_hash=digest, grpc_api_version=api_version())

    @answering
    def start_session(self, request: egodriver_pb2.DriveSessionRequest, context: Any) -> common_pb2.SessionRequestStatus:
        """Open a session."""
        self.counts["start_session"] += 1
        scenario = self._scenario_of(request.debug_info.scene_id)
        session = Driving(request, scenario, self._make)
        with self._lock:
            if request.session_uuid in self._sessions:
                raise InputError(DOING, "start_session", f"session {request.session_uuid!r} is open already", "close it first")
            if len(self._sessions) >= self._most:
                found = f"{self._most} sessions are open"
                raise InputError(DOING, "start_session", found, "close sessions that are over, or serve with a larger --sessions")
            self._sessions[request.session_uuid] = session
        return common_pb2.SessionRequestStatus()

    @answering
    def close_session(self, request: egodriver_pb2.DriveSessionCloseRequest, context: Any) -> common_pb2.Empty:
        """Close a session; one that is not open is no error, since AlpaSim closes after failures too."""
        with self._lock:
            session = self._sessions.pop(request.session_uuid, None)
        if session is not None:
            session.close()
        return common_pb2.Empty()

    @answering
    def submit_image_observation(self, request: egodriver_pb2.RolloutCameraImage, context: Any) -> common_pb2.Empty:
        """Take a frame."""
        self._session(request.session_uuid).take_image(request.camera_image)
        return common_pb2.Empty()

    @answering
    def submit_egomotion_observation(self, request: egodriver_pb2.RolloutEgoTrajectory, context: Any) -> common_pb2.Empty:
        """Take motion."""
        self._session(request.session_uuid).take_motion(request)
        return common_pb2.Empty()

    @answering
    def submit_route(self, request: egodriver_pb2.RouteRequest, context: Any) -> common_pb2.Empty:
        """Take the route."""
        self._session(request.session_uuid).take_route(request.route)
        return common_pb2.Empty()

    @answering
    def submit_recording_ground_truth(self, request: egodriver_pb2.GroundTruthRequest, context: Any) -> common_pb2.Empty:
        """Take no notice: a policy under test has no use for the recorded future."""
        self._session(request.session_uuid)
        return common_pb2.Empty()

    @answering
    def drive(self, request: egodriver_pb2.DriveRequest, context: Any) -> egodriver_pb2.DriveResponse:
        """Answer with a plan, or with an empty one while the policy lacks frames."""
        began = time.perf_counter()
        answer = self._session(request.session_uuid).drive(int(request.time_now_us))
        self.counts["drive" if answer.trajectory.poses else "drive without a frame"] += 1
        self.drives_s.append(time.perf_counter() - began)
        return answer

    def failed(self, call: str, code: Any, text: str, error: Exception) -> None:
        """Count a failed call; called by `answering`."""
        self.counts[f"{call} {code.name}"] += 1

    def _session(self, name: str) -> Driving:
        with self._lock:
            session = self._sessions.get(name)
        if session is None:
            raise InputError(DOING, f"session {name!r}", "it is not open", "call start_session first")
        return session

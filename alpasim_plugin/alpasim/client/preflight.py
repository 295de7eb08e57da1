"""The pre-flight check of an AlpaSim driver: what the challenge and AlpaSim's runtime ask of it,
tried over its socket.

Each check gives a line: passed, failed, or not visible from outside. The session that is driven is
a real rollout of ours.
"""

import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from alpasim_plugin.alpasim.client.channel import Service
from alpasim_plugin.alpasim.client.driver import BUDGET_S
from alpasim_plugin.core.errors import SimrunError
from alpasim_plugin.log.wire import egodriver_pb2

HORIZON_US = 2_000_000  # what AlpaSim's controller needs
MINADE_US = 5_000_000  # what its evaluation needs
Result = Literal["passed", "failed", "noted"]


@dataclass(frozen=True)
class Finding:
    """One line of the check."""

    name: str
    result: Result
    text: str


@dataclass
class DriveTimes:
    """Measures the drive calls of a service and looks at its raw answers, beside whoever makes
    them.

    Attributes:
        seconds: Of each drive call.
        problems: What was wrong with answers, by kind, with the first example.
        reach_us: The shortest plan, from its query to its last pose.
        samples_us: The shortest sampled plan; None without samples.
        empty: Answers without poses.
    """

    seconds: list[float] = field(default_factory=list)
    problems: dict[str, str] = field(default_factory=dict)
    reach_us: int | None = None
    samples_us: int | None = None
    empty: int = 0

    def watch(self, service: Service) -> None:
        """Measure every drive call of a service from now on."""
        made: Callable[..., Any] = service.stub.drive

        def drive(
            request: egodriver_pb2.DriveRequest, **options: Any
        ) -> egodriver_pb2.DriveResponse:
            began = time.perf_counter()
            answer: egodriver_pb2.DriveResponse = made(request, **options)
            self.seconds.append(time.perf_counter() - began)
            self.look(request, answer)
            return answer

        setattr(service.stub, "drive", drive)  # noqa: B010  # the stub makes its methods when it is made

    def look(
        self, request: egodriver_pb2.DriveRequest, answer: egodriver_pb2.DriveResponse
    ) -> None:
        """Look at one answer as it came."""
        poses = answer.trajectory.poses
        if not poses:
            self.empty += 1
            return
        now = int(request.time_now_us)
        t_us = [int(pose.timestamp_us) for pose in poses]
        if t_us[0] != now:
            self.problems.setdefault(
                "the first pose is not at time_now", f"{t_us[0] - now:+d} us at {now}"
            )
        if any(later <= earlier for earlier, later in pairwise(t_us)):
            self.problems.setdefault("times do not increase strictly", f"at {now}")
        squares = [sum(getattr(pose.pose.quat, axis) ** 2 for axis in "wxyz") for pose in poses]
        if any(abs(square - 1) > 1e-4 for square in squares):
            self.problems.setdefault(
                "a quaternion is no unit quaternion", f"|q|^2 = {min(squares):.5f} at {now}"
            )
        if not all(
            np.isfinite([pose.pose.vec.x, pose.pose.vec.y, pose.pose.vec.z]).all() for pose in poses
        ):
            self.problems.setdefault("a position is not finite", f"at {now}")
        self.reach_us = min(
            t_us[-1] - now, self.reach_us if self.reach_us is not None else t_us[-1] - now
        )
        for sample in answer.debug_info.sampled_trajectories:
            reach = int(sample.poses[-1].timestamp_us) - now if sample.poses else 0
            self.samples_us = min(reach, self.samples_us if self.samples_us is not None else reach)


def findings(
    times: DriveTimes, failed: SimrunError | None, warmup_steps: int, limit_s: float = BUDGET_S
) -> list[Finding]:
    """Return what a driven session showed.

    Args:
        times: Of its drive calls.
        failed: What ended it early, if anything did.
        warmup_steps: Queries in which empty plans are accepted.
        limit_s: Of a drive call.
    """
    out = []

    def add(name: str, is_failed: bool, text: str) -> None:
        out.append(Finding(name, "failed" if is_failed else "passed", text))

    session = failed.message if failed else "answered throughout"
    add("a session from start to close", failed is not None, session)
    if times.seconds:
        ms = np.array(times.seconds) * 1000
        over = int((ms > limit_s * 1000).sum())
        p50, p95 = np.percentile(ms, (50, 95))
        text = f"p50 {p50:.1f} ms, p95 {p95:.1f} ms, longest {ms.max():.1f} ms; {over} of {len(ms)} over"
        add(f"a drive call within {limit_s * 1000:.0f} ms", over > 0, text)
    problems = "; ".join(f"{kind} ({example})" for kind, example in times.problems.items())
    fine = "first pose now, times increase, unit quaternions"
    add("the shape of plans", bool(problems), problems or fine)
    text = f"{times.empty} of {len(times.seconds)}"
    add("empty plans in the warm-up only", times.empty > warmup_steps, text)
    if times.reach_us is not None:
        text = f"the shortest reaches {times.reach_us * 1e-6:g} s; where a plan ends the car brakes"
        add("plans of at least 2 s", times.reach_us < HORIZON_US, text)
    if times.samples_us is None:
        text = "no sampled_trajectories: AlpaSim's tables will hold no minADE"
        out.append(Finding("samples for minADE", "noted", text))
        return out
    is_short = times.samples_us < MINADE_US
    text = f"the shortest reaches {times.samples_us * 1e-6:g} s"
    if is_short:
        text += "; one below 5 s loses all minADE metrics of its rollout"
    add("samples for minADE", is_short, text)
    return out


def tolerances(service: Service, scene_id: str) -> list[Finding]:
    """Try calls that AlpaSim's runtime makes after failures, in a scene that the driver has
    driven.
    """
    out = []
    name = str(uuid.uuid5(uuid.NAMESPACE_URL, "simrun check driver"))
    out.append(
        _tried("close_session before any step", lambda: _open_and_close(service, name, scene_id))
    )
    close = egodriver_pb2.DriveSessionCloseRequest(session_uuid=name)
    out.append(
        _tried(
            "close_session of a session that is not open",
            lambda: service.call("close_session", close, 10.0),
        )
    )
    return out


def _open_and_close(service: Service, name: str, scene_id: str) -> None:
    debug = egodriver_pb2.DriveSessionRequest.DebugInfo(scene_id=scene_id)
    service.call(
        "start_session",
        egodriver_pb2.DriveSessionRequest(session_uuid=name, debug_info=debug),
        10.0,
    )
    service.call("close_session", egodriver_pb2.DriveSessionCloseRequest(session_uuid=name), 10.0)


def _tried(name: str, call: Callable[[], Any]) -> Finding:
    try:
        call()
    except SimrunError as error:
        return Finding(name, "failed", error.message)
    return Finding(name, "passed", "answered")

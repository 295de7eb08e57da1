"""AlpaSim's EgodriverService in front of a policy of ours: sessions, what was submitted in each,
and the plan that follows from it.

Submissions may come in any order and from several threads. A query before every camera has a frame,
or before any motion, is answered with an empty plan, which AlpaSim accepts in its warm-up.

`serve_policy` serves a policy in a Python environment of its own, which `simrun --policy
"exec:..."` starts and drives. Of this project only light modules are imported here, and of other
packages numpy, grpc, protobuf and OpenCV: the environment needs neither torch nor the rest. A test
holds it to that.
"""

import inspect
import os
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from alpasim_plugin import __version__
from alpasim_plugin.alpasim.server.hosting import SESSION_BYTES, SESSIONS, Host, Sessions
from alpasim_plugin.alpasim.server.status import answering
from alpasim_plugin.alpasim.server.views import MAX_TIME_US, Straight, straight_of
from alpasim_plugin.core.errors import InputError, PolicyError
from alpasim_plugin.core.files.images import check_image, image_fault
from alpasim_plugin.core.geometry import quat_from_yaw, se3, transform_points, wrap_angle, yaw_of
from alpasim_plugin.core.interfaces import Policy, complete
from alpasim_plugin.core.plan_check import blank_scenario, plan_problem, sensors_problem
from alpasim_plugin.core.printing import warn
from alpasim_plugin.core.types import (
    F64,
    I64,
    CameraSpec,
    EgoState,
    Frame,
    Observation,
    Route,
    Scenario,
    Trajectory,
)
from alpasim_plugin.log.images import decode_image
from alpasim_plugin.log.schema import increasing_times, read_poses, read_transform, wire_trajectory
from alpasim_plugin.log.wire import api_version, common_pb2, egodriver_pb2, sensorsim_pb2

ADDRESS = "SIMRUN_POLICY_ADDRESS"
ROUTE_POINTS = 20
# AlpaSim sends zero speeds until it hands over; where the poses move faster than this, their own
# speed is taken instead
MOVING_MPS = 0.3
SPEED_WINDOW_US = 200_000
MOST_POSES = 8192  # of a session's motion; the oldest are forgotten
MOST_CAMERAS = 64  # of a session


class DriverService:
    """The service; sessions are independent, and a policy of its own drives each.

    Args:
        name: Of the policy, for `get_version`.
        digest: Of its code and weights; None: it has none.
        make: Makes a session's policy for a scenario.
        scenario_of: Returns what a policy is made for, by scene id.
        expiry_s: A session that nobody used for so long is closed.
        most_sessions: How many may be open at a time.
        budget: Bytes that all sessions together may keep and work on.
        clock: Monotonic seconds.

    Attributes:
        sessions: Those that are open.
        counts: Calls, and failed ones, by name.
    """

    def __init__(
        self,
        name: str,
        digest: str | None,
        make: Callable[[Scenario], Policy],
        scenario_of: Callable[[str], Scenario],
        expiry_s: float = 900.0,
        most_sessions: int = SESSIONS,
        clock: Callable[[], float] = time.monotonic,
        budget: int = SESSION_BYTES,
    ) -> None:
        self._name = name
        self._digest = digest
        self._make = make
        self._scenario_of = scenario_of
        self.sessions: Sessions[Driving] = Sessions(
            expiry_s, most_sessions, Driving.close, clock, budget
        )
        self.counts: Counter[str] = Counter()

    @answering
    def get_version(self, request: common_pb2.Empty, context: Any) -> common_pb2.VersionId:
        """Name the policy and the digest of its code and weights."""
        digest = (self._digest or "undigested")[:40]
        return common_pb2.VersionId(
            version_id=f"simrun-{__version__}+{self._name}",
            git_hash=digest,
            grpc_api_version=api_version(),
        )

    @answering
    def start_session(
        self, request: egodriver_pb2.DriveSessionRequest, context: Any
    ) -> common_pb2.SessionRequestStatus:
        """Open a session."""
        self.counts["start_session"] += 1
        scenario = self._scenario_of(request.debug_info.scene_id)
        self.sessions.open(request.session_uuid, Driving(request, scenario, self._make))
        return common_pb2.SessionRequestStatus()

    @answering
    def close_session(
        self, request: egodriver_pb2.DriveSessionCloseRequest, context: Any
    ) -> common_pb2.Empty:
        """Close a session; one that is not open is no error, since AlpaSim closes after failures
        too.
        """
        self.sessions.close(request.session_uuid)
        return common_pb2.Empty()

    @answering
    def submit_image_observation(
        self, request: egodriver_pb2.RolloutCameraImage, context: Any
    ) -> common_pb2.Empty:
        """Take a frame."""
        session = self.sessions.get(request.session_uuid)
        session.take_image(request.camera_image)
        self.sessions.hold(request.session_uuid, session.held)
        return common_pb2.Empty()

    @answering
    def submit_egomotion_observation(
        self, request: egodriver_pb2.RolloutEgoTrajectory, context: Any
    ) -> common_pb2.Empty:
        """Take motion."""
        self.sessions.get(request.session_uuid).take_motion(request)
        return common_pb2.Empty()

    @answering
    def submit_route(self, request: egodriver_pb2.RouteRequest, context: Any) -> common_pb2.Empty:
        """Take the route."""
        self.sessions.get(request.session_uuid).take_route(request.route)
        return common_pb2.Empty()

    @answering
    def submit_recording_ground_truth(
        self, request: egodriver_pb2.GroundTruthRequest, context: Any
    ) -> common_pb2.Empty:
        """Take no notice: a policy under test has no use for the recorded future."""
        self.sessions.get(request.session_uuid)
        return common_pb2.Empty()

    @answering
    def drive(
        self, request: egodriver_pb2.DriveRequest, context: Any
    ) -> egodriver_pb2.DriveResponse:
        """Answer with a plan, or with an empty one while the policy lacks frames."""
        session = self.sessions.get(request.session_uuid)
        with self.sessions.working(request.session_uuid, session.decoded):
            answer = session.drive(int(request.time_now_us))
        self.counts["drive" if answer.trajectory.poses else "drive without a frame"] += 1
        return answer

    def failed(self, call: str, code: Any, text: str, error: Exception) -> None:
        """Count a failed call; called by `answering`."""
        self.counts[f"{call} {code.name}"] += 1


class Driving:
    """A session. What it keeps is bounded: the newest image of each camera, as it came, and the
    newest `MOST_POSES` of the motion. Images are decoded when the policy is asked.

    Args:
        request: The call that opened it: seed and cameras.
        scenario: What a policy is made for; its cameras are replaced by the session's.
        make: Makes the policy for a scenario.
    """

    def __init__(
        self,
        request: egodriver_pb2.DriveSessionRequest,
        scenario: Scenario,
        make: Callable[[Scenario], Policy],
    ) -> None:
        self._seed, self._scenario, self._make = int(request.random_seed), scenario, make
        self._native = _native(request.rollout_spec.vehicle.available_cameras)
        self._lock = threading.Lock()
        self._images: dict[str, tuple[int, bytes]] = {}  # end of the exposure, encoded
        self._sizes: dict[str, tuple[int, int]] = {}
        self._history = Trajectory(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 4)))
        self._state: Any = None
        self._route_rig: F64 = np.full((ROUTE_POINTS, 3), np.nan)
        self._policy: Policy | None = None
        self._cameras: Mapping[str, CameraSpec] = {}

    def take_image(self, image: egodriver_pb2.RolloutCameraImage.CameraImage) -> None:
        """Keep a camera's newest image.

        Raises:
            InputError: The session has no such camera, or it is no image, or one of another size
                than those before.
        """
        if image.logical_id not in self._native:
            raise InputError(
                f"submit_image_observation: an image of camera {image.logical_id!r}; the session has {sorted(self._native)}",
                "send only the cameras of the session",
            )
        check_time(image.frame_end_us, "submit_image_observation")
        location = f"camera {image.logical_id!r} at {image.frame_end_us} us"
        size = check_image(image.image_bytes, location)
        if fault := image_fault(image.image_bytes):
            raise InputError(f"{location}: {fault}", "give a whole PNG or JPEG image")
        with self._lock:
            if (held := self._sizes.setdefault(image.logical_id, size)) != size:
                raise InputError(
                    f"camera {image.logical_id!r}: {size[0]} x {size[1]} pixels after {held[0]} x {held[1]}",
                    "send all images of a camera in one size",
                )
            newest_us, _ = self._images.get(image.logical_id, (-1, b""))
            if newest_us <= image.frame_end_us:
                self._images[image.logical_id] = int(image.frame_end_us), image.image_bytes

    @property
    def held(self) -> int:
        """Give the bytes of the images that it keeps."""
        with self._lock:
            return sum(len(data) for _, data in self._images.values())

    @property
    def decoded(self) -> int:
        """Give the bytes that a query takes: the images that the policy sees, and each once more as
        its pinhole sees it.
        """
        with self._lock:
            sizes = [self._sizes[name] for name in self._cameras or self._sizes]
            return sum(2 * 3 * width * height for width, height in sizes)

    def _frame(self, name: str) -> Frame:
        """Return a camera's newest image as the pinhole sees it that policies compute with."""
        t_us, data = self._images[name]
        rgb = decode_image(data, f"camera {name!r} at {t_us} us")
        return Frame(t_us, name, self._lens(name).image(rgb))

    def _lens(self, name: str) -> Straight:
        return straight_of(self._native[name].intrinsics, *self._sizes[name])

    def take_motion(self, message: egodriver_pb2.RolloutEgoTrajectory) -> None:
        """Append poses; those at or before the newest one are left out."""
        with self._lock:
            history = self._history
            newest = int(history.t_us[-1]) if len(history) else -1
            new = [pose for pose in message.trajectory.poses if pose.timestamp_us > newest]
            t_us = increasing_times([pose.timestamp_us for pose in new], "the ego's motion")
            if new:
                check_time(new[-1].timestamp_us, "submit_egomotion_observation")
                xyz, quat = read_poses((pose.pose for pose in new), "the ego's motion")
                times = np.concatenate((history.t_us, t_us))[-MOST_POSES:]
                places = np.concatenate((history.xyz, xyz))[-MOST_POSES:]
                turns = np.concatenate((history.quat, quat))[-MOST_POSES:]
                self._history = Trajectory(times, places, turns)
            if message.dynamic_states:
                self._state = message.dynamic_states[-1]

    def take_route(self, route: egodriver_pb2.Route) -> None:
        """Keep the newest route; a row of NaN ends it."""
        rows = np.array(
            [(point.x, point.y, point.z) for point in route.waypoints[:ROUTE_POINTS]],
            dtype=np.float64,
        ).reshape(-1, 3)
        with self._lock:
            self._route_rig = np.full((ROUTE_POINTS, 3), np.nan)
            self._route_rig[: len(rows)] = rows

    def drive(self, now_us: int) -> egodriver_pb2.DriveResponse:
        """Return the policy's plan as absolute poses; empty where it cannot be asked yet.

        Raises:
            InputError: A time beyond 2^62 us.
            PolicyError: It returned no plan, or asks for cameras that the session does not have.
        """
        check_time(now_us, "drive")
        with self._lock:
            if not len(self._history) or len(self._images) < len(self._native):
                return egodriver_pb2.DriveResponse()
            ego = self._ego()
            history = self._history
            policy = self._policy = self._policy or self._started(ego)
            frames = {name: self._frame(name) for name in self._images if name in self._cameras}
            observation = Observation(
                now_us,
                frames,
                self._cameras,
                replace(ego, t_us=now_us),
                history,
                self._route_rig.copy(),
            )
            plan = policy.act(observation)
            problem = plan_problem(plan, now_us)
            if problem:
                raise PolicyError(
                    f"{type(policy).__name__}: {problem}",
                    "simrun check policy finds all faults of a policy",
                )
            trajectory, *samples = (
                _in_world(plan.times_us, xy_yaw, ego.T_world_rig)
                for xy_yaw in (np.column_stack([plan.xy, plan.yaw]), *plan.samples)
            )
            debug = egodriver_pb2.DriveResponse.DebugInfo(sampled_trajectories=samples)
            return egodriver_pb2.DriveResponse(trajectory=trajectory, debug_info=debug)

    def close(self) -> None:
        """Give back what the policy holds."""
        with self._lock:
            if self._policy is not None:
                self._policy.close()

    def _started(self, ego: EgoState) -> Policy:
        """Make the policy for the cameras as they come: an image may have another size than its
        calibration.
        """
        cameras = []
        for name, camera in self._native.items():
            lens = self._lens(name)
            mounting = read_transform(camera.rig_to_camera, f"mounting of camera {name!r}")
            cameras.append(CameraSpec(name, *lens.size, lens.K, mounting))
        waypoints_rig = self._route_rig[np.isfinite(self._route_rig).all(axis=1)]
        route = Route(
            transform_points(ego.T_world_rig, waypoints_rig)
            if len(waypoints_rig)
            else ego.T_world_rig[None, :3, 3]
        )
        policy = self._make(replace(self._scenario, cameras=tuple(cameras), route=route))
        problem = sensors_problem(policy.sensors)
        wanted = [] if problem else [sensor.camera for sensor in policy.sensors]
        missing = sorted(set(wanted) - set(self._native))
        if problem or missing:
            problem = (
                problem or f"it asks for cameras {missing}; the session has {sorted(self._native)}"
            )
            raise PolicyError(
                f"{type(policy).__name__}: {problem}",
                "name the session's cameras as the policy does: ?cameras=NAME,...",
            )
        self._cameras = {camera.name: camera for camera in cameras if camera.name in wanted}
        policy.reset(self._seed, route)
        return policy

    def _ego(self) -> EgoState:
        """Return the ego at its newest pose, with the motion that the caller states; where that has
        no speed and the poses move, with the speed and the turn of the last `SPEED_WINDOW_US`.
        """
        history = self._history
        now = int(self._history.t_us[-1])
        pose = se3(history.xyz[-1], history.quat[-1])
        speed_mps = 0.0
        yaw_rate = 0.0
        accel = 0.0
        if self._state is not None:
            speed_mps = self._state.linear_velocity.x
            yaw_rate = self._state.angular_velocity.z
            accel = self._state.linear_acceleration.x
        earlier = max(
            int(np.searchsorted(history.t_us, now - SPEED_WINDOW_US, side="right")) - 1, 0
        )
        dt_s = (now - int(history.t_us[earlier])) * 1e-6
        if speed_mps == 0.0 and dt_s > 0:
            before = se3(history.xyz[earlier], history.quat[earlier])
            measured_mps = float((history.xyz[-1] - before[:3, 3]) @ pose[:3, 0]) / dt_s
            if abs(measured_mps) > MOVING_MPS:
                speed_mps = measured_mps
                yaw_rate = float(wrap_angle(yaw_of(pose) - yaw_of(before))) / dt_s
        return EgoState(now, pose, float(speed_mps), float(accel), float(yaw_rate))


def check_time(t_us: int, call: str) -> None:
    """Raise `InputError` for a time that no rollout has: computing with it would overflow."""
    if t_us >= MAX_TIME_US:
        raise InputError(f"{call}: {t_us} us", "send a time below 2^62 microseconds")


def _in_world(times_us: I64, rows: F64, T_world_rig: F64) -> Any:
    """Return a trajectory in the rig's frame as AlpaSim's message, in the world's and at the rig's
    height.

    Args:
        times_us: ``(T,)``, microseconds.
        rows: ``(T, 3)`` x and y in metres, and yaw in radians.
        T_world_rig: Pose of the rig ``(4, 4)``.
    """
    yaw0 = yaw_of(T_world_rig)
    origin = T_world_rig[:3, 3]
    c = np.cos(yaw0)
    s = np.sin(yaw0)
    xy = rows[:, :2] @ np.array([[c, s], [-s, c]]) + origin[:2]
    xyz = np.column_stack([xy, np.full(len(rows), origin[2])])
    return wire_trajectory(
        Trajectory(times_us, xyz, quat_from_yaw(wrap_angle(rows[:, 2] + yaw0))), "the plan"
    )


def _native(cameras: Any) -> dict[str, sensorsim_pb2.AvailableCamerasReturn.AvailableCamera]:
    """Return the session's cameras, of any lens that `straight_of` takes.

    Raises:
        InputError: An invalid lens or camera pose, or too many cameras.
    """
    if len(cameras) > MOST_CAMERAS:
        raise InputError(f"start_session: {len(cameras)} cameras", f"name at most {MOST_CAMERAS}")
    for camera in cameras:
        try:
            straight_of(
                camera.intrinsics, camera.intrinsics.resolution_w, camera.intrinsics.resolution_h
            )
        except InputError as error:
            raise InputError(
                f"camera {camera.logical_id!r}: {error.message}",
                "give the driver a pinhole view of it: runtime.extra_cameras in AlpaSim, or a renderer that serves pinholes",
            ) from error
        read_transform(camera.rig_to_camera, f"mounting of camera {camera.logical_id!r}")
    return {camera.logical_id: camera for camera in cameras}


def serve_policy(factory: Callable[..., Any], address: str | None = None) -> None:
    """Serve a policy as AlpaSim's EgodriverService until the process is ended.

    Args:
        factory: The policy's class, or a function that makes one; called for every rollout, with
            the scenario if it has a parameter of that name. Of the scenario only the cameras are
            true. What is costly to load belongs outside of it.
        address: ``HOST:PORT`` or ``unix:PATH``; by default what the environment variable
            ``SIMRUN_POLICY_ADDRESS`` says.

    Raises:
        InputError: There is no address.
        InfrastructureError: The address cannot be had.

    Example:
        >>> serve_policy(Mine)  # doctest: +SKIP
    """
    place = address or os.environ.get(ADDRESS, "")
    if not place:
        raise InputError(
            f"environment variable {ADDRESS}: it is not set",
            f"start the script by simrun --policy 'exec:python SCRIPT.py', or set {ADDRESS}=127.0.0.1:6000",
        )
    takes_scenario = "scenario" in inspect.signature(factory).parameters
    name = getattr(factory, "__name__", type(factory).__name__)

    def make(scenario: Scenario) -> Policy:
        return complete(
            factory(scenario=scenario) if takes_scenario else factory(), Policy, f"policy {name!r}"
        )

    service = _Serving(name, None, make, _unknown_scene)
    with Host({"EgodriverService": service}, place, on_interval=service.sessions.expire) as host:
        host.wait()


class _Serving(DriverService):
    """The service, which prints the tracebacks of its policy: they end up in the run's output."""

    def failed(self, call: str, code: Any, text: str, error: Exception) -> None:
        super().failed(call, code, text, error)
        warn(*"".join(traceback.format_exception(error)).splitlines())


def _unknown_scene(scene_id: str) -> Scenario:
    """Return what a served policy is made for where only the session's cameras are known."""
    standing = Trajectory(
        np.zeros(1, dtype=np.int64), np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]])
    )
    return blank_scenario(scene_id, standing)

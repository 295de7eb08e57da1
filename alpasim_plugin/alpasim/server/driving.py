"""One driving session of a policy of ours behind AlpaSim's driver service: what was submitted, and the plan that follows from it.

Submissions may come in any order and from several threads. A query before every camera has a frame, or before any motion, is answered with
an empty plan, which AlpaSim accepts in its warm-up.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import InputError, PolicyError
from alpasim_plugin.core.geometry import quat_from_yaw, se3, transform_points, wrap_angle, yaw_of
from alpasim_plugin.core.plan_check import plan_problem, sensors_problem
from alpasim_plugin.core.types import F64, CameraSpec, EgoState, Frame, Observation, Plan, Route, Scenario, Trajectory
from alpasim_plugin.log.images import decode_image
from alpasim_plugin.log.schema import increasing_times, read_camera, read_poses, wire_trajectory
from alpasim_plugin.plugins.interfaces import Policy
from alpasim_plugin.wire import egodriver_pb2

DOING = "driving for AlpaSim"
ROUTE_POINTS = 20
MOVING_MPS = 0.3  # AlpaSim sends zero speeds until it hands over; faster motion than this is believed against them
SPEED_WINDOW_US = 200_000


class Driving:
    """A session.

    Args:
        request: That opened it.
        scenario: What a policy is made for; its cameras are replaced by the session's.
        make: Makes the policy for a scenario.
    """

    def __init__(self, request: egodriver_pb2.DriveSessionRequest, scenario: Scenario, make: Callable[[Scenario], Policy]) -> None:
        self._seed, self._scenario, self._make = int(request.random_seed), scenario, make
        self._native = _pinholes(request.rollout_spec.vehicle.available_cameras)
        self._lock = threading.Lock()
        self._frames: dict[str, Frame] = {}
        self._t_us: list[int] = []
        self._poses: list[tuple[F64, F64]] = []
        self._state: Any = None
        self._route_rig: F64 = np.full((ROUTE_POINTS, 3), np.nan)
        self._policy: Policy | None = None
        self._cameras: Mapping[str, CameraSpec] = {}

    def take_image(self, image: egodriver_pb2.RolloutCameraImage.CameraImage) -> None:
        """Keep a camera's newest frame.

        Raises:
            InputError: The session has no such camera, or it is no image.
        """
        if image.logical_id not in self._native:
            found = f"an image of camera {image.logical_id!r}; the session has {sorted(self._native)}"
            raise InputError(DOING, "submit_image_observation", found, "send only the cameras of the session")
        rgb = decode_image(image.image_bytes, f"camera {image.logical_id!r} at {image.frame_end_us} us")
        with self._lock:
            held = self._frames.get(image.logical_id)
            if held is None or held.t_us <= image.frame_end_us:
                self._frames[image.logical_id] = Frame(int(image.frame_end_us), image.logical_id, rgb)

    def take_motion(self, message: egodriver_pb2.RolloutEgoTrajectory) -> None:
        """Append poses; those at or before the newest one are left out."""
        with self._lock:
            newest = self._t_us[-1] if self._t_us else -1
            new = [pose for pose in message.trajectory.poses if pose.timestamp_us > newest]
            t_us = increasing_times([pose.timestamp_us for pose in new], "the ego's motion")
            xyz, quat = read_poses((pose.pose for pose in new), "the ego's motion")
            self._t_us += t_us.tolist()
            self._poses += list(zip(xyz, quat, strict=True))
            if message.dynamic_states:
                self._state = message.dynamic_states[-1]

    def take_route(self, route: egodriver_pb2.Route) -> None:
        """Keep the newest route; a row of NaN ends it."""
        rows = np.array([(p.x, p.y, p.z) for p in route.waypoints], dtype=np.float64).reshape(-1, 3)[:ROUTE_POINTS]
        with self._lock:
            self._route_rig = np.full((ROUTE_POINTS, 3), np.nan)
            self._route_rig[: len(rows)] = rows

    def drive(self, now_us: int) -> egodriver_pb2.DriveResponse:
        """Return the policy's plan as absolute poses; empty where it cannot be asked yet.

        Raises:
            PolicyError: It returned no plan, or asks for cameras that the session does not have.
        """
        with self._lock:
            if not self._t_us or len(self._frames) < len(self._native):
                return egodriver_pb2.DriveResponse()
            ego, history = self._ego(), self._history()
            policy = self._policy = self._policy or self._started(ego)
            shown = {name: frame for name, frame in self._frames.items() if name in self._cameras}
            observation = Observation(now_us, shown, self._cameras, replace(ego, t_us=now_us), history, self._route_rig.copy())
            plan = policy.act(observation)
            problem = plan_problem(plan, now_us)
            if problem:
                raise PolicyError(DOING, type(policy).__name__, problem, "simrun check-policy finds all faults of a policy")
            return self._answer(plan, ego.T_world_rig)

    def close(self) -> None:
        """Give back what the policy holds."""
        with self._lock:
            if self._policy is not None:
                self._policy.close()

    def _started(self, ego: EgoState) -> Policy:
        """Make the policy for the cameras as they come: an image may have another size than its calibration."""
        cameras = [_resized(camera, self._frames[name]) for name, camera in self._native.items()]
        known = self._route_rig[np.isfinite(self._route_rig).all(axis=1)]
        route = Route(transform_points(ego.T_world_rig, known) if len(known) else ego.T_world_rig[None, :3, 3])
        policy = self._make(replace(self._scenario, cameras=tuple(cameras), route=route))
        found = sensors_problem(policy.sensors)
        wanted = [] if found else [sensor.camera for sensor in policy.sensors]
        missing = sorted(set(wanted) - set(self._native))
        if found or missing:
            found = found or f"it asks for cameras {missing}; the session has {sorted(self._native)}"
            raise PolicyError(DOING, type(policy).__name__, found, "name the session's cameras as the policy does: ?cameras=NAME,...")
        self._cameras = {camera.name: camera for camera in cameras if camera.name in wanted}
        policy.reset(self._seed, route)
        return policy

    def _history(self) -> Trajectory:
        xyz, quat = (np.array([pose[i] for pose in self._poses]) for i in range(2))
        return Trajectory(np.array(self._t_us, dtype=np.int64), xyz, quat)

    def _ego(self) -> EgoState:
        xyz, quat = self._poses[-1]
        pose, now = se3(xyz, quat), self._t_us[-1]
        stated, turn, accel = (0.0, 0.0, 0.0)
        if self._state is not None:
            stated, turn = self._state.linear_velocity.x, self._state.angular_velocity.z
            accel = self._state.linear_acceleration.x
        earlier = next((i for i in range(len(self._t_us) - 2, -1, -1) if now - self._t_us[i] >= SPEED_WINDOW_US), 0)
        dt_s = (now - self._t_us[earlier]) * 1e-6
        if stated == 0.0 and dt_s > 0:
            before = se3(*self._poses[earlier])
            seen = float((xyz - before[:3, 3]) @ pose[:3, 0]) / dt_s
            if abs(seen) > MOVING_MPS:
                stated, turn = seen, float(wrap_angle(yaw_of(pose) - yaw_of(before))) / dt_s
        return EgoState(now, pose, float(stated), float(accel), float(turn))

    def _answer(self, plan: Plan, T_world_rig: F64) -> egodriver_pb2.DriveResponse:
        wires = [_absolute(plan, xy_yaw, T_world_rig) for xy_yaw in (np.column_stack([plan.xy, plan.yaw]), *plan.samples)]
        debug = egodriver_pb2.DriveResponse.DebugInfo(sampled_trajectories=wires[1:])
        return egodriver_pb2.DriveResponse(trajectory=wires[0], debug_info=debug)


def _absolute(plan: Plan, rows: F64, T_world_rig: F64) -> Any:
    yaw0, origin = yaw_of(T_world_rig), T_world_rig[:3, 3]
    c, s = np.cos(yaw0), np.sin(yaw0)
    xy = rows[:, :2] @ np.array([[c, s], [-s, c]]) + origin[:2]
    xyz = np.column_stack([xy, np.full(len(rows), origin[2])])
    return wire_trajectory(Trajectory(plan.times_us, xyz, quat_from_yaw(wrap_angle(rows[:, 2] + yaw0))), "the plan")


def _pinholes(listed: Any) -> dict[str, CameraSpec]:
    """Return the session's cameras.

    Raises:
        InputError: One is no ideal pinhole: policies of this package compute with pinholes.
    """
    out: dict[str, CameraSpec] = {}
    for camera in listed:
        spec = read_camera(camera)
        if spec is None:
            kind = camera.intrinsics.WhichOneof("camera_param") or "no intrinsics"
            do_this = "give the driver a pinhole view of it: runtime.extra_cameras in AlpaSim, or a renderer that serves pinholes"
            raise InputError(DOING, f"camera {camera.logical_id!r}", f"{kind} with distortion", do_this)
        out[camera.logical_id] = spec
    return out


def _resized(camera: CameraSpec, frame: Frame) -> CameraSpec:
    """Return a camera at the size of its images."""
    height, width = frame.rgb.shape[:2]
    K = camera.K.copy()
    K[0] *= width / camera.width
    K[1] *= height / camera.height
    return replace(camera, width=width, height=height, K=K)

"""``--policy alpasim://HOST:PORT``: any AlpaSim driver drives, called in exactly the order of
AlpaSim's runtime.

    start_session; then at each query submit_image_observation (one a camera),
    submit_egomotion_observation, submit_route, drive; at the end the last frames, and
    close_session.

The first egomotion message carries the whole recorded context, with true speeds, where AlpaSim's
own runtime sends zeros until it hands over.
"""

import itertools
import os
import re
import time
import uuid
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from alpasim_plugin.alpasim.client.channel import Address, Service, encoding_of
from alpasim_plugin.core.errors import InputError, PolicyError
from alpasim_plugin.core.geometry import interpolate, inverse, se3, wrap_angle, yaw_of
from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.plan_check import clock_problem
from alpasim_plugin.core.types import (
    F64,
    I64,
    CameraSpec,
    EgoState,
    Frame,
    Observation,
    Plan,
    Route,
    Scenario,
    SensorSpec,
    Trajectory,
)
from alpasim_plugin.log.images import ImageEncoding, encode_image
from alpasim_plugin.log.schema import (
    read_trajectory,
    wire_camera,
    wire_dynamics,
    wire_image,
    wire_trajectory,
)
from alpasim_plugin.log.wire import FRONT_WIDE, common_pb2, egodriver_pb2
from alpasim_plugin.log.wire.services import MESSAGE_BYTES

OPTIONS = ("cameras", "encoding", "timeout_s")
ALL_CAMERAS = "all"  # in place of names
BUDGET_S = 0.1  # of a drive call, in AlpaSim's public challenge
HOLD_US = 5_000_000  # length of the straight plan that stands in for an empty answer in the warm-up
# An image of noise at the quality of `encode_image`, rounded up; PNG leaves it as it is.
MOST_BYTES_PER_PIXEL: Mapping[ImageEncoding, float] = {"png": 3.1, "jpeg": 2.5}
HEADER_BYTES = 1 << 20  # the rest of a message
# sessions of several rollouts of one scene and seed may be open at one driver
_SESSIONS = itertools.count()


class DriverPolicy(Policy):
    """A driver behind AlpaSim's EgodriverService.

    Args:
        scenario: Gives cameras, periods and the warm-up.
        place: Where it listens, with the options `OPTIONS`.
        main: Under which name the scenario's main camera is sent where no option ``cameras`` says
            it; None: its own.
    """

    is_remote = True

    def __init__(self, scenario: Scenario, place: Address, main: str | None) -> None:
        self._scenario = scenario
        self._cameras = cameras_sent(scenario, place.options, main)
        self.sensors: Sequence[SensorSpec] = tuple(
            SensorSpec(camera.name) for camera in self._cameras.values()
        )
        self._encoding = encoding_of(place.target, place.options.get("encoding", "jpeg"))
        self._timeout_s = float(place.options.get("timeout_s", "300"))
        self.service = Service("EgodriverService", place.target, PolicyError, retries=False)
        version = self.service.version()
        self._facts: dict[str, Any] = {"driver": f"{version.version_id} at {place.target}"}
        self._session = ""
        self._now_us: int | None = None

    def reset(self, seed: int, route: Route) -> None:
        """Open a session for a new rollout."""
        self._end_session()
        self._session = str(
            uuid.uuid5(
                uuid.NAMESPACE_URL,
                f"{self._scenario.scene_id}/{seed}/{os.getpid()}/{next(_SESSIONS)}",
            )
        )
        self._now_us = None
        self._sent_us, self._image_us = -1, dict.fromkeys(self._cameras, -1)
        self._facts |= {"empty_plans": 0, "shortest_plan_s": None, "samples_cut": 0, "calls": 0}
        self._facts |= {"drive_calls": 0, "drive_s": 0.0, "drive_longest_s": 0.0, "drive_late": 0}
        self._facts["drive_budget_s"] = BUDGET_S
        request = egodriver_pb2.DriveSessionRequest
        listed = [wire_camera(camera, name) for name, camera in self._cameras.items()]
        self._call(
            "start_session",
            request(
                session_uuid=self._session,
                random_seed=seed & 0xFFFFFFFF,
                debug_info=request.DebugInfo(scene_id=self._scenario.scene_id),
                rollout_spec=request.RolloutSpec(
                    vehicle=request.RolloutSpec.VehicleDefinition(available_cameras=listed)
                ),
            ),
        )

    def act(self, observation: Observation) -> Plan:
        """Send what is new and return the driver's plan.

        Raises:
            PolicyError: A call fails or takes too long, the driver ends the session, its answer is
                no plan, or empty after the warm-up.
            InfrastructureError: The connection is lost.
        """
        self.tell(observation)
        return self.ask(observation)

    def tell(self, observation: Observation) -> None:
        """Send what is new: images, the ego's motion and the route."""
        now = self._now_us = observation.t_us
        self._send_images(observation.frames)
        self._send_motion(observation)
        points = [common_pb2.Vec3(x=x, y=y, z=0.0) for x, y, _ in observation.route_rig.tolist()]
        route = egodriver_pb2.Route(waypoints=points, timestamp_us=now)
        self._call(
            "submit_route", egodriver_pb2.RouteRequest(session_uuid=self._session, route=route)
        )

    def ask(self, observation: Observation) -> Plan:
        """Return the driver's plan for an observation that it was told."""
        query = egodriver_pb2.DriveRequest(
            session_uuid=self._session,
            time_now_us=observation.t_us,
            time_query_us=observation.t_us + self._scenario.rates.control_us,
        )
        began = time.perf_counter()
        answer = self._call("drive", query)
        self._time_call(time.perf_counter() - began)
        return self._plan(answer, observation)

    def end(self, frames: Mapping[str, Frame]) -> None:
        """Send the last frames, which no query follows, as AlpaSim's runtime does, and close the
        session.
        """
        self._send_images(frames)
        self._end_session()

    def close(self) -> None:
        """Close the session, if one is open, and the channel."""
        try:
            self._end_session()
        finally:
            self.service.close()

    def _time_call(self, seconds: float) -> None:
        """Count a drive call among those that AlpaSim's challenge has a budget for."""
        self._facts["drive_calls"] += 1
        self._facts["drive_s"] = round(self._facts["drive_s"] + seconds, 6)
        self._facts["drive_longest_s"] = max(self._facts["drive_longest_s"], round(seconds, 6))
        self._facts["drive_late"] += seconds > BUDGET_S

    def _end_session(self) -> None:
        if self._session:
            session = self._session
            self._session = ""
            self._call(
                "close_session", egodriver_pb2.DriveSessionCloseRequest(session_uuid=session)
            )

    def facts(self) -> Mapping[str, Any]:
        """Return what the driver is and how its plans were, for the rollout's manifest."""
        return dict(self._facts)

    def _send_images(self, frames: Mapping[str, Frame]) -> None:
        for name, camera in self._cameras.items():
            frame = frames.get(camera.name)
            if frame is None or frame.t_us == self._image_us[name]:
                continue
            self._image_us[name] = frame.t_us
            data = encode_image(frame.rgb, self._encoding)
            message = wire_image(
                self._session, name, frame.t_us - camera.shutter_us, frame.t_us, data
            )
            self._call("submit_image_observation", message)

    def _send_motion(self, observation: Observation) -> None:
        """Send every pose since the last one sent, with its speeds."""
        history = observation.history
        states = [observation.ego]
        if len(history) > 1:
            poses = se3(history.xyz, history.quat)
            t_s = (history.t_us - history.t_us[0]) * 1e-6
            velocity = np.gradient(history.xyz, t_s, axis=0)
            speed = np.einsum("ti,ti->t", velocity, poses[:, :3, 0])
            yaw = np.unwrap([yaw_of(pose) for pose in poses])
            rate = np.gradient(yaw, t_s)
            accel = np.gradient(speed, t_s)
            rows = zip(history.t_us, poses, speed, accel, rate, strict=True)
            states = [
                EgoState(int(t), pose, float(v), float(a), float(w)) for t, pose, v, a, w in rows
            ]
            states[-1] = observation.ego
        first = int(np.searchsorted(history.t_us, self._sent_us, side="right"))
        new = Trajectory(history.t_us[first:], history.xyz[first:], history.quat[first:])
        self._sent_us = observation.t_us
        message = egodriver_pb2.RolloutEgoTrajectory(
            session_uuid=self._session,
            trajectory=wire_trajectory(new, "the ego's motion"),
            dynamic_states=[wire_dynamics(state) for state in states[first:]],
        )
        self._call("submit_egomotion_observation", message)

    def _plan(self, answer: egodriver_pb2.DriveResponse, observation: Observation) -> Plan:
        if answer.terminate_session:
            raise PolicyError(
                f"{self.service.target}: it ends the session",
                "see the driver's own log",
            )
        now = observation.t_us
        if not answer.trajectory.poses:
            self._facts["empty_plans"] += 1
            if now > self._scenario.start_us + self._scenario.warmup_us:
                raise PolicyError(
                    f"{self.service.target}: an empty plan after the warm-up",
                    "lengthen timing.warmup_us until the driver has the frames that it needs",
                )
            return straight_on(now, observation.ego.speed_mps)
        planned = self._read(answer.trajectory, "the driver's plan")
        problem = clock_problem(planned.t_us, now)
        if problem:
            raise PolicyError(
                f"{self.service.target}: {problem}", "send the times of the query's clock"
            )
        times, rows = in_rig(planned, observation)
        reach = (int(times[-1]) - now) * 1e-6
        shortest = self._facts["shortest_plan_s"]
        self._facts["shortest_plan_s"] = reach if shortest is None else min(shortest, reach)
        samples = []
        for message in answer.debug_info.sampled_trajectories:
            sample = self._read(message, "a sampled plan")
            if len(sample) and int(sample.t_us[-1]) >= int(times[-1]):
                samples.append(in_rig(sample, observation, times)[1])
            else:
                # a sample that ends before the plan has no place at the plan's last times
                self._facts["samples_cut"] += 1
        return Plan(now, times, rows[:, :2], rows[:, 2], tuple(samples))

    def _read(self, message: common_pb2.Trajectory, title: str) -> Trajectory:
        """Return what the driver sent; poses or times that are none are its failure."""
        try:
            return read_trajectory(message, title)
        except InputError as error:
            raise PolicyError(
                f"{self.service.target}: {error.message}",
                "send strictly increasing times, finite positions and unit quaternions",
            ) from error

    def _call(self, method: str, request: Any) -> Any:
        self._facts["calls"] = self._facts.get("calls", 0) + 1
        return self.service.call(method, request, self._timeout_s, self._now_us)


class AlpasimPolicy(DriverPolicy):
    """``alpasim://HOST:PORT[?cameras=THEIRS:OURS,...&encoding=jpeg|png&timeout_s=N]``: a driver
    that runs already.

    Without ``cameras`` the scenario's main camera is sent under AlpaSim's name for it.
    """

    def __init__(self, scenario: Scenario, address: str) -> None:
        super().__init__(scenario, Address.parse("alpasim", address, OPTIONS), FRONT_WIDE)

    @staticmethod
    def check_scenario(scenario: Scenario, address: str) -> None:
        """Refuse a scenario whose images cannot be sent, before a run begins."""
        cameras_sent(scenario, Address.parse("alpasim", address, OPTIONS).options, FRONT_WIDE)

    @staticmethod
    def check_address(address: str) -> None:
        """Refuse what is no address, before a run begins."""
        place = Address.parse("alpasim", address, OPTIONS)
        timeout = place.options.get("timeout_s", "300")
        if not re.fullmatch(r"[0-9]+(\.[0-9]+)?", timeout):
            raise InputError(
                f"alpasim://{address}: timeout_s={timeout!r}", "write seconds as a number"
            )


def cameras_sent(
    scenario: Scenario, options: Mapping[str, str], main: str | None, encoding: str = "jpeg"
) -> dict[str, CameraSpec]:
    """Return the cameras whose images are sent to a driver, by its names for them.

    Args:
        scenario: Has the cameras.
        options: ``cameras`` and ``encoding``, as an address has them.
        main: See `cameras_of`.
        encoding: Where the options name none.

    Raises:
        InputError: As `cameras_of`, an encoding that the wire has not, or an image that may not fit
            into a message.
    """
    cameras = cameras_of(scenario, options.get("cameras"), main)
    text = options.get("encoding", encoding)
    require_room(cameras.values(), encoding_of(f"scene {scenario.scene_id!r}", text))
    return cameras


def cameras_of(
    scenario: Scenario, text: str | None, main_name: str | None = FRONT_WIDE
) -> dict[str, CameraSpec]:
    """Return the scenario's cameras to send, by the driver's names for them.

    Args:
        scenario: Has the cameras.
        text: ``THEIRS:OURS,...``, or ``OURS,...`` where the names are the same; ``all``: every
            camera by its own name; None: the main camera alone.
        main_name: What that is called; None: by its own name.

    Raises:
        InputError: The scenario lacks a camera that is named, or has none.
    """
    cameras_by_name = {camera.name: camera for camera in scenario.cameras}
    main = next(
        (name for name in (FRONT_WIDE, "front") if name in cameras_by_name),
        next(iter(cameras_by_name), ""),
    )
    if text is None:
        pairs = [(main_name or main, main)]
    elif text == ALL_CAMERAS:
        pairs = [(name, name) for name in cameras_by_name]
    else:
        pairs = [(a, b or a) for a, _, b in (part.partition(":") for part in text.split(","))]
    missing = [camera for _, camera in pairs if camera not in cameras_by_name]
    if missing or not pairs:
        problem = (
            f"no camera {missing[0]!r} among {sorted(cameras_by_name)}" if missing else "no camera"
        )
        raise InputError(
            f"scene {scenario.scene_id!r}: {problem}",
            f"write ?cameras=THEIRS:OURS,..., or ?cameras={ALL_CAMERAS}",
        )
    return {name: cameras_by_name[camera] for name, camera in pairs}


def require_room(cameras: Iterable[CameraSpec], encoding: ImageEncoding) -> None:
    """Refuse cameras whose images may not fit into a message.

    Raises:
        InputError: Naming the first.
    """
    for camera in cameras:
        most_bytes = MOST_BYTES_PER_PIXEL[encoding] * camera.width * camera.height
        if most_bytes > MESSAGE_BYTES - HEADER_BYTES:
            smaller = "write ?encoding=jpeg, or use" if encoding == "png" else "use"
            raise InputError(
                f"camera {camera.name!r}: {camera.width}x{camera.height} pixels as {encoding} may "
                f"take {most_bytes / 2**20:.0f} MiB, more than a message's {MESSAGE_BYTES >> 20}",
                f"{smaller} a smaller camera",
            )


def in_rig(plan: Trajectory, observation: Observation, times: I64 | None = None) -> tuple[I64, F64]:
    """Return times ``(T,)`` and rows x, y, yaw ``(T, 3)`` in the rig frame of a plan with absolute
    poses.

    Args:
        plan: What the driver sent; poses before now are left out, and the present pose comes first
            where it has none.
        observation: Of the query.
        times: At these times, instead of the plan's own.
    """
    now = observation.t_us
    later = plan.t_us[plan.t_us > now]
    wanted: I64 = np.concatenate([[now], later]).astype(np.int64) if times is None else times
    poses = np.empty((len(wanted), 4, 4))
    inside = (wanted >= plan.t_us[0]) & (wanted <= plan.t_us[-1])
    if inside.any():
        poses[inside] = interpolate(plan, wanted[inside])
    poses[~inside] = observation.ego.T_world_rig
    local = inverse(observation.ego.T_world_rig) @ poses
    return wanted, np.column_stack(
        [local[:, :2, 3], wrap_angle(np.array([yaw_of(pose) for pose in local]))]
    )


def straight_on(now_us: int, speed_mps: float) -> Plan:
    """Return a plan straight on at the present speed, for the warm-up, in which it is not
    driven.
    """
    times = now_us + np.arange(0, HOLD_US + 1, 100_000, dtype=np.int64)
    xy = np.column_stack([speed_mps * (times - now_us) * 1e-6, np.zeros(len(times))])
    return Plan(now_us, times, xy, np.zeros(len(times)), debug={"empty": True})

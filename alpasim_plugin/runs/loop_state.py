"""The state of one rollout between ticks: the ego and its history, the active plan, and a forecast
from it.

Predicted poses of cameras and road users are for `RenderRequest.ahead`. The controller moves the
predicted ego along the active plan and along plans that become active after their latency. During
the warm-up the prediction is the log itself. A forecast queries no policy and leaves the state of
the loop unchanged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from alpasim_plugin.cameras.shutter import rolling_exposure
from alpasim_plugin.control import Controller
from alpasim_plugin.core.geometry import (
    interpolate,
    quat_from_matrix,
    quat_from_yaw,
    wrap_angle,
    yaw_of,
)
from alpasim_plugin.core.recorded_state import ego_state_from_log
from alpasim_plugin.core.types import (
    F64,
    I64,
    STANDING_ID,
    CameraSpec,
    EgoState,
    Frame,
    Latency,
    Observation,
    Plan,
    RenderRequest,
    Scenario,
    SensorSpec,
    Trajectory,
    read_only,
)
from alpasim_plugin.world.actors import ActorForecast, Actors
from alpasim_plugin.world.ground import ground_pose
from alpasim_plugin.world.route import RouteAhead, from_offset


def visible_actors(actors: Mapping[str, F64]) -> Mapping[str, F64]:
    """Return the poses of the actors that are drawn, as views that cannot be written: what stands
    in a reconstruction is in its images already.
    """
    return read_only_poses(
        {name: T for name, T in actors.items() if not name.startswith(STANDING_ID)}
    )


def read_only_poses(actors: Mapping[str, F64]) -> Mapping[str, F64]:
    """Return poses as views that cannot be written."""
    poses = {name: T.view() for name, T in actors.items()}
    for T in poses.values():
        T.flags.writeable = False
    return poses


@dataclass
class PlanQueue:
    """Plans in order of the time they become effective.

    ``none`` applies a plan at its query, ``fixed`` after a constant delay, ``measured`` after the
    wall time of the query. With ``measured`` a run depends on the machine and is not repeatable;
    run.json records this.

    With ``latency.fixer`` the fixer is a queue of its own: the frames of an instant are done after
    those before them, so a fixer slower than the camera falls behind, and a query waits until its
    frames are done.
    """

    latency: Latency
    _pending: list[tuple[int, Trajectory]] = field(default_factory=list)
    _active: Trajectory | None = None
    _fixed_us: int = 0  # when the fixer is done with all frames so far

    def frames(self, t_us: int, stage_ms: Mapping[str, float]) -> None:
        """Take the wall time, by stage, that the fixer needed for the frames of ``t_us``."""
        if self.latency.fixer:
            self._fixed_us = max(self._fixed_us, t_us) + int(1e3 * sum(stage_ms.values()))

    def submit(self, plan_world: Trajectory, query_us: int, wall_us: int) -> None:
        """Add the plan of the query at ``query_us``, which took ``wall_us`` of wall time."""
        measured_us = max(self._fixed_us - query_us, 0) + wall_us
        delay = {"none": 0, "fixed": self.latency.fixed_us, "measured": measured_us}[
            self.latency.kind
        ]
        self._pending.append((query_us + delay, plan_world))

    def copy(self) -> PlanQueue:
        """Return an independent copy."""
        return replace(self, _pending=list(self._pending))

    def active(self, t_us: int) -> Trajectory | None:
        """Return the active plan at ``t_us``: among those due, that of the newest query. None
        before the first.
        """
        while self._pending and self._pending[0][0] <= t_us:
            self._active = self._pending.pop(0)[1]
        # A later, faster query overtakes an earlier, slower one.
        overtaking = [i for i, (due, _) in enumerate(self._pending) if due <= t_us]
        if overtaking:
            self._active = self._pending[overtaking[-1]][1]
            del self._pending[: overtaking[-1] + 1]
        return self._active


@dataclass
class LoopState:
    """The ego's true state, its history, and the newest frame of each camera.

    The history is stored in arrays allocated once for the whole rollout: an observation is a view
    of them, not a copy.
    """

    scenario: Scenario
    ego: EgoState
    _t_us: I64
    _xyz: F64
    _quat: F64
    _route_ahead: RouteAhead
    _filled: int = 0
    frames: dict[str, Frame] = field(default_factory=dict)

    @classmethod
    def at_start(cls, scenario: Scenario, n_steps: int) -> LoopState:
        """Return the state at the first frame; the history begins with the recorded context before
        it.
        """
        log = scenario.ego_log
        context = int(np.searchsorted(log.t_us, scenario.start_us))
        size = context + n_steps + 1
        route_ahead = RouteAhead(scenario.route)
        for pose in interpolate(log, log.t_us[:context]):
            route_ahead.follow(pose)
        state = cls(
            scenario,
            ego_state_from_log(log, scenario.start_us, scenario.vehicle),
            np.concatenate([log.t_us[:context], np.zeros(size - context, dtype=np.int64)]),
            np.concatenate([log.xyz[:context], np.zeros((size - context, 3))]),
            np.concatenate([log.quat[:context], np.zeros((size - context, 4))]),
            route_ahead,
            context,
        )
        state._append_pose()
        return state

    @property
    def history(self) -> Trajectory:
        """Give the rig poses up to now, the newest last."""
        n = self._filled
        return Trajectory(self._t_us[:n], self._xyz[:n], self._quat[:n])

    def observe(
        self,
        cameras: Mapping[str, CameraSpec],
        sensors: Sequence[SensorSpec] = (),
        road_users: Mapping[str, F64] | None = None,
    ) -> Observation:
        """Return the policy's observation at the present instant. Its arrays cannot be written,
        since the world, the fixer's history and the log hold the same ones; its tensors are copies.
        """
        tensors = [
            sensor.camera for sensor in sensors if sensor.device and sensor.camera in self.frames
        ]
        return Observation(
            self.ego.t_us,
            {name: read_only(frame) for name, frame in self.frames.items()},
            dict(cameras),
            read_only(self.ego),
            read_only(self.history),
            from_offset(
                self._route_ahead.in_rig(self.ego.T_world_rig), self.scenario.route_offset_m
            ),
            {name: self.frames[name].image() for name in tensors},
            None if road_users is None else read_only_poses(road_users),
        )

    def to_world(self, plan: Plan) -> list[Trajectory]:
        """Map a plan and its samples from the present rig frame to world poses.

        Plans are planar, so only the rig's heading rotates them.
        """
        yaw0 = yaw_of(self.ego.T_world_rig)
        origin = self.ego.T_world_rig[:3, 3]
        c = np.cos(yaw0)
        s = np.sin(yaw0)
        turn = np.array([[c, s], [-s, c]])

        all_xy = [plan.xy, *(sample[:, :2] for sample in plan.samples)]
        all_yaw = [plan.yaw, *(sample[:, 2] for sample in plan.samples)]
        xyz = np.full((len(all_xy), len(plan.times_us), 3), origin[2])
        for row, xy in zip(xyz, all_xy, strict=True):
            row[:, :2] = xy @ turn + origin[:2]
        return [
            Trajectory(plan.times_us, *pose)
            for pose in zip(xyz, quat_from_yaw(wrap_angle(np.stack(all_yaw) + yaw0)), strict=True)
        ]

    def advance(self, controller: Controller, plan: Trajectory | None, to_us: int) -> bool:
        """Move the ego to ``to_us``: along the log in the warm-up, then by the vehicle model,
        projected onto the ground.

        Returns:
            Whether the log was forced.
        """
        self.ego, forced = advance_ego(self.scenario, controller, self.ego, plan, to_us)
        self._append_pose()
        return forced

    def _append_pose(self) -> None:
        n = self._filled
        self._t_us[n] = self.ego.t_us
        self._xyz[n] = self.ego.T_world_rig[:3, 3]
        self._quat[n] = quat_from_matrix(self.ego.T_world_rig[:3, :3])
        self._filled = n + 1


def advance_ego(
    scenario: Scenario, controller: Controller, ego: EgoState, plan: Trajectory | None, to_us: int
) -> tuple[EgoState, bool]:
    """Return the ego at ``to_us`` and whether the log was forced, as it is until the end of the
    warm-up.
    """
    if to_us <= scenario.start_us + scenario.warmup_us:
        return ego_state_from_log(scenario.ego_log, to_us, scenario.vehicle), True
    moved = controller.advance(ego, plan, to_us)
    if controller.grounds:
        return moved, False
    x = float(moved.T_world_rig[0, 3])
    y = float(moved.T_world_rig[1, 3])
    return replace(
        moved, T_world_rig=ground_pose(scenario.ground, x, y, yaw_of(moved.T_world_rig))
    ), False


def shutter_poses(history: Trajectory, camera: CameraSpec, t_us: int) -> F64:
    """Return ``T_world_camera`` ``(2, 4, 4)`` at shutter start and end, from rig poses of which the
    last is at ``t_us``.
    """
    start_us = max(t_us - camera.shutter_us, int(history.t_us[0]))
    return interpolate(history, np.array([start_us, t_us])) @ camera.T_rig_camera


class Forecaster:
    """Makes forecasts of a running loop."""

    def __init__(
        self,
        scenario: Scenario,
        controller: Controller,
        plans: PlanQueue,
        actors: Actors,
        state: LoopState,
    ) -> None:
        self._parts = scenario, controller, plans, actors, state

    def now(self) -> Forecast:
        """Return the forecast from the present instant. It is computed when read."""
        scenario, controller, plans, actors, state = self._parts
        return Forecast(
            scenario, controller, plans.copy(), actors.forecast(), state.history, state.ego
        )


@dataclass
class Forecast:
    """A forecast from one instant, computed as far as it is read."""

    scenario: Scenario
    controller: Controller
    plans: PlanQueue
    actors: ActorForecast
    history: Trajectory  # rig poses up to the instant, then predicted ones
    ego: EgoState  # at the end of the history

    def request(self, camera: CameraSpec, t_us: int) -> RenderRequest:
        """Return the predicted render request at a future control instant."""
        self._extend(t_us)
        upto = int(np.searchsorted(self.history.t_us, t_us, side="right"))
        past = Trajectory(
            self.history.t_us[:upto], self.history.xyz[:upto], self.history.quat[:upto]
        )
        period_us = self.scenario.rates.control_us
        actor_poses = visible_actors(self.actors.at(t_us))
        before = visible_actors(self.actors.at(t_us - period_us)) if camera.shutter_us else {}
        exposure = rolling_exposure(camera, before, actor_poses, period_us)
        T_world_camera = shutter_poses(past, camera, t_us)
        return RenderRequest(t_us, camera, T_world_camera, actor_poses, exposure=exposure)

    def _extend(self, to_us: int) -> None:
        states = []
        while self.ego.t_us < to_us:
            next_us = self.ego.t_us + self.scenario.rates.control_us
            self.ego, _ = advance_ego(
                self.scenario, self.controller, self.ego, self.plans.active(self.ego.t_us), next_us
            )
            states.append(self.ego)
        if states:
            past = self.history
            poses = np.stack([state.T_world_rig for state in states])
            self.history = Trajectory(
                np.concatenate(
                    [past.t_us, np.array([state.t_us for state in states], dtype=np.int64)]
                ),
                np.concatenate([past.xyz, poses[:, :3, 3]]),
                np.concatenate([past.quat, quat_from_matrix(poses[:, :3, :3])]),
            )


@dataclass
class PredictedRequests(Sequence[RenderRequest]):
    """The predicted next requests of one camera, computed when read."""

    forecast: Forecast
    camera: CameraSpec
    times_us: tuple[int, ...]
    _made: dict[int, RenderRequest] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.times_us)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        t_us = self.times_us[index]
        if t_us not in self._made:
            self._made[t_us] = self.forecast.request(self.camera, t_us)
        return self._made[t_us]

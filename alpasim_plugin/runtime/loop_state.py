"""The state of one rollout between ticks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from alpasim_plugin.control import Controller
from alpasim_plugin.core.geometry import quat_from_matrix, quat_from_yaw, wrap_angle, yaw_of
from alpasim_plugin.core.types import F64, I64, CameraSpec, EgoState, Frame, Observation, Plan, Scenario, Trajectory
from alpasim_plugin.world.ego import ego_state_from_log
from alpasim_plugin.world.ground import ground_pose
from alpasim_plugin.world.route import route_in_rig


@dataclass
class LoopState:
    """The ego's true state, its history, and the newest frame of each camera.

    The history is stored in arrays allocated once for the whole rollout: an observation is a view of them, not a copy.
    """

    scenario: Scenario
    ego: EgoState
    _t_us: I64
    _xyz: F64
    _quat: F64
    _filled: int = 0
    frames: dict[str, Frame] = field(default_factory=dict)

    @classmethod
    def at_start(cls, scenario: Scenario, n_steps: int) -> LoopState:
        """Return the state at the first frame; the history begins with the recorded context before it."""
        log = scenario.ego_log
        context = int(np.searchsorted(log.t_us, scenario.start_us))
        size = context + n_steps + 1
        state = cls(
            scenario,
            ego_state_from_log(log, scenario.start_us, scenario.vehicle),
            np.concatenate([log.t_us[:context], np.zeros(size - context, dtype=np.int64)]),
            np.concatenate([log.xyz[:context], np.zeros((size - context, 3))]),
            np.concatenate([log.quat[:context], np.zeros((size - context, 4))]),
            context,
        )
        state._append_pose()
        return state

    @property
    def history(self) -> Trajectory:
        """Give the rig poses up to now, the newest last."""
        n = self._filled
        return Trajectory(self._t_us[:n], self._xyz[:n], self._quat[:n])

    def observe(self, cameras: Mapping[str, CameraSpec]) -> Observation:
        """Return the policy's observation at the present instant."""
        route = route_in_rig(self.scenario.route, self.ego.T_world_rig)
        return Observation(self.ego.t_us, dict(self.frames), cameras, self.ego, self.history, route)

    def to_world(self, plan: Plan) -> list[Trajectory]:
        """Map a plan and its samples from the present rig frame to world poses.

        Plans are planar, so only the rig's heading rotates them.
        """
        yaw0, origin = yaw_of(self.ego.T_world_rig), self.ego.T_world_rig[:3, 3]
        c, s = np.cos(yaw0), np.sin(yaw0)
        turn = np.array([[c, s], [-s, c]])

        def place(xy: F64, yaw: F64) -> Trajectory:
            xyz = np.column_stack([xy @ turn + origin[:2], np.full(len(xy), origin[2])])
            return Trajectory(plan.times_us, xyz, quat_from_yaw(wrap_angle(yaw + yaw0)))

        return [place(plan.xy, plan.yaw), *(place(sample[:, :2], sample[:, 2]) for sample in plan.samples)]

    def advance(self, controller: Controller, plan: Trajectory | None, to_us: int) -> bool:
        """Move the ego to ``to_us``: along the log in the warm-up, then by the vehicle model, projected onto the ground.

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


def advance_ego(scenario: Scenario, controller: Controller, ego: EgoState, plan: Trajectory | None, to_us: int) -> tuple[EgoState, bool]:
    """Return the ego at ``to_us`` and whether the log was forced, as it is until the end of the warm-up."""
    if to_us <= scenario.start_us + scenario.warmup_us:
        return ego_state_from_log(scenario.ego_log, to_us, scenario.vehicle), True
    moved = controller.advance(ego, plan, to_us)
    if controller.grounds:
        return moved, False
    x, y = float(moved.T_world_rig[0, 3]), float(moved.T_world_rig[1, 3])
    return replace(moved, T_world_rig=ground_pose(scenario.ground, x, y, yaw_of(moved.T_world_rig))), False

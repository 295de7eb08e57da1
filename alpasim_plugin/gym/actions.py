"""What an action means: steering and pedal, held for a period, or a trajectory that the controller follows."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace

import numpy as np
from gymnasium.spaces import Box

from alpasim_plugin.control import make_controller
from alpasim_plugin.control.base import check_interval, planar, spatial
from alpasim_plugin.control.bicycle import Command, step
from alpasim_plugin.core.types import F64, EgoState, Observation, Plan, Trajectory, Vehicle
from alpasim_plugin.plugins.interfaces import Controller

PREDICTED_US, PREDICTED_STEP_US = 2_000_000, 100_000  # of the plan that stands in the log for a held command
FORWARD_M, BACKWARD_M, ASIDE_M = 200.0, 50.0, 100.0  # bounds of a trajectory, rig frame


class Actions(ABC):
    """One way to act.

    Attributes:
        space: Of the actions.
        controller: Moves the ego.
    """

    space: Box
    controller: Controller

    @abstractmethod
    def plan(self, action: F64, observation: Observation) -> Plan:
        """Return the plan that an action stands for."""


class Controls(Actions):
    """``(2,)`` in -1..1: steering angle of the wheels as a share of the vehicle's limit, left positive; throttle above 0, brake below.

    The vehicle's own limits apply, its steering rate too. The brake ends at a standstill.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self.space = Box(-1.0, 1.0, (2,), np.float32)
        self.controller: HeldCommand = HeldCommand(vehicle)
        self._vehicle = vehicle

    def plan(self, action: F64, observation: Observation) -> Plan:
        """Hold the command, and return where it leads in two seconds."""
        steer, pedal = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        drive, brake = max(pedal, 0.0) * self._vehicle.max_accel_mps2, max(-pedal, 0.0) * self._vehicle.max_brake_mps2
        self.controller.command = Command(float(steer) * self._vehicle.max_steer_rad, float(drive), float(brake))
        times = observation.t_us + np.arange(0, PREDICTED_US + 1, PREDICTED_STEP_US, dtype=np.int64)
        step_s = PREDICTED_STEP_US * 1e-6
        state = replace(planar(observation.ego), x_m=0.0, y_m=0.0, yaw_rad=0.0)
        states = [state]
        for _ in times[1:]:
            states.append(step(states[-1], self.controller.command, step_s, self._vehicle, step_s))
        rows = np.array([(one.x_m, one.y_m, one.yaw_rad) for one in states])
        return Plan(observation.t_us, times, rows[:, :2], rows[:, 2])


class HeldCommand(Controller):
    """A kinematic bicycle under a command that its owner holds; it follows no plan."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self.command = Command(0.0)

    def advance(self, state: EgoState, plan: Trajectory | None, to_us: int) -> EgoState:
        """Return the state at ``to_us``; see `Controller.advance`."""
        dt_s = check_interval(state, to_us)
        after = step(planar(state), self.command, dt_s, self._vehicle)
        z_m, accel = float(state.T_world_rig[2, 3]), (after.speed_mps - state.speed_mps) / dt_s
        return spatial(after, to_us, z_m, accel, self._vehicle)


class Trajectories(Actions):
    """``(T, 3)``: x, y (metres) and yaw (radians) in the rig frame, at equal steps after now, the first step ahead.

    The tracking controller of runs follows it, as it follows a policy's plan.
    """

    def __init__(self, vehicle: Vehicle, horizon_us: int, step_us: int) -> None:
        n = horizon_us // step_us
        low = np.tile([-BACKWARD_M, -ASIDE_M, -np.pi], (n, 1))
        high = np.tile([FORWARD_M, ASIDE_M, np.pi], (n, 1))
        self.space = Box(low, high, dtype=np.float64)
        self.controller = make_controller("bicycle", vehicle)
        self._after_us = step_us * np.arange(n + 1, dtype=np.int64)

    def plan(self, action: F64, observation: Observation) -> Plan:
        """Return the action as a plan, which begins at the ego."""
        rows = np.vstack([np.zeros(3), np.asarray(action, np.float64)])
        return Plan(observation.t_us, observation.t_us + self._after_us, rows[:, :2], rows[:, 2])

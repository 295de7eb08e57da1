"""``--policy can://CHANNEL``: a control unit on a CAN bus drives the ego with steering wheel and
acceleration commands.

Between two queries the vehicle is simulated here at the bus's own rate: its messages go out, the
unit's commands come in, and a kinematic bicycle moves on by one bus period. The plan is that
motion, continued under the last commands, and the ego follows it exactly.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from alpasim_plugin.control.bicycle import BicycleState, Command, step
from alpasim_plugin.control.can_bus import Address, Commands, Exchange, OwnChannel, open_bus
from alpasim_plugin.control.can_codec import load_map, open_codec
from alpasim_plugin.core.geometry import direction_of, left_of, yaw_of
from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.types import (
    F64,
    EgoState,
    Frame,
    Observation,
    Plan,
    Route,
    Scenario,
    SensorSpec,
    Vehicle,
)

PLAN_US = 5_000_000
PLAN_STEP_US = 100_000
TRACK_M = 1.6  # between the wheels of an axle
SAME_M = 1e-3  # the ego is where the last plan put it
PATH_REACH_M = 40.0  # of the route ahead that is sent
STRAIGHT_M = 2.0  # a shorter route ahead is no path


class CanPolicy(Policy):
    """A control unit on a CAN bus. It has no camera; what it sees is on the bus.

    Args:
        scenario: Gives the vehicle and the period of queries.
        address: What stands after ``can://``; see `can_bus.Address`.
    """

    sensors: Sequence[SensorSpec] = ()
    controller = "perfect"
    is_remote = True

    def __init__(self, scenario: Scenario, address: str) -> None:
        self._vehicle = scenario.vehicle
        self._period_us = scenario.rates.policy_us
        self._address = Address.parse(address)
        can_map, database = load_map(self._address.map, self._address.dbc)
        self._ratio = can_map.steering_ratio
        self._codec = open_codec(can_map, database)
        self._bus = open_bus(self._address, self._codec)
        self._channel = OwnChannel(self._address.bus)
        self._begin()

    def _begin(self) -> None:
        self._exchange = Exchange(self._bus, self._codec, self._address.timeout_s)
        self._commands = Commands(0.0, 0.0, "held")
        self._predicted: tuple[int, BicycleState] | None = None
        self._steer_rate = self._accel = 0.0

    @classmethod
    def check_address(cls, address: str) -> None:
        """Refuse an address, a map or a database that cannot be driven with, before anything runs.

        Raises:
            InputError: As `Address.parse`, `load_map` and `open_codec`.
        """
        parsed = Address.parse(address)
        open_codec(*load_map(parsed.map, parsed.dbc))

    @staticmethod
    def channel_of(address: str) -> str:
        """Return what a rollout has for itself: the bus of an address."""
        return Address.parse(address).bus

    @classmethod
    def address_notes(cls, address: str) -> tuple[str, ...]:
        """Return what is not read of the database that an address names."""
        parsed = Address.parse(address)
        return open_codec(*load_map(parsed.map, parsed.dbc)).notes

    def reset(self, seed: int, route: Route) -> None:
        """Start a new rollout on the same bus: counts, commands and motion begin anew, and frames
        of before are forgotten.

        Raises:
            InfrastructureError: Another rollout has the channel.
        """
        self._channel.take()
        self._begin()
        self._exchange.forget()

    def act(self, observation: Observation) -> Plan:
        """Run the bus until the next query and return the motion that its commands make.

        Raises:
            PolicyError: The bus refuses to send.
            InfrastructureError: The control unit sends nothing at all.
        """
        now = observation.t_us
        states = [self._start(observation)]
        path = observation.route_rig[np.isfinite(observation.route_rig).all(axis=1)]
        until_us = now + self._period_us
        instants = self._exchange.instants(now, until_us)
        times = [now]
        for t_us, next_us in pairwise([*dict.fromkeys((now, *instants)), until_us]):
            if t_us in instants:
                self._commands = self._exchange.step(t_us, self._quantities(states[-1], path))
            before = states[-1]
            states.append(self._moved(before, next_us - t_us))
            times.append(next_us)
            self._steer_rate = (states[-1].steer_rad - before.steer_rad) / ((next_us - t_us) * 1e-6)
            self._accel = (states[-1].speed_mps - before.speed_mps) / ((next_us - t_us) * 1e-6)
        self._predicted = until_us, _in_world(states[-1], observation.ego)
        while times[-1] < now + PLAN_US:
            states.append(self._moved(states[-1], PLAN_STEP_US))
            times.append(times[-1] + PLAN_STEP_US)
        xy = np.array([[s.x_m, s.y_m] for s in states])
        return Plan(
            now,
            np.array(times),
            xy,
            np.array([s.yaw_rad for s in states]),
            debug={"mark": self._commands.mark},
        )

    def end(self, frames: Mapping[str, Frame]) -> None:
        """Wait for what the unit still owes, and let other rollouts use the channel.

        Raises:
            InfrastructureError: The control unit has sent nothing at all.
        """
        try:
            self._exchange.finish()
        finally:
            self._channel.release()

    def close(self) -> None:
        """Close the bus."""
        self._channel.release()
        self._bus.shutdown()

    def facts(self) -> Mapping[str, Any]:
        """Return what happened on the bus, for the rollout's manifest."""
        return {
            "notes": list(self._codec.notes),
            "bus": self._address.bus,
            **self._exchange.facts(),
        }

    def _start(self, observation: Observation) -> BicycleState:
        """Return the state now, in the rig frame.

        A plan says poses only, so speed and wheel angle at the end of the last one are remembered
        here, and used where the ego is on it.
        """
        ego = observation.ego
        if self._predicted is not None and self._predicted[0] == ego.t_us:
            state = self._predicted[1]
            xy = ego.T_world_rig[:2, 3]
            if np.hypot(state.x_m - xy[0], state.y_m - xy[1]) < SAME_M:
                return BicycleState(0.0, 0.0, 0.0, state.speed_mps, state.steer_rad)
        self._steer_rate = 0.0
        self._accel = ego.accel_mps2
        return BicycleState(0.0, 0.0, 0.0, ego.speed_mps, _steer_of(ego, self._vehicle))

    def _quantities(self, state: BicycleState, path: F64) -> dict[str, float]:
        return quantities(state, self._steer_rate, self._accel, path, self._ratio, self._vehicle)

    def _moved(self, state: BicycleState, duration_us: int) -> BicycleState:
        """Return the state after a time under the commands that hold."""
        commands = self._commands
        steer = float(np.deg2rad(commands.wheel_deg)) / self._ratio
        command = Command(steer, max(commands.accel_mps2, 0.0), max(-commands.accel_mps2, 0.0))
        return step(state, command, duration_us * 1e-6, self._vehicle)


def _in_world(state: BicycleState, ego: EgoState) -> BicycleState:
    """Return a state of the rig's plane in the world, by the ego's heading alone: as the loop lays
    plans on the ground, whatever its slope (`LoopState.to_world`).
    """
    yaw_rad = yaw_of(ego.T_world_rig)
    ahead = direction_of(np.array(yaw_rad))
    xy = ego.T_world_rig[:2, 3] + state.x_m * ahead + state.y_m * left_of(ahead)
    return BicycleState(
        float(xy[0]), float(xy[1]), state.yaw_rad + yaw_rad, state.speed_mps, state.steer_rad
    )


def quantities(
    state: BicycleState, steer_rate: float, accel: float, path: F64, ratio: float, vehicle: Vehicle
) -> dict[str, float]:
    """Return what the bus can carry about a motion: by the names of `can_map.Quantity`.

    Args:
        state: In the rig frame of the last query.
        steer_rate: Of the road wheels, rad/s.
        accel: Along the body, m/s^2.
        path: ``(N, 3)`` route ahead in that frame.
        ratio: Steering wheel angle over road-wheel angle.
        vehicle: The ego.
    """
    yaw_rate = state.speed_mps * float(np.tan(state.steer_rad)) / vehicle.wheelbase_m
    # Rear wheels roll on circles around the turning centre; the front ones are farther from it.
    rear = {
        "l": state.speed_mps - yaw_rate * TRACK_M / 2,
        "r": state.speed_mps + yaw_rate * TRACK_M / 2,
    }
    front = {
        side: float(np.copysign(np.hypot(v, yaw_rate * vehicle.wheelbase_m), state.speed_mps))
        for side, v in rear.items()
    }
    wheels = {
        f"wheel_{axle}{side}_kph": v * 3.6
        for axle, two in (("f", front), ("r", rear))
        for side, v in two.items()
    }
    offset, heading, curvature, rate, length = path_cubic(path, state)
    return wheels | {
        "speed_mps": state.speed_mps,
        "speed_kph": state.speed_mps * 3.6,
        "accel_mps2": accel,
        "lateral_accel_mps2": state.speed_mps * yaw_rate,
        "yaw_rate_degps": float(np.rad2deg(yaw_rate)),
        "steering_wheel_deg": float(np.rad2deg(state.steer_rad)) * ratio,
        "steering_wheel_rate_degps": float(np.rad2deg(steer_rate)) * ratio,
        "path_offset_m": offset,
        "path_heading_rad": heading,
        "path_curvature_1pm": curvature,
        "path_curvature_rate_1pm2": rate,
        "path_length_m": length,
    }


def path_cubic(path: F64, state: BicycleState) -> tuple[float, float, float, float, float]:
    """Return offset (m), heading (rad), curvature (1/m), its rate (1/m^2) and reach (m) of the
    route ahead, seen from the vehicle.

    A lane camera's usual form: y(x) = offset + heading x + curvature x^2 / 2 + rate x^3 / 6. All
    are 0 where there is no route ahead.
    """
    cos = np.cos(state.yaw_rad)
    sin = np.sin(state.yaw_rad)
    away = path[:, :2] - np.array([state.x_m, state.y_m])
    xy = away @ np.array([[cos, -sin], [sin, cos]])
    xy = xy[(xy[:, 0] > -5.0) & (xy[:, 0] < PATH_REACH_M)]
    reach = float(xy[-1, 0]) if len(xy) else 0.0
    if len(xy) < 4 or reach < STRAIGHT_M:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    c = np.polynomial.polynomial.polyfit(xy[:, 0], xy[:, 1], 3)
    return float(c[0]), float(c[1]), float(2 * c[2]), float(6 * c[3]), reach


def _steer_of(ego: EgoState, vehicle: Vehicle) -> float:
    if abs(ego.speed_mps) < 0.5:
        return ego.steer_rad
    return float(np.arctan(vehicle.wheelbase_m * ego.yaw_rate_radps / ego.speed_mps))

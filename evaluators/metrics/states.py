"""What the scores of other benchmarks read of a drive: states of the ego and boxes of the others,
on one line of time.

A log holds poses. Velocity is their central difference, acceleration its difference, both in the
axes of the vehicle; whoever has measured ones gives them instead.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.polynomial import polynomial

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.geometry import in_axes, inverse, offset_trajectory, yaw_from_quat
from alpasim_plugin.core.types import F64, I64, Bool, RolloutLog, Trajectory
from evaluators.metrics.footprint import ActorTable, Footprints
from evaluators.metrics.presets import Preset

Kind = Literal["vru", "vehicle", "object"]
KINDS: dict[str, Kind] = {
    "pedestrian": "vru",
    "cyclist": "vru",
    "car": "vehicle",
    "truck": "vehicle",
    "bus": "vehicle",
    "motorcycle": "vehicle",
}


@dataclass(frozen=True)
class EgoStates:
    """The ego at T instants; metres from an origin, radians.

    Attributes:
        t_us: ``(T,)`` times.
        rear_xy: ``(T, 2)`` rear axle.
        yaw: ``(T,)``.
        velocity: ``(T, 2)`` of the rear axle, along and to the left of the vehicle, m/s.
        accel: ``(T, 2)`` the same, m/s2, of the rear axle.
        centre_accel: ``(T, 2)`` the same of the centre of the box.
        size: length and width, m.
        ahead_m: From the rear axle to the centre of the box.
    """

    t_us: I64
    rear_xy: F64
    yaw: F64
    velocity: F64
    accel: F64
    centre_accel: F64
    size: tuple[float, float]
    ahead_m: float

    @property
    def speed(self) -> F64:
        """Give the speed ``(T,)``, m/s, without a sign."""
        return np.hypot(self.velocity[:, 0], self.velocity[:, 1])

    @property
    def heading(self) -> F64:
        """Give the unit vectors ``(T, 2)`` ahead."""
        return np.stack([np.cos(self.yaw), np.sin(self.yaw)], axis=1)

    @property
    def centre(self) -> F64:
        """Give the centres ``(T, 2)`` of the box."""
        return self.rear_xy + self.ahead_m * self.heading

    def boxes(self, xy: F64, yaw: F64) -> Footprints:
        """Return the ego's box at centres ``(N, 2)`` and headings ``(N,)``."""
        return Footprints(xy, yaw, np.broadcast_to(np.array(self.size), (len(xy), 2)))


@dataclass(frozen=True)
class Tracks:
    """The A other road users at the ego's T instants.

    Attributes:
        ids, kinds: ``(A,)``.
        is_present: ``(A, T)``.
        xy: ``(A, T, 2)`` box centres, m; yaw ``(A, T)``; size ``(A, 2)`` length and width.
        velocity: ``(A, T, 2)`` m/s, world axes.
    """

    ids: tuple[str, ...]
    kinds: tuple[Kind, ...]
    is_present: Bool
    xy: F64
    yaw: F64
    size: F64
    velocity: F64

    @property
    def speed(self) -> F64:
        """Give the speeds ``(A, T)``, m/s."""
        return np.hypot(self.velocity[..., 0], self.velocity[..., 1])

    def boxes(self, actor: I64, step: I64) -> Footprints:
        """Return the boxes of pairs ``(M,)`` of actor and step."""
        return Footprints(self.xy[actor, step], self.yaw[actor, step], self.size[actor])


def ego_states(rollout: RolloutLog, preset: Preset, rear: Trajectory, origin: F64) -> EgoStates:
    """Return the states of a trajectory of the rig, driven or planned; positions are relative to an
    origin ``(3,)``.
    """
    t_us = rear.t_us
    yaw = np.unwrap(yaw_from_quat(rear.quat))
    rear_xy = rear.xyz[:, :2] - origin[:2]
    vectors = _rate(rear_xy, t_us)
    velocity = in_axes(vectors, yaw)
    # d/dt of a velocity given in the turning axes: its own rate, and what the turning adds.
    yaw_rate = _rate(yaw, t_us)
    turn = yaw_rate[:, None] * np.stack([-velocity[:, 1], velocity[:, 0]], axis=1)
    accel = _rate(velocity, t_us) + turn
    # The centre lies ahead of the rear axle: turning pulls it back, and turning faster to the side.
    ahead_m = float(rollout.T_rig_box[0, 3])
    swing = ahead_m * np.stack([-(yaw_rate**2), _rate(yaw_rate, t_us)], axis=1)
    size = preset.ego_size_m or (rollout.ego_box.length_m, rollout.ego_box.width_m)
    return EgoStates(
        t_us,
        rear_xy,
        yaw,
        velocity,
        accel,
        accel + swing,
        size,
        ahead_m,
    )


def states_of(
    rollout: RolloutLog, preset: Preset, centre: Trajectory, origin: F64
) -> tuple[EgoStates, Tracks]:
    """Return the states of a trajectory of the ego's box centre, driven or planned, and the others
    as the log has them at its times.

    Positions are relative to an origin ``(3,)``.
    """
    t_us = centre.t_us
    ego = ego_states(rollout, preset, offset_trajectory(centre, inverse(rollout.T_rig_box)), origin)
    table = ActorTable(rollout, preset, origin, centre)
    actors_at = table.at(t_us)
    actor, step = np.nonzero(actors_at.present)
    xy = np.zeros((len(table), len(t_us), 2))
    yaws = np.zeros(actors_at.present.shape)
    v = np.zeros((len(table), len(t_us), 2))
    boxes = actors_at.footprints(actor, step)
    xy[actor, step], yaws[actor, step] = boxes.xy, boxes.yaw
    for a in range(len(table)):
        present = np.flatnonzero(actors_at.present[a])
        v[a, present] = _rate(xy[a, present], t_us[present])
    kinds = tuple(KINDS.get(actor.label, "object") for actor in rollout.actors.values())
    return ego, Tracks(table.ids, kinds, actors_at.present, xy, yaws, table.size, v)


def _rate(values: F64, t_us: I64) -> F64:
    """Return the central difference in time of values ``(T, ...)``, per second; 0 of a single
    one.
    """
    return np.zeros_like(values) if len(values) < 2 else np.gradient(values, t_us * 1e-6, axis=0)


def velocity_at(track: Trajectory, t_us: int) -> F64:
    """Return the velocity ``(2,)`` of a track of two poses or more at the pose nearest to a time,
    m/s, world axes.
    """
    nearest = int(np.argmin(np.abs(track.t_us - t_us)))
    return _rate(track.xyz[:, :2], track.t_us)[nearest]


def smooth(values: F64) -> F64:
    """Return values ``(T,)`` through a Savitzky-Golay filter of order 2, whose window of 8 is never
    longer than they are.
    """
    return savitzky_golay(values, 8, 2)


def derivative(values: F64, t_us: I64, window: int = 5, order: int = 2, times: int = 1) -> F64:
    """Return a derivative in time of values ``(T,)`` by a Savitzky-Golay filter at the mean step,
    per second to the power of ``times``.
    """
    step_s = float(np.mean(np.diff(t_us))) * 1e-6
    return savitzky_golay(values, window, order, times) / step_s**times


def savitzky_golay(values: F64, window: int, order: int, times: int = 0) -> F64:
    """Return a derivative, ``times`` by the index, of the polynomials fitted to a window around each
    of the values ``(T,)``, as `scipy.signal.savgol_filter` does, whose import takes a second.

    In the middle of an even window none of its values stands. Near an end the polynomial of the
    first or last window counts.

    Raises:
        EvaluatorError: There are no more values than the polynomial's order.
    """
    if len(values) <= order:
        raise EvaluatorError(
            f"a Savitzky-Golay filter: {len(values)} instants, a polynomial of order {order}",
            "score a log of more steps",
        )
    window = min(window, len(values))
    half = window // 2
    index = np.arange(len(values))
    start = np.clip(index - (window - 1) // 2, 0, len(values) - window)
    place = np.where(
        (index < half) | (index >= len(values) - half), index - start, (window - 1) / 2
    )
    fit = np.linalg.pinv(np.vander(np.arange(window), order + 1, increasing=True))
    polynomials = polynomial.polyder(fit @ sliding_window_view(values, window).T, times)
    derivative = polynomial.polyval(place, polynomials[:, start], tensor=False)
    return derivative.astype(np.float64)
